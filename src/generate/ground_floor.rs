//! Doors and shops, which the ground floor has instead of windows.

use glam::DVec3;

use super::facade::{Facade, GROUND_FLOOR_M, RECESS_M, glass};
use super::random::{Random, noise, smooth};
use super::surface::{Paint, Patch};

impl Facade<'_, '_, '_> {
    /// A bay with the house's door, two steps and a lamp.
    pub(super) fn door_bay(&mut self, u_m: f64) {
        let half_m = 0.65_f64.min(0.3 * self.bay_m);
        let middle_m = u_m + 0.5 * self.bay_m;
        let u = [middle_m - half_m, middle_m + half_m];
        let (door_m, light_m) = (2.35, 3.0);
        self.pier([u_m, u[0]], [0.0, GROUND_FLOOR_M]);
        self.pier([u[1], u_m + self.bay_m], [0.0, GROUND_FLOOR_M]);
        self.plain(u, [light_m, GROUND_FLOOR_M]);
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
        let (accent, frame) = (self.style.accent, self.style.frame);
        let pier_m = 0.22;
        let u = [u_m + pier_m, u_m + self.bay_m - pier_m];
        let (plinth_m, head_m, sign_m) = (0.45, 2.75, 3.45);
        self.pier([u_m, u[0]], [0.0, GROUND_FLOOR_M]);
        self.pier([u[1], u_m + self.bay_m], [0.0, GROUND_FLOOR_M]);
        self.plain(u, [sign_m, GROUND_FLOOR_M]);
        let us = self.painter.graded(u[0], u[1], 0.08, 0.3);
        self.rect(&us, &[0.0, 0.15, plinth_m], -0.05, |_, v_m| {
            accent.times(0.7).open(0.7 + 0.5 * v_m)
        });
        // Goods: blurred shelves of colours behind the glass.
        // Below 2^30, so that adding a channel does not overflow.
        let seed = random.below(1 << 30) as u64;
        let panes = self.painter.graded(plinth_m, head_m, 0.08, 0.22);
        self.rect(&us, &panes, -0.10, |at_m, v_m| {
            let mullion = ((at_m - u[0]) / (u[1] - u[0]) - 0.5).abs() < 0.02;
            if mullion || v_m > head_m - 0.09 || v_m < plinth_m + 0.08 {
                return frame;
            }
            // Goods stand on shelves below eye height; above them is the lit room.
            let shelf = (v_m / 0.5).floor();
            let goods = |channel: u64| noise(seed + channel, 2.3 * at_m, 1.7 * shelf);
            let room = smooth((v_m - 1.5) / 0.5);
            let mut paint = Paint::matt(0.44, 0.40, 0.35).times(0.85 + 0.45 * room).gloss(0.26);
            let hue = DVec3::new(goods(0), goods(1), goods(2)) * 0.07;
            paint.rgb += (1.0 - room) * (hue + 0.12 * goods(3));
            paint
        });
        // The sign, with blocks in place of letters.
        let signs = self.painter.graded(head_m, sign_m, 0.09, 0.12);
        let letters = self.painter.even(u[0], u[1], 0.13);
        // Light letters on a dark sign, dark ones on a light sign.
        let lettering = if accent.rgb.element_sum() > 1.5 { 0.25 } else { 0.93 };
        self.rect(&letters, &signs, 0.06, |at_m, v_m| {
            let inside = (v_m - 0.5 * (head_m + sign_m)).abs() < 0.17
                && (at_m - 0.5 * (u[0] + u[1])).abs() < 0.36 * (u[1] - u[0]);
            let ink = noise(seed + 5, 7.0 * at_m, 3.0 * v_m) > -0.05;
            let letter = Paint::matt(lettering, lettering, 0.95 * lettering);
            if inside && ink { letter } else { accent }
        });
        // Two of three shops have an awning.
        if !seed.is_multiple_of(3) {
            self.awning(u, head_m + 0.05, accent);
        }
    }

    /// A striped cloth on a slope, 1.1 m out.
    fn awning(&mut self, u: [f64; 2], v_m: f64, accent: Paint) {
        let wall = *self.wall;
        let us = self.painter.even(u[0] - 0.1, u[1] + 0.1, 0.16);
        // From the outer edge up to the wall, so that the normal points out and up.
        let out = self.painter.even(0.0, 1.0, 0.2);
        let slope = move |at_m: f64, t: f64| wall.at(at_m, v_m - 0.40 + 0.40 * t, 1.1 * (1.0 - t));
        let first_m = us[0];
        let cloth = |at_m: f64| {
            let light = ((at_m - first_m) / 0.32) as i64 % 2 == 0;
            if light { Paint::matt(0.88, 0.86, 0.82) } else { accent.times(1.1) }
        };
        self.painter.sheet(&us, &out, slope, |at_m, _| Some(cloth(at_m)));
        self.rect(&us, &[v_m - 0.58, v_m - 0.40], 1.1, |at_m, _| cloth(at_m).times(0.95));
    }
}
