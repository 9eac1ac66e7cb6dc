//! Parked cars: each body is a surface through the outline of its kind.

use glam::{DMat3, DQuat, DVec3};

use super::car_kinds::{HATCHBACK, Kind, SEDAN, VAN, WAGON};
use super::light::Occluder;
use super::random::{Random, smooth};
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// Height of the sills, in metres.
pub(super) const SILL_M: f64 = 0.24;
/// Middle of the wheels along the car, as parts of its length.
pub(super) const WHEELS: [f64; 2] = [0.19, 0.80];

/// Lower and upper end of the side windows between the shoulder and the roof's edge.
pub(super) const WINDOW: [f64; 2] = [0.12, 0.86];
/// A cabin lower than this has no side windows, in metres.
pub(super) const LOW_M: f64 = 0.14;
/// Width of the pillars beside windscreen and rear window, as a part of half the roof.
pub(super) const PILLAR: f64 = 0.09;
/// A parked car, not yet painted.
#[derive(Clone, Debug)]
pub(super) struct Car {
    pub(super) kind: &'static Kind,
    /// Middle of the tail on the ground, in metres.
    tail_m: DVec3,
    pub(super) forward: DVec3,
    pub(super) left: DVec3,
    pub(super) paint: Paint,
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

    /// Paints body, glass, lamps and wheels of a car that will move: its shade is not on the road.
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
        let features = self.kind.features();
        let xs = self.lengthwise(painter, &features, 0.17);
        let roof_xs = self.lengthwise(painter, &self.kind.middle_features(), 0.21);
        for side in [-1.0, 1.0] {
            self.flank(painter, &xs, side);
            self.cabin(painter, &xs, side);
            self.top(painter, &roof_xs, side);
            self.lines(painter, side);
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

    /// Break points along the car, in metres from the tail: at each of these features, and
    /// between them in proportion to the length of the slope, since a rear window may be steep.
    fn lengthwise(&self, painter: &Painter, features: &[f64], step_m: f64) -> Vec<f64> {
        let mut xs = vec![0.0];
        for pair in features.windows(2) {
            let from_m = pair[0] * self.kind.length_m;
            let to_m = pair[1] * self.kind.length_m;
            let count = painter.even(0.0, self.slope_m(from_m, to_m), step_m).len() - 1;
            let step_m = (to_m - from_m) / count as f64;
            xs.extend((1..=count).map(|k| from_m + k as f64 * step_m));
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
    pub(super) fn half_width_m(&self, x: f64) -> f64 {
        let taper = |from_end: f64| 1.0 - smooth(from_end / 0.16);
        0.5 * self.kind.width_m * (1.0 - 0.10 * taper(1.0 - x) - 0.07 * taper(x))
    }

    pub(super) fn place(&self, x_m: f64, y_m: f64, z_m: f64) -> DVec3 {
        self.tail_m + x_m * self.forward + y_m * self.left + z_m * DVec3::Z
    }

    /// A point of the side: `v` is 0 at the sill and 1 at the shoulder.
    pub(super) fn flank_at(&self, x_m: f64, v: f64, side: f64) -> DVec3 {
        let x = x_m / self.kind.length_m;
        // 10 % narrower at the sill, 3 % at the shoulder.
        let belly = 1.0 - 0.10 * (1.0 - v) * (1.0 - v) - 0.03 * v * v;
        let z_m = SILL_M + v * (self.kind.belt_m(x) - SILL_M);
        self.place(x_m, side * belly * self.half_width_m(x), z_m)
    }

    /// The side from sill to shoulder, slightly bellied, with the wheel arches cut out.
    fn flank(&self, painter: &mut Painter, xs: &[f64], side: f64) {
        let Kind { length_m, tyre_m, .. } = *self.kind;
        // Narrow cells at the sill and along the shoulder, which are seen against other colours.
        let mut vs = painter.refined(&[0.0, 0.07]);
        vs.extend(painter.even(0.07, 0.93, 0.21).into_iter().skip(1));
        vs.extend(painter.refined(&[0.93, 1.0]).into_iter().skip(1));
        // The surface must face outwards (u × v), so u runs to the tail on the left side.
        let us = facing(xs, -side);
        let body = self.paint;
        painter.sheet(
            &us,
            &vs,
            |u, v| self.flank_at(-side * u, v, side),
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
                let sill = if v < 0.07 { 0.35 } else { 1.0 };
                // The lower half mirrors the road, the upper one the sky.
                let mirrored =
                    0.80 + 0.26 * smooth((v - 0.42) / 0.16) + 0.08 * smooth((v - 0.9) / 0.1);
                // The body near the road gets less light from the sky.
                let open = 0.62 + 0.38 * smooth((z_m - 0.1) / 0.6);
                Some(body.times(sill * mirrored).open(open))
            },
        );
    }

    /// A point of the cabin: `v` is 0 at the shoulder, 1 at the roof's edge, 2 on the middle line.
    pub(super) fn cabin_at(&self, x_m: f64, v: f64, side: f64) -> DVec3 {
        let x = x_m / self.kind.length_m;
        let belt_m = self.kind.belt_m(x);
        let top_m = self.kind.middle_line_m(x);
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
    }

    /// Height of the cabin above the shoulder, in metres.
    pub(super) fn cabin_m(&self, x: f64) -> f64 {
        self.kind.middle_line_m(x) - self.kind.belt_m(x)
    }

    /// The side windows and their pillars; where there is no cabin, the edge of the bonnet.
    fn cabin(&self, painter: &mut Painter, xs: &[f64], side: f64) {
        let length_m = self.kind.length_m;
        let mut tall_vs = painter.refined(&[0.0, WINDOW[0]]);
        tall_vs.extend(painter.even(WINDOW[0], WINDOW[1], 0.25).into_iter().skip(1));
        tall_vs.extend(painter.refined(&[WINDOW[1], 1.0]).into_iter().skip(1));
        let low_vs = painter.refined(&[0.0, 1.0]);
        for pair in facing(xs, -side).windows(2) {
            let middle = -side * 0.5 * (pair[0] + pair[1]) / length_m;
            let is_tall = self.cabin_m(middle) > LOW_M;
            painter.sheet(
                pair,
                if is_tall { &tall_vs } else { &low_vs },
                |u, v| self.cabin_at(-side * u, v, side),
                |u, v| {
                    let x = -side * u / length_m;
                    let is_glass = is_tall
                        && (WINDOW[0]..WINDOW[1]).contains(&v)
                        && self.kind.side_glass.iter().any(|glass| within(x, *glass));
                    // The sky is mirrored in the upper part.
                    Some(if is_glass { glass().times(0.8 + 0.5 * v) } else { self.paint })
                },
            );
        }
    }

    /// Bonnet, windscreen, roof and rear window, from the edge to the middle line.
    fn top(&self, painter: &mut Painter, xs: &[f64], side: f64) {
        let length_m = self.kind.length_m;
        // A pillar stands beside the windscreen.
        let mut vs = painter.refined(&[1.0, 1.0 + PILLAR]);
        vs.extend(painter.even(1.0 + PILLAR, 2.0, 0.34).into_iter().skip(1));
        painter.sheet(
            &facing(xs, -side),
            &vs,
            |u, v| self.cabin_at(-side * u, v, side),
            |u, v| {
                let x = -side * u / length_m;
                let is_screen = v > 1.0 + PILLAR
                    && (within(x, self.kind.windscreen) || within(x, self.kind.rear_glass));
                Some(if is_screen { glass() } else { self.paint.times(1.06) })
            },
        );
    }

    /// The shaded ground between the wheels, 2 cm above the road.
    fn shade_below(&self, painter: &mut Painter) {
        let half_m = 0.5 * self.kind.width_m;
        let length_m = self.kind.length_m;
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

pub(super) fn within(x: f64, [from, to]: [f64; 2]) -> bool {
    (from..to).contains(&x)
}

/// Break points run forwards for `sign` 1; for -1 mirrored, so that they still increase.
pub(super) fn facing(xs: &[f64], sign: f64) -> Vec<f64> {
    if sign > 0.0 { xs.to_vec() } else { xs.iter().rev().map(|x_m| -x_m).collect() }
}

pub(super) fn glass() -> Paint {
    Paint::matt(0.13, 0.16, 0.19).gloss(0.36)
}
