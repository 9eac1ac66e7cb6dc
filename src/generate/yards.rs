//! The yards behind the houses: paving, lawn, fences, sheds, trees and washing.

use glam::DVec3;

use super::buildings::DEPTH_M;
use super::plants::Tree;
use super::random::{Random, noise};
use super::road::{FRONT_M, SIDE_FRONT_M};
use super::route::{Route, Station};
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// From the back of the houses to the fence at the end of the yards, in metres from the centre
/// line.
const YARDS_M: [f64; 2] = [FRONT_M + DEPTH_M, FRONT_M + DEPTH_M + 22.0];
/// End of the paving behind the houses, in metres from the centre line.
const PAVED_M: f64 = YARDS_M[0] + 5.0;
/// Width of a yard along the street, in metres.
const YARD_M: f64 = 14.0;
/// Height of a fence, in metres.
const FENCE_M: f64 = 1.7;

/// Yards along the driven part of the street, clear of the houses of the side street.
pub(super) fn paint(painter: &mut Painter, route: &Route, crossing_m: f64, seed: u64) {
    // The houses of the side street, and a strip for their own backs.
    let clear_m = SIDE_FRONT_M + DEPTH_M + 0.5;
    let [from_m, to_m] = route.driven_m;
    let stretches = [[from_m - 12.0, crossing_m - clear_m], [crossing_m + clear_m, to_m + 12.0]];
    for (side, name) in [(-1.0, "yard, right"), (1.0, "yard, left")] {
        let mut index = 0;
        for [from_m, to_m] in stretches.into_iter().filter(|[from_m, to_m]| to_m - from_m > YARD_M)
        {
            // At least one: shorter stretches are left out above.
            let count = ((to_m - from_m) / YARD_M) as usize;
            let width_m = (to_m - from_m) / count as f64;
            for plot in 0..count {
                let from_m = from_m + plot as f64 * width_m;
                let yard = Yard { route, side, s_m: [from_m, from_m + width_m], seed };
                yard.paint(painter, Random::new(seed, name, index));
                index += 1;
            }
        }
    }
}

struct Yard<'a> {
    route: &'a Route,
    /// 1 on the left of the street, -1 on its right.
    side: f64,
    /// First and last station.
    s_m: [f64; 2],
    seed: u64,
}

impl Yard<'_> {
    /// A point `away_m` from the centre line.
    fn at(&self, s_m: f64, away_m: f64, z_m: f64) -> DVec3 {
        Station::beside(&self.route.at(s_m), self.side * away_m, z_m)
    }

    fn paint(&self, painter: &mut Painter, mut random: Random) {
        painter.labelled(SemanticClass::Terrain, |painter| self.ground(painter));
        painter.labelled(SemanticClass::Fence, |painter| {
            let wood = Paint::matt(0.50, 0.38, 0.27).times(random.range(0.85, 1.2));
            let [from_m, to_m] = self.s_m;
            self.fence(painter, [[to_m, PAVED_M], [to_m, YARDS_M[1]]], wood);
            self.fence(painter, [[from_m, YARDS_M[1]], [to_m, YARDS_M[1]]], wood);
        });
        if random.chance(0.6) {
            painter.labelled(SemanticClass::Building, |painter| self.shed(painter, &mut random));
        }
        if random.chance(0.5) {
            painter.labelled(SemanticClass::Static, |painter| self.washing(painter, &mut random));
        }
        if random.chance(0.5) {
            let s_m = self.s_m[0] + random.range(3.0, self.s_m[1] - self.s_m[0] - 3.0);
            let foot_m = self.at(s_m, random.range(PAVED_M + 4.0, YARDS_M[1] - 3.5), 0.0);
            let tree = Tree::new(foot_m, false, random);
            painter.labelled(SemanticClass::Vegetation, |painter| tree.paint(painter));
        }
    }

    /// Slabs of concrete next to the house, then grass with bare places.
    fn ground(&self, painter: &mut Painter) {
        let mut stretch =
            |[from_m, to_m]: [f64; 2], step_m: f64, paint: &dyn Fn(f64, f64) -> Paint| {
                let ss = painter.even(self.s_m[0], self.s_m[1], step_m);
                let mut depths_m: Vec<f64> = painter.even(from_m, to_m, step_m);
                if self.side < 0.0 {
                    // On the right, too, t is the distance to the left: with s along the street, it
                    // faces up.
                    depths_m = depths_m.iter().rev().map(|away_m| -away_m).collect();
                }
                let place = |s_m: f64, t_m: f64| self.at(s_m, t_m * self.side, 0.0);
                painter.sheet(&ss, &depths_m, place, |s_m, t_m| Some(paint(s_m, t_m)));
            };
        stretch([YARDS_M[0] - 0.6, PAVED_M], 1.2, &|s_m, t_m| {
            let slab = noise(self.seed + 31, s_m.floor(), t_m.floor());
            Paint::matt(0.55, 0.53, 0.50).times(1.0 + 0.08 * slab)
        });
        stretch([PAVED_M, YARDS_M[1] + 0.5], 2.0, &|s_m, t_m| {
            let bare = noise(self.seed + 32, 0.35 * s_m, 0.35 * t_m);
            let tuft = noise(self.seed + 33, 2.0 * s_m, 2.0 * t_m);
            let grass = DVec3::new(0.36, 0.46, 0.24) * (1.0 + 0.12 * tuft);
            let rgb = grass.lerp(DVec3::new(0.46, 0.40, 0.30), (0.8 * bare).clamp(0.0, 0.6));
            Paint::matt(rgb.x, rgb.y, rgb.z)
        });
    }

    /// Boards between two points (s, away), seen from both sides.
    fn fence(&self, painter: &mut Painter, ends: [[f64; 2]; 2], wood: Paint) {
        let [from_m, to_m] = ends.map(|[s_m, away_m]| self.at(s_m, away_m, 0.0));
        let length_m = from_m.distance(to_m);
        let along = (to_m - from_m) / length_m;
        let us = painter.even(0.0, length_m, 1.3);
        for sign in [1.0, -1.0] {
            let off = 0.02 * sign * along.cross(DVec3::Z);
            let place = |u_m: f64, v_m: f64| {
                // The other side runs backwards, so that it faces the other way.
                let along_m = if sign > 0.0 { u_m } else { length_m - u_m };
                from_m + along_m * along + v_m * DVec3::Z + off
            };
            painter.sheet(&us, &[0.0, 0.85, FENCE_M], place, |u_m, _| {
                Some(wood.times(1.0 + 0.12 * noise(self.seed + 34, 1.1 * u_m, from_m.x)))
            });
        }
        for post in 0..=(length_m / 2.4) as i32 {
            let foot_m = from_m + 2.4 * f64::from(post) * along;
            let out = along.cross(DVec3::Z);
            let ends_m = [foot_m + 0.05 * out, foot_m + 0.05 * out + 1.8 * DVec3::Z];
            painter.stroke(ends_m, out, 0.12, wood.times(0.7));
        }
        let top = [from_m, to_m].map(|end_m| end_m + (FENCE_M + 0.03) * DVec3::Z);
        painter.polyline(&top, DVec3::Z, [0.10, 1.8], wood.times(0.8));
    }

    /// A shed against the fence at the end of the yard, with a door and a sloping roof.
    fn shed(&self, painter: &mut Painter, random: &mut Random) {
        let wood = random.pick(&[
            Paint::matt(0.46, 0.30, 0.22),
            Paint::matt(0.36, 0.42, 0.36),
            Paint::matt(0.60, 0.56, 0.48),
        ]);
        let half_m = 1.5;
        let deep_m = 2.4;
        // Its height in front and behind.
        let front_m = 2.3;
        let rear_m = 2.0;
        let middle_m = self.s_m[0] + random.range(2.5, self.s_m[1] - self.s_m[0] - 2.5);
        let away_m = YARDS_M[1] - 0.5;
        let corners = [
            [middle_m + half_m, away_m - deep_m],
            [middle_m - half_m, away_m - deep_m],
            [middle_m - half_m, away_m],
            [middle_m + half_m, away_m],
        ];
        let tops_m = [front_m, front_m, rear_m, rear_m];
        for wall in 0..4 {
            let from = corners[wall];
            let to = corners[(wall + 1) % 4];
            let from_top_m = tops_m[wall];
            let to_top_m = tops_m[(wall + 1) % 4];
            // Outwards on the left of the street; on its right the corners turn the other way.
            let part = |u: f64| if self.side > 0.0 { u } else { 1.0 - u };
            let place = |u: f64, v: f64| {
                let t = part(u);
                let at = |k: usize| from[k] + t * (to[k] - from[k]);
                self.at(at(0), at(1), v * (from_top_m + t * (to_top_m - from_top_m)))
            };
            let us = painter.even(0.0, 1.0, 0.25);
            painter.sheet(&us, &[0.0, 0.3, 0.65, 1.0], place, |u, _| {
                Some(wood.times(1.0 + 0.1 * noise(self.seed + 35, 9.0 * u, wall as f64)))
            });
        }
        let door = |z_m: f64| self.at(middle_m, away_m - deep_m - 0.06, z_m);
        let out = -self.side * self.route.at(middle_m).left;
        painter.stroke([door(0.1), door(1.95)], out, 0.9, wood.times(0.55));
        let eaves_m = 0.2;
        let ss = [middle_m - half_m - eaves_m, middle_m, middle_m + half_m + eaves_m];
        let ts = [0.0, 0.33, 0.67, 1.0].map(|t| if self.side > 0.0 { t } else { t - 1.0 });
        let roof = |s_m: f64, t: f64| {
            let back = t.abs();
            let behind_m = back * (deep_m + 2.0 * eaves_m) - deep_m - eaves_m;
            self.at(s_m, away_m + behind_m, front_m + 0.06 + back * (rear_m - front_m))
        };
        painter.sheet(&ss, &ts, roof, |_, _| Some(Paint::matt(0.30, 0.29, 0.30)));
    }

    /// Two posts, a line, and cloths that hang on it.
    fn washing(&self, painter: &mut Painter, random: &mut Random) {
        let away_m = PAVED_M + 1.5;
        let from_m = self.s_m[0] + 3.0;
        let to_m = self.s_m[0] + 9.0;
        let out = self.side * self.route.at(from_m).left;
        for s_m in [from_m, to_m] {
            let ends_m = [self.at(s_m, away_m, 0.0), self.at(s_m, away_m, 2.0)];
            painter.polyline(&ends_m, out, [0.08, 1.0], Paint::matt(0.42, 0.43, 0.44));
        }
        let line = [from_m, to_m].map(|s_m| self.at(s_m, away_m, 1.9));
        painter.polyline(&line, out, [0.015, 1.5], Paint::matt(0.75, 0.75, 0.74));
        let mut s_m = from_m + 0.6;
        while s_m < to_m - 1.0 {
            let wide_m = random.range(0.5, 0.9);
            let long_m = random.range(0.6, 1.2);
            let cloth = random.pick(&[
                Paint::matt(0.92, 0.92, 0.90),
                Paint::matt(0.70, 0.78, 0.88),
                Paint::matt(0.86, 0.62, 0.58),
            ]);
            for part in [0.25, 0.75] {
                let at = |z_m: f64| self.at(s_m + part * wide_m, away_m, z_m);
                painter.stroke([at(1.88 - long_m), at(1.88)], out, 0.55 * wide_m, cloth);
            }
            s_m += wide_m + random.range(0.1, 0.7);
        }
    }
}
