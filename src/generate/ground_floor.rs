//! Doors and shops, which the ground floor has instead of windows.

use glam::DVec3;

use super::facade::{Facade, GROUND_FLOOR_M, RECESS_M, glass};
use super::letters;
use super::random::{Random, smooth};
use super::surface::{Paint, Patch};

/// Colours of goods in shop windows.
const GOODS: [Paint; 7] = [
    Paint::matt(0.80, 0.24, 0.18),
    Paint::matt(0.90, 0.74, 0.28),
    Paint::matt(0.24, 0.42, 0.62),
    Paint::matt(0.34, 0.54, 0.32),
    Paint::matt(0.88, 0.86, 0.80),
    Paint::matt(0.56, 0.30, 0.42),
    Paint::matt(0.72, 0.50, 0.30),
];

impl Facade<'_, '_, '_> {
    /// A bay with the house's door, a step and a lamp.
    pub(super) fn door_bay(&mut self, u_m: f64) {
        // In a narrow bay the door takes 60 % of the width.
        let half_m = 0.65_f64.min(0.3 * self.bay_m);
        let middle_m = u_m + 0.5 * self.bay_m;
        let u = [middle_m - half_m, middle_m + half_m];
        let door_m = 2.35;
        let light_m = 3.0;
        self.around(u_m, u, [0.0, GROUND_FLOOR_M], [0.0, light_m]);
        self.surround(u, [0.30, light_m]);
        let wood = self.style.accent.times(0.75);
        let us = self.painter.graded(u[0], u[1], 0.06, 0.16);
        let vs = self.painter.graded(0.0, door_m, 0.06, 0.22);
        self.rect(&us, &vs, -RECESS_M, |at_m, v_m| {
            // Two sunken panels on either side of the middle.
            let panel = |x: f64, from: f64, to: f64| (from..to).contains(&x);
            let aside_m = (at_m - middle_m).abs() / half_m;
            let inset =
                panel(aside_m, 0.15, 0.8) && (panel(v_m, 0.25, 0.95) || panel(v_m, 1.15, 2.1));
            wood.times(if inset { 0.78 } else { 1.0 }).gloss(0.06)
        });
        let vs = self.painter.graded(door_m, light_m, 0.08, 0.25);
        self.rect(&us, &vs, -RECESS_M, |_, v_m| {
            if v_m < door_m + 0.1 { Paint::matt(0.80, 0.79, 0.76) } else { glass() }
        });
        let step = Paint::matt(0.62, 0.61, 0.59);
        let wall = *self.wall;
        let us = self.painter.even(u[0] - 0.15, u[1] + 0.15, 0.3);
        let top = move |at_m: f64, d_m: f64| wall.at(at_m, 0.15, -d_m);
        // From the front edge towards the wall, so that the normal points up.
        self.painter.sheet(&us, &[-0.45, -0.2, 0.1], top, |_, _| Some(step));
        self.rect(&us, &[0.0, 0.15], 0.45, |_, _| step.times(0.9).open(0.7));
        let lamp = Patch {
            center_m: wall.at(u[1] + 0.32, 2.35, 0.12),
            edge_u_m: 0.16 * wall.right,
            edge_v_m: 0.26 * DVec3::Z,
        };
        self.painter.patch(&lamp, Paint::matt(0.90, 0.86, 0.74));
    }

    /// A bay of shop window: plinth, glass with goods behind it, sign, awning.
    pub(super) fn shop_bay(&mut self, u_m: f64, random: &mut Random) {
        let accent = self.style.accent;
        let pier_m = 0.22;
        let u = [u_m + pier_m, u_m + self.bay_m - pier_m];
        let plinth_m = 0.45;
        let head_m = 2.75;
        let sign_m = 3.45;
        self.pier([u_m, u[0]], [0.0, GROUND_FLOOR_M]);
        self.pier([u[1], u_m + self.bay_m], [0.0, GROUND_FLOOR_M]);
        self.plain(u, [sign_m, GROUND_FLOOR_M]);
        let us = self.painter.graded(u[0], u[1], 0.08, 0.3);
        self.rect(&us, &[0.0, 0.15, plinth_m], -0.05, |_, v_m| {
            accent.times(0.7).open(0.7 + 0.5 * v_m)
        });
        self.shop_window(u, [plinth_m, head_m], random);
        self.sign(u, [head_m, sign_m], random);
        // Two of three shops have an awning.
        if random.below(3) > 0 {
            self.awning(u, head_m + 0.05, accent);
        }
    }

    /// Glass in front of a lit room, with goods on two shelves, between bars.
    fn shop_window(&mut self, u: [f64; 2], v: [f64; 2], random: &mut Random) {
        let frame = self.style.frame;
        let us = self.painter.even(u[0], u[1], 0.34);
        let vs = self.painter.even(v[0], v[1], 0.28);
        let warmth = random.range(0.9, 1.2);
        self.rect(&us, &vs, -0.32, |_, v_m| {
            // The room is lit from above.
            let lit = smooth((v_m - v[0]) / (v[1] - v[0]));
            Paint::matt(0.46, 0.38, 0.28).times(warmth * (0.55 + 0.75 * lit)).gloss(0.22)
        });
        let wall = *self.wall;
        if self.style.near {
            for shelf_m in [v[0] + 0.12, v[0] + 0.78] {
                let board = Paint::matt(0.30, 0.24, 0.19);
                self.bar([u[0], shelf_m], [u[1], shelf_m], -0.16, [0.05, 0.4], board);
                let mut at_m = u[0] + 0.12;
                while at_m < u[1] - 0.16 {
                    let wide_m = random.range(0.08, 0.2);
                    let high_m = random.range(0.14, 0.42);
                    let at = |up_m: f64| wall.at(at_m + 0.5 * wide_m, shelf_m + 0.03 + up_m, -0.14);
                    let goods = random.pick(&GOODS);
                    self.painter.stroke([at(0.0), at(high_m)], wall.out, wide_m, goods);
                    at_m += wide_m + random.range(0.05, 0.22);
                }
            }
        }
        let middle_m = 0.5 * (u[0] + u[1]);
        for at_m in [u[0] + 0.03, middle_m, u[1] - 0.03] {
            self.bar([at_m, v[0]], [at_m, v[1]], -0.06, [0.07, 0.8], frame);
        }
        for at_m in [v[0] + 0.03, v[1] - 0.04] {
            self.bar([u[0], at_m], [u[1], at_m], -0.06, [0.08, 0.36], frame);
        }
    }

    /// A board with a name in letters that stand off it.
    fn sign(&mut self, u: [f64; 2], v: [f64; 2], random: &mut Random) {
        let accent = self.style.accent;
        let name = random.pick(&letters::NAMES);
        // Names are ASCII: a byte is a letter.
        let count = name.len() as f64;
        // Long names fill the sign; short ones keep the letters at their usual width.
        let pitch_m = (0.92 * (u[1] - u[0]) / count).min(0.34);
        let us = self.painter.even(u[0], u[1], 0.2);
        let edge_m = 0.04;
        let vs = [v[0], v[0] + edge_m, 0.5 * (v[0] + v[1]), v[1] - edge_m, v[1]];
        self.rect(&us, &vs, 0.0, |_, v_m| {
            let is_rim = v_m < v[0] + edge_m || v_m > v[1] - edge_m;
            accent.times(if is_rim { 0.6 } else { 1.0 })
        });
        // Light letters on a dark sign, dark ones on a light sign.
        let tone = if accent.rgb.element_sum() > 1.5 { 0.16 } else { 0.96 };
        let ink = Paint::matt(tone, tone, 0.93 * tone);
        let wall = *self.wall;
        let wide_m = 0.62 * pitch_m;
        let high_m = 0.38;
        // A letter is 0.62 of the pitch wide, and the gap of 0.38 after the last one does not
        // count.
        let from = [0.5 * (u[0] + u[1] - pitch_m * (count - 0.38)), 0.5 * (v[0] + v[1] - high_m)];
        for (index, letter) in name.chars().enumerate() {
            let left_m = from[0] + pitch_m * index as f64;
            let at = |x: f64, y: f64| wall.at(left_m + wide_m * x, from[1] + high_m * y, 0.17);
            for &[x0, y0, x1, y1] in letters::strokes(letter) {
                self.painter.stroke([at(x0, y0), at(x1, y1)], wall.out, 0.075, ink);
            }
        }
    }

    /// A striped cloth on a slope, 1.1 m out.
    fn awning(&mut self, u: [f64; 2], v_m: f64, accent: Paint) {
        let wall = *self.wall;
        let us = self.painter.even(u[0] - 0.1, u[1] + 0.1, 0.16);
        // From the outer edge up to the wall, so that the normal points out and up.
        let out = self.painter.even(0.0, 1.0, 0.2);
        let slope = move |at_m: f64, t: f64| wall.at(at_m, v_m - 0.40 + 0.40 * t, 1.1 * (1.0 - t));
        // Stripes count from the first column: a negative quotient would round towards 0 and make
        // the stripe there twice as wide.
        let first_m = us[0];
        let cloth = |at_m: f64| {
            let light = ((at_m - first_m) / 0.32) as i64 % 2 == 0;
            if light { Paint::matt(0.88, 0.86, 0.82) } else { accent.times(1.1) }
        };
        self.painter.sheet(&us, &out, slope, |at_m, _| Some(cloth(at_m)));
        self.rect(&us, &[v_m - 0.58, v_m - 0.40], 1.1, |at_m, _| cloth(at_m).times(0.95));
    }
}
