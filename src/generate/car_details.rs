//! What is narrow on a car: seals, seams, lamps, number plates, wheels, mirrors.

use glam::DVec3;

use super::car_kinds::Kind;
use super::cars::{Car, LOW_M, PILLAR, SILL_M, WHEELS, WINDOW, facing, glass};
use super::random::smooth;
use super::surface::{Paint, Painter};

/// Longest part of a line along the body, in metres: longer ones would hide behind the surfels
/// beneath their near half.
const LINE_M: f64 = 0.24;

impl Car {
    /// What is narrow on a side: seals of the windows, seams and handles of the doors, arches.
    pub(super) fn lines(&self, painter: &mut Painter, side: f64) {
        let Kind { length_m, tyre_m, side_glass, .. } = *self.kind;
        // Lines lie 1.2 cm off the body.
        let out = side * self.left;
        let cabin = |x: f64, v: f64| self.cabin_at(x * length_m, v, side) + 0.012 * out;
        let flank = |x: f64, v: f64| self.flank_at(x * length_m, v, side) + 0.012 * out;
        let black = Paint::matt(0.07, 0.07, 0.08);
        let seam = self.paint.times(0.42);
        let line_m = painter.fine(LINE_M);
        for &[from, end] in side_glass {
            // Where the windscreen comes down, the window ends.
            let to = if self.cabin_m(end) > LOW_M { end } else { end - 0.02 };
            let parts = ((to - from) * length_m / line_m).ceil().max(1.0);
            for v in WINDOW {
                let along = |part: i32| cabin(from + (to - from) * f64::from(part) / parts, v);
                let places: Vec<DVec3> = (0..=parts as i32).map(along).collect();
                painter.polyline(&places, out, [0.030, line_m], black);
            }
            for x in [from, to] {
                let ends_m = [cabin(x, WINDOW[0]), cabin(x, WINDOW[1])];
                painter.polyline(&ends_m, out, [0.030, 0.22], black);
            }
            // A door below its window, with the handle at its rear end.
            painter.polyline(&[flank(from, 0.10), flank(from, 0.98)], out, [0.014, 0.3], seam);
            if to < 0.62 {
                let handle =
                    [flank(from + 0.012, 0.80), flank(from + 0.012 + 0.18 / length_m, 0.80)];
                painter.polyline(&handle, out, [0.030, 1.0], self.paint.times(0.6).gloss(0.3));
            }
        }
        if let Some(&[_, to]) = side_glass.last() {
            let x = to.min(0.645);
            painter.polyline(&[flank(x, 0.10), flank(x, 0.98)], out, [0.014, 0.3], seam);
        }
        self.screens(painter, side);
        for wheel in WHEELS {
            // The upper half of a ring, down to the sill.
            let radius_m = tyre_m + 0.055;
            // Eight parts at the usual length, and more of them where lines are finer.
            let parts = (8.0 * LINE_M / line_m).round();
            let at = |part: i32| {
                let (sin, cos) = (std::f64::consts::PI * f64::from(part) / parts).sin_cos();
                let x = wheel + radius_m * cos / length_m;
                let z_m = (tyre_m + radius_m * sin).max(SILL_M);
                let v = (z_m - SILL_M) / (self.kind.belt_m(x) - SILL_M);
                flank(x, v)
            };
            let places: Vec<DVec3> = (0..=parts as i32).map(at).collect();
            painter.polyline(&places, out, [0.05, 1.0], black);
        }
    }

    /// Half of the seals around windscreen and rear window.
    pub(super) fn screens(&self, painter: &mut Painter, side: f64) {
        let black = Paint::matt(0.07, 0.07, 0.08);
        for [from, to] in [self.kind.windscreen, self.kind.rear_glass] {
            let at = |x: f64, v: f64| self.cabin_at(x * self.kind.length_m, v, side);
            let upright = self.left.cross(at(to, 1.5) - at(from, 1.5)).normalize_or_zero();
            // Outwards is up, for the windscreen and for the rear window.
            let out = upright * upright.z.signum();
            let corners = [(from, 2.0), (from, 1.0 + PILLAR), (to, 1.0 + PILLAR), (to, 2.0)];
            let places: Vec<DVec3> = corners
                .windows(2)
                .flat_map(|pair| {
                    let (from, v0) = pair[0];
                    let (to, v1) = pair[1];
                    (0..3).map(move |part| (from, v0, to, v1, f64::from(part) / 3.0))
                })
                .map(|(from, v0, to, v1, t)| at(from + t * (to - from), v0 + t * (v1 - v0)))
                .chain([at(to, 2.0)])
                .map(|place_m| place_m + 0.012 * out)
                .collect();
            if to > from {
                painter.polyline(&places, out, [0.028, painter.fine(LINE_M)], black);
            }
        }
    }

    /// Nose (`x` = 1) or tail (`x` = 0): bumper, grille or boot lid, lamps, number plate.
    pub(super) fn end(&self, painter: &mut Painter, x: f64) {
        let nose = x > 0.5;
        let outwards = if nose { 1.0 } else { -1.0 };
        let half_m = 0.97 * self.half_width_m(x);
        let top_m = self.kind.belt_m(x) + 0.01;
        // As seen from outside, u runs to the right: to the car's left for a viewer in front of its
        // nose.
        let ys = painter.graded(-half_m, half_m, 0.10, 0.24);
        let zs = painter.even(SILL_M - 0.02, top_m, 0.11);
        let bulge = |y_m: f64| 0.05 * (1.0 - (y_m / half_m).powi(2));
        let place = |u_m: f64, z_m: f64, off_m: f64| {
            let x_m = x * self.kind.length_m + outwards * (bulge(u_m) + off_m);
            self.place(x_m, outwards * u_m, z_m)
        };
        let height = |z_m: f64| (z_m - SILL_M) / (top_m - SILL_M);
        let black = Paint::matt(0.10, 0.10, 0.11).gloss(0.05);
        painter.sheet(
            &ys,
            &zs,
            |u_m, z_m| place(u_m, z_m, 0.0),
            |_, z_m| {
                let paint = if height(z_m) < 0.24 { black } else { self.paint };
                Some(paint.open(0.65 + 0.35 * smooth(height(z_m) / 0.6)))
            },
        );
        let normal = outwards * self.forward;
        let at_m = |part: f64| SILL_M + part * (top_m - SILL_M);
        let line = |painter: &mut Painter,
                    [from_m, to_m]: [f64; 2],
                    z_m: f64,
                    width_and_longest_m: [f64; 2],
                    paint: Paint| {
            let parts = ((to_m - from_m) / width_and_longest_m[1]).ceil().max(1.0);
            let at =
                |part: i32| place(from_m + (to_m - from_m) * f64::from(part) / parts, z_m, 0.016);
            let places: Vec<DVec3> = (0..=parts as i32).map(at).collect();
            painter.polyline(&places, normal, width_and_longest_m, paint);
        };
        if nose {
            // Grille with a bright bar, and the air intake below.
            let wide_m = half_m - 0.38;
            for part in [0.70, 0.78, 0.86] {
                line(painter, [-wide_m, wide_m], at_m(part), [0.045, 0.3], black);
            }
            line(painter, [-wide_m, wide_m], at_m(0.93), [0.02, 0.3], Paint::matt(0.78, 0.79, 0.8));
            line(painter, [-half_m + 0.2, half_m - 0.2], at_m(0.24), [0.09, 0.3], black);
        } else {
            // The gap of the boot lid, and the bumper's edge.
            for (inset_m, part, width_m) in [(0.3, 0.60, 0.014), (0.1, 0.27, 0.02)] {
                let ends_m = [inset_m - half_m, half_m - inset_m];
                line(painter, ends_m, at_m(part), [width_m, 0.3], self.paint.times(0.4));
            }
        }
        for side in [-1.0, 1.0] {
            let lamp = |u: [f64; 2], v: [f64; 2]| {
                let [from_m, to_m] = if side > 0.0 { u } else { [-u[1], -u[0]] };
                [from_m, to_m, at_m(v[0]), at_m(v[1])]
            };
            let outer_m = half_m - 0.03;
            let parts: &[([f64; 4], Paint)] = if nose {
                &[
                    (
                        lamp([outer_m - 0.32, outer_m], [0.68, 0.96]),
                        Paint::matt(0.30, 0.31, 0.33).gloss(0.2),
                    ),
                    (
                        lamp([outer_m - 0.28, outer_m - 0.16], [0.72, 0.93]),
                        Paint::glowing(0.98, 0.98, 0.94),
                    ),
                    (
                        lamp([outer_m - 0.13, outer_m - 0.02], [0.72, 0.93]),
                        Paint::glowing(0.90, 0.92, 0.94),
                    ),
                ]
            } else {
                &[
                    (
                        lamp([outer_m - 0.26, outer_m], [0.62, 0.97]),
                        Paint::matt(0.46, 0.05, 0.05).gloss(0.15),
                    ),
                    (
                        lamp([outer_m - 0.22, outer_m - 0.03], [0.78, 0.92]),
                        Paint::glowing(0.86, 0.14, 0.10),
                    ),
                    (
                        lamp([outer_m - 0.22, outer_m - 0.03], [0.66, 0.74]),
                        Paint::matt(0.80, 0.42, 0.16).gloss(0.1),
                    ),
                ]
            };
            for (layer, ([from_m, to_m, low_m, high_m], paint)) in parts.iter().enumerate() {
                let us = painter.graded(*from_m, *to_m, 0.03, 0.12);
                let vs = painter.graded(*low_m, *high_m, 0.03, 0.08);
                let off_m = 0.014 + 0.012 * layer.min(1) as f64;
                painter.sheet(&us, &vs, |u_m, z_m| place(u_m, z_m, off_m), |_, _| Some(*paint));
            }
        }
        self.plate(painter, normal, place, at_m(0.42));
    }

    /// A number plate with its middle at a height, and dark characters.
    fn plate(
        &self,
        painter: &mut Painter,
        normal: DVec3,
        place: impl Fn(f64, f64, f64) -> DVec3,
        z_m: f64,
    ) {
        let us = painter.graded(-0.26, 0.26, 0.02, 0.14);
        let vs = [z_m - 0.055, z_m - 0.04, z_m + 0.04, z_m + 0.055];
        painter.sheet(
            &us,
            &vs,
            |u_m, z_m| place(u_m, z_m, 0.02),
            |_, _| Some(Paint::matt(0.92, 0.92, 0.89)),
        );
        // A stroke or two for every character.
        for (index, is_wide) in [true, false, true, true, false, true].into_iter().enumerate() {
            let u_m = -0.19 + 0.07 * index as f64;
            let at = |du_m: f64, dz_m: f64| place(u_m + du_m, z_m + dz_m, 0.03);
            let ink = Paint::matt(0.08, 0.08, 0.10);
            painter.stroke([at(0.0, -0.032), at(0.0, 0.032)], normal, 0.013, ink);
            if is_wide {
                painter.stroke([at(0.028, -0.032), at(0.028, 0.032)], normal, 0.013, ink);
                painter.stroke([at(0.0, 0.0), at(0.028, 0.0)], normal, 0.013, ink);
            }
        }
    }

    /// Tyre, rim, and the dark wheel arch behind them.
    pub(super) fn wheel(&self, painter: &mut Painter, wheel: f64, side: f64) {
        let tyre_m = self.kind.tyre_m;
        let x_m = wheel * self.kind.length_m;
        let half_m = self.half_width_m(wheel);
        let disc = |radius_m: f64, y_m: f64| {
            move |angle_rad: f64, r: f64| {
                let (sin, cos) = angle_rad.sin_cos();
                self.place(x_m + radius_m * r * cos, side * y_m, tyre_m + radius_m * r * sin)
            }
        };
        let detail = painter.refined(&[0.0, 1.0]).len() - 1;
        let around = |count: usize| -> Vec<f64> {
            let count = count * detail;
            let step_rad = std::f64::consts::TAU / count as f64;
            // Outwards for either side: with r as v, u × v points to -left when u turns left.
            // The last break point closes the circle.
            (0..=count).map(|i| side * i as f64 * step_rad).collect()
        };
        let arch = disc(tyre_m + 0.07, half_m - 0.16);
        let radii = painter.refined(&[0.1, 1.0]);
        painter
            .sheet(&around(8), &radii, arch, |_, _| Some(Paint::matt(0.06, 0.06, 0.07).open(0.5)));
        // Behind the spokes it is dark; the rim's edge is bright.
        let rings = painter.refined(&[0.0, 0.60, 0.66, 0.72, 0.96, 1.0]);
        let metal = Paint::matt(0.74, 0.75, 0.78).gloss(0.12);
        painter.sheet(&around(12), &rings, disc(tyre_m, half_m - 0.035), |_, r| {
            Some(if (0.60..0.66).contains(&r) {
                metal
            } else if r < 0.60 {
                Paint::matt(0.15, 0.15, 0.16)
            } else {
                Paint::matt(0.11, 0.11, 0.12).times(if r > 0.9 { 0.75 } else { 1.0 })
            })
        });
        let place = disc(tyre_m, half_m - 0.022);
        let out = side * self.left;
        for spoke in 0..5 {
            let angle_rad = std::f64::consts::TAU * (f64::from(spoke) + 0.25) / 5.0;
            let ends_m = [place(angle_rad, 0.06), place(angle_rad, 0.62)];
            painter.stroke(ends_m, out, 0.20 * tyre_m, metal.times(0.94));
        }
        painter.stroke([place(0.0, -0.14), place(0.0, 0.14)], out, 0.28 * tyre_m, metal.times(0.8));
        // The tread, as seen from ahead and behind.
        let tread = move |angle_rad: f64, t: f64| {
            let (sin, cos) = angle_rad.sin_cos();
            let y_m = side * (half_m - 0.035 - 0.20 * t);
            self.place(x_m + tyre_m * cos, y_m, tyre_m + tyre_m * sin)
        };
        let across = painter.refined(&[0.0, 1.0]);
        painter.sheet(&around(14), &across, tread, |_, _| Some(Paint::matt(0.10, 0.10, 0.11)));
    }

    /// A door mirror: a small box with glass towards the tail.
    pub(super) fn mirror(&self, painter: &mut Painter, side: f64) {
        // Just behind the lower end of the windscreen.
        let x = self.kind.windscreen[1] - 0.055;
        let x_m = x * self.kind.length_m;
        let z_m = self.kind.belt_m(x) + 0.03;
        let inner_m = self.half_width_m(x) - 0.04;
        let ys = painter.refined(&[0.0, 0.06, 0.12, 0.18]);
        let zs = painter.refined(&[0.0, 0.06, 0.12]);
        // Towards the tail u runs to the car's right, towards the nose to its left.
        for (forward_m, sign) in [(-0.05, -1.0), (0.05, 1.0)] {
            let us = facing(&ys, sign * side);
            let place = |u_m: f64, v_m: f64| {
                self.place(x_m + forward_m, side * inner_m + sign * u_m, z_m + v_m)
            };
            painter.sheet(&us, &zs, place, |_, _| {
                Some(if sign < 0.0 { glass() } else { self.paint.times(0.85) })
            });
        }
        let outer =
            |u_m: f64, v_m: f64| self.place(x_m - side * u_m, side * (inner_m + 0.18), z_m + v_m);
        let us = painter.refined(&[-0.05, 0.05]);
        painter.sheet(&us, &zs, outer, |_, _| Some(self.paint.times(0.85)));
    }
}
