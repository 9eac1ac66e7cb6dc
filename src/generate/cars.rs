//! Parked cars: each body is a surface through the outline of its kind.

use glam::{DMat3, DQuat, DVec3};

use super::car_kinds::{HATCHBACK, Kind, SEDAN, VAN, WAGON};
use super::light::Occluder;
use super::random::{Random, smooth};
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// Height of the sills, in metres.
const SILL_M: f64 = 0.24;
/// Middle of the wheels along the car, as parts of its length.
const WHEELS: [f64; 2] = [0.19, 0.80];

/// A parked car, not yet painted.
#[derive(Clone, Debug)]
pub(super) struct Car {
    kind: &'static Kind,
    /// Middle of the tail on the ground, in metres.
    tail_m: DVec3,
    forward: DVec3,
    left: DVec3,
    paint: Paint,
    spacing: f64,
}

impl Car {
    /// A car with its middle on `middle_m` that looks along `forward`.
    ///
    /// `spacing` is above 1 for cars that are only visible from far away.
    pub(super) fn new(middle_m: DVec3, forward: DVec3, spacing: f64, mut random: Random) -> Self {
        let kind = random.pick(&[&HATCHBACK, &HATCHBACK, &SEDAN, &SEDAN, &WAGON, &WAGON, &VAN]);
        let paint = random.pick(&[
            Paint::matt(0.86, 0.87, 0.88),
            Paint::matt(0.62, 0.64, 0.66),
            Paint::matt(0.36, 0.38, 0.41),
            Paint::matt(0.16, 0.17, 0.19),
            Paint::matt(0.62, 0.13, 0.12),
            Paint::matt(0.15, 0.26, 0.50),
            Paint::matt(0.24, 0.36, 0.33),
            Paint::matt(0.74, 0.70, 0.60),
        ]);
        // Left is up x forward.
        let left = DVec3::Z.cross(forward);
        let tail_m = middle_m - 0.5 * kind.length_m * forward;
        Self { kind, tail_m, forward, left, paint: paint.gloss(0.14), spacing }
    }

    /// A car of a kind and colour with its middle on the origin, which looks along x.
    pub(super) fn model(kind: &'static Kind, paint: Paint) -> Self {
        let tail_m = DVec3::new(-0.5 * kind.length_m, 0.0, 0.0);
        Self {
            kind,
            tail_m,
            forward: DVec3::X,
            left: DVec3::Y,
            paint: paint.gloss(0.14),
            spacing: 1.0,
        }
    }

    /// Length, width and height, in metres.
    pub(super) fn size_m(&self) -> DVec3 {
        // The outline is linear between knots, which lie close to hundredths of the length.
        let top_m = (0..=100).map(|i| self.kind.middle_line_m(f64::from(i) / 100.0));
        DVec3::new(self.kind.length_m, self.kind.width_m, top_m.fold(0.0, f64::max))
    }

    /// Paints body, glass, lamps and wheels, without the shade below: of a car that will move.
    pub(super) fn paint_model(&self, painter: &mut Painter) {
        self.paint_body(painter);
        self.inside(painter);
    }

    /// The bodies that cast the car's shadow: body and cabin, a little smaller than painted.
    pub(super) fn occluders(&self) -> [Occluder; 2] {
        let Kind { length_m, width_m, .. } = *self.kind;
        let block = |from: f64, to: f64, low_m: f64, high_m: f64, half_width_m: f64| {
            let middle_m = 0.5 * (from + to) * length_m;
            let half_m = 0.5 * (to - from) * length_m;
            Occluder::Block {
                base_m: self.tail_m + middle_m * self.forward + low_m * DVec3::Z,
                along: self.forward,
                size_m: DVec3::new(half_m, half_width_m, high_m - low_m),
            }
        };
        // At 0.45 of the length every kind has its roof.
        let top_m = self.kind.middle_line_m(0.45);
        // A little smaller than the painted body, which would shade itself otherwise.
        [
            block(0.02, 0.97, 0.10, 0.60, 0.5 * width_m - 0.06),
            block(0.16, 0.62, 0.60, top_m - 0.12, 0.5 * width_m - 0.22),
        ]
    }

    /// Paints body, glass, lamps and wheels.
    pub(super) fn paint(&self, painter: &mut Painter) {
        painter.coarser(self.spacing, |painter| self.paint_all(painter));
    }

    fn paint_all(&self, painter: &mut Painter) {
        self.paint_body(painter);
        // It darkens the ground.
        painter.labelled(SemanticClass::Road, |painter| self.shade_below(painter));
        self.inside(painter);
    }

    fn paint_body(&self, painter: &mut Painter) {
        let xs = self.lengthwise(painter);
        for side in [-1.0, 1.0] {
            self.flank(painter, &xs, side);
            self.upper(painter, &xs, side);
            for wheel in WHEELS {
                self.wheel(painter, wheel, side);
            }
            self.mirror(painter, side);
        }
        self.end(painter, 1.0);
        self.end(painter, 0.0);
    }

    /// The dark interior, which is visible through gaps between the surfels.
    fn inside(&self, painter: &mut Painter) {
        let Kind { length_m, width_m, .. } = *self.kind;
        let rotation = DQuat::from_mat3(&DMat3::from_cols(self.forward, self.left, DVec3::Z));
        // Three ellipsoids along the body and one in the cabin.
        for (x, z_m, half_m) in
            [(0.22, 0.58, 0.26), (0.5, 0.58, 0.26), (0.78, 0.52, 0.20), (0.37, 0.98, 0.16)]
        {
            let mean_m = self.place(x * length_m, 0.0, z_m);
            let sigmas_m = DVec3::new(0.07 * length_m, 0.16 * width_m, 0.5 * half_m);
            let rgb = DVec3::new(0.09, 0.09, 0.10);
            painter.gaussian(mean_m, rotation, sigmas_m, 0.97, rgb, DVec3::ZERO);
        }
    }

    /// Break points along the car, in metres from the tail: at every feature, and evenly between.
    /// On a car that is seen from near by, steep parts have break points in proportion to the
    /// length of their slope.
    fn lengthwise(&self, painter: &Painter) -> Vec<f64> {
        let kind = self.kind;
        let mut xs = vec![0.0];
        for pair in kind.features().windows(2) {
            let [from_m, to_m] = [pair[0] * kind.length_m, pair[1] * kind.length_m];
            if painter.is_detailed() {
                // As many cells as the slope is long, not as its projection: the windscreen
                // is steep.
                let count = painter.even(0.0, self.slope_m(from_m, to_m), 0.14).len() - 1;
                let step_m = (to_m - from_m) / count as f64;
                xs.extend((1..=count).map(|k| from_m + k as f64 * step_m));
            } else {
                let steps = painter.even(from_m, to_m, 0.14);
                xs.extend(&steps[1..]);
            }
        }
        xs
    }

    /// Length of the middle line between two places along the car, in metres.
    fn slope_m(&self, from_m: f64, to_m: f64) -> f64 {
        // Between two features the outline is straight, unless a knot was dropped as too close to
        // another.
        const PARTS: i32 = 32;
        let part_m = (to_m - from_m) / f64::from(PARTS);
        let top_m =
            |k: i32| self.kind.middle_line_m((from_m + f64::from(k) * part_m) / self.kind.length_m);
        (0..PARTS).map(|k| part_m.hypot(top_m(k + 1) - top_m(k))).sum()
    }

    /// Half width of the body at its belt: it narrows towards both ends.
    fn half_width_m(&self, x: f64) -> f64 {
        let taper = |from_end: f64| 1.0 - smooth(from_end / 0.16);
        0.5 * self.kind.width_m * (1.0 - 0.10 * taper(1.0 - x) - 0.07 * taper(x))
    }

    fn place(&self, x_m: f64, y_m: f64, z_m: f64) -> DVec3 {
        self.tail_m + x_m * self.forward + y_m * self.left + z_m * DVec3::Z
    }

    /// The side from sill to shoulder, slightly bellied, with the wheel arches cut out.
    fn flank(&self, painter: &mut Painter, xs: &[f64], side: f64) {
        let Kind { length_m, tyre_m, .. } = *self.kind;
        let vs = painter.even(0.0, 1.0, 0.16);
        let place = |x_m: f64, v: f64| {
            let x = x_m / length_m;
            // 10 % narrower at the sill, 3 % at the shoulder.
            let belly = 1.0 - 0.10 * (1.0 - v) * (1.0 - v) - 0.03 * v * v;
            let z_m = SILL_M + v * (self.kind.belt_m(x) - SILL_M);
            self.place(x_m, side * belly * self.half_width_m(x), z_m)
        };
        // The surface must face outwards (u × v), so u runs to the tail on the left side.
        let us = facing(xs, -side);
        let body = self.paint;
        painter.sheet(
            &us,
            &vs,
            |u, v| place(-side * u, v),
            |u, v| {
                let x_m = -side * u;
                let z_m = SILL_M + v * (self.kind.belt_m(x_m / length_m) - SILL_M);
                // A circle around the wheel, 7 cm larger than the tyre.
                let arch = WHEELS.iter().any(|wheel| {
                    let dx_m = x_m - wheel * length_m;
                    dx_m * dx_m + (z_m - tyre_m).powi(2) < (tyre_m + 0.07).powi(2)
                });
                if arch {
                    return None;
                }
                // Door seams below the rear edges of the side windows.
                let seam = self
                    .kind
                    .side_glass
                    .iter()
                    .any(|glass| (x_m / length_m - glass[0]).abs() < 0.008 && z_m > 0.36);
                let sill = if z_m < 0.34 { 0.45 } else { 1.0 };
                let shade = if seam { 0.72 } else { 1.0 };
                // The body near the road gets less light from the sky.
                let open = 0.62 + 0.38 * smooth((z_m - 0.1) / 0.6);
                Some(body.times(sill * shade).open(open))
            },
        );
    }

    /// From the shoulder over the side windows to the middle line.
    fn upper(&self, painter: &mut Painter, xs: &[f64], side: f64) {
        let length_m = self.kind.length_m;
        // v from 0 at the shoulder to 1 at the roof's edge, on to 2 on the middle line.
        let mut vs = painter.refined(&[0.0, 0.12]);
        vs.extend(painter.even(0.12, 0.86, 0.25).into_iter().skip(1));
        vs.extend(painter.refined(&[0.86, 1.0]).into_iter().skip(1));
        vs.extend(painter.even(1.0, 2.0, 0.34).into_iter().skip(1));
        let section = |x_m: f64, v: f64| {
            let x = x_m / length_m;
            let (belt_m, top_m) = (self.kind.belt_m(x), self.kind.middle_line_m(x));
            let half_m = 0.97 * self.half_width_m(x);
            // The roof's crown is 12 % of the cabin's height above its edge.
            let cabin_m = (top_m - belt_m).max(0.0);
            // The cabin's side leans in by `lean` of its height above the belt.
            let edge_m = half_m - 0.10 - self.kind.lean * (cabin_m - 0.06).max(0.0);
            let edge_z_m = belt_m + 0.88 * cabin_m;
            let (y_m, z_m) = if v < 1.0 {
                (half_m + v * (edge_m - half_m), belt_m + v * (edge_z_m - belt_m))
            } else {
                let inwards = v - 1.0;
                // A parabola with a level top at the middle line.
                let rise = 1.0 - (1.0 - inwards) * (1.0 - inwards);
                (edge_m * (1.0 - inwards), edge_z_m + rise * (top_m - edge_z_m))
            };
            self.place(x_m, side * y_m, z_m)
        };
        let us = facing(xs, -side);
        let within = |x: f64, [from, to]: [f64; 2]| (from..to).contains(&x);
        painter.sheet(
            &us,
            &vs,
            |u, v| section(-side * u, v),
            |u, v| {
                let x = -side * u / length_m;
                let cabin_m = self.kind.middle_line_m(x) - self.kind.belt_m(x);
                let side_glass = (0.12..0.86).contains(&v)
                    && cabin_m > 0.14
                    && self.kind.side_glass.iter().any(|&glass| within(x, glass));
                let screen =
                    v > 1.0 && (within(x, self.kind.windscreen) || within(x, self.kind.rear_glass));
                Some(if side_glass || screen { glass() } else { self.paint })
            },
        );
    }

    /// Nose (`x` = 1) or tail (`x` = 0): bumper, grille or boot lid, lamps, number plate.
    fn end(&self, painter: &mut Painter, x: f64) {
        let nose = x > 0.5;
        let outwards = if nose { 1.0 } else { -1.0 };
        let (half_m, top_m) = (0.97 * self.half_width_m(x), self.kind.belt_m(x) + 0.01);
        // As seen from outside, u runs to the right: to the car's left for a viewer in front of its
        // nose.
        let ys = painter.graded(-half_m, half_m, 0.10, 0.14);
        let zs = painter.even(SILL_M - 0.02, top_m, 0.08);
        let bulge = |y_m: f64| 0.05 * (1.0 - (y_m / half_m).powi(2));
        let place = |u_m: f64, z_m: f64| {
            let x_m = x * self.kind.length_m + outwards * bulge(u_m);
            self.place(x_m, outwards * u_m, z_m)
        };
        painter.sheet(&ys, &zs, place, |u_m, z_m| {
            let (aside_m, height) = (u_m.abs(), (z_m - SILL_M) / (top_m - SILL_M));
            let lamp = aside_m > half_m - 0.30 && (0.62..0.98).contains(&height);
            let plate = aside_m < 0.26 && (0.30..0.55).contains(&height);
            let grille = nose && aside_m < half_m - 0.36 && (0.62..0.95).contains(&height);
            Some(
                if lamp && nose {
                    Paint::matt(0.93, 0.94, 0.96).gloss(0.2)
                } else if lamp {
                    Paint::matt(0.74, 0.09, 0.08).gloss(0.1)
                } else if plate {
                    Paint::matt(0.90, 0.90, 0.87)
                } else if grille || height < 0.22 {
                    Paint::matt(0.12, 0.12, 0.13).gloss(0.05)
                } else {
                    self.paint
                }
                .open(0.65 + 0.35 * smooth(height / 0.6)),
            )
        });
    }

    /// Tyre, rim, and the dark wheel arch behind them.
    fn wheel(&self, painter: &mut Painter, wheel: f64, side: f64) {
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
        let arch = disc(tyre_m + 0.09, half_m - 0.16);
        let radii = painter.refined(&[0.1, 0.55, 1.0]);
        painter
            .sheet(&around(10), &radii, arch, |_, _| Some(Paint::matt(0.07, 0.07, 0.08).open(0.5)));
        let rings = painter.refined(&[0.0, 0.22, 0.48, 0.68, 0.82, 1.0]);
        let rim = Paint::matt(0.66, 0.67, 0.70).gloss(0.1);
        painter.sheet(&around(15), &rings, disc(tyre_m, half_m - 0.035), |angle_rad, r| {
            // Five spokes, each 55 % of a fifth.
            let spoke = (angle_rad.abs() * 5.0 / std::f64::consts::TAU).fract() < 0.55;
            Some(if r > 0.68 {
                Paint::matt(0.14, 0.14, 0.15)
            } else if spoke || !(0.22..0.6).contains(&r) {
                rim
            } else {
                Paint::matt(0.16, 0.16, 0.17)
            })
        });
        // The tread, as seen from ahead and behind.
        let tread = move |angle_rad: f64, t: f64| {
            let (sin, cos) = angle_rad.sin_cos();
            let y_m = side * (half_m - 0.035 - 0.20 * t);
            self.place(x_m + tyre_m * cos, y_m, tyre_m + tyre_m * sin)
        };
        let across = painter.refined(&[0.0, 0.5, 1.0]);
        painter.sheet(&around(14), &across, tread, |_, _| Some(Paint::matt(0.12, 0.12, 0.13)));
    }

    /// A door mirror: a small box with glass towards the tail.
    fn mirror(&self, painter: &mut Painter, side: f64) {
        // Just behind the lower end of the windscreen.
        let x = self.kind.windscreen[1] - 0.055;
        let (x_m, z_m) = (x * self.kind.length_m, self.kind.belt_m(x) + 0.03);
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

    /// The shaded ground between the wheels, 2 cm above the road.
    fn shade_below(&self, painter: &mut Painter) {
        let (half_m, length_m) = (0.5 * self.kind.width_m, self.kind.length_m);
        let xs = painter.even(0.02, length_m - 0.02, 0.26);
        let ys = painter.even(-half_m + 0.02, half_m - 0.02, 0.26);
        painter.sheet(
            &xs,
            &ys,
            |x_m, y_m| self.place(x_m, y_m, 0.02),
            |x_m, y_m| {
                // Darker towards the middle: 0.55 of the light at the edge, 0.15 from half
                // a metre inwards.
                let inside_m = (half_m - y_m.abs()).min(x_m).min(length_m - x_m);
                Some(Paint::matt(0.30, 0.30, 0.31).open(0.55 - 0.4 * smooth(inside_m / 0.5)))
            },
        );
    }
}

/// Break points run forwards for `sign` 1; for -1 mirrored, so that they still increase.
fn facing(xs: &[f64], sign: f64) -> Vec<f64> {
    if sign > 0.0 { xs.to_vec() } else { xs.iter().rev().map(|x_m| -x_m).collect() }
}

fn glass() -> Paint {
    Paint::matt(0.13, 0.16, 0.19).gloss(0.36)
}
