//! The ground between the houses: carriageway, markings, parking, kerbs, pavements, the crossing.

use glam::DVec3;

use super::random::{Random, noise, smooth};
use super::route::{Route, Station};
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// Half width of the two lanes together, in metres: twice 3.6 m.
pub(super) const LANES_M: f64 = 3.6;
/// Distance from the centre line at which the parking bays end and the kerb begins, in metres.
pub(super) const KERB_M: f64 = 5.8;
/// Width of the kerb stones, in metres.
const KERB_STONE_M: f64 = 0.15;
/// Distance from the centre line at which the pavements end and the houses begin, in metres.
pub(super) const FRONT_M: f64 = 9.4;
/// Height of the pavement, in metres.
pub(super) const PAVEMENT_M: f64 = 0.12;
/// The middle of the driven lane, in metres left of the centre line: the right lane.
pub(super) const LANE_T_M: f64 = -1.75;

/// Half width of the side street's carriageway, in metres.
pub(super) const SIDE_LANES_M: f64 = 3.5;
/// From the side street's middle line to its houses, in metres.
pub(super) const SIDE_FRONT_M: f64 = 6.2;
/// Length of the side street to either side, in metres from the centre line.
pub(super) const SIDE_REACH_M: f64 = 82.0;

/// Distance of the zebra crossings from the middle of the crossing, in metres.
pub(super) const ZEBRA_M: [f64; 2] = [6.4, 9.6];
/// Distance of the stop lines from the middle of the crossing, in metres.
pub(super) const STOP_M: [f64; 2] = [10.8, 11.2];
/// No lane marks within this distance of the middle of the crossing, in metres.
const JUNCTION_M: f64 = 11.2;
/// Length of a dash of the centre line and of the gap after it, in metres.
const DASH_M: f64 = 3.0;
/// Half width of the centre line, in metres.
const LINE_M: f64 = 0.065;
/// Width of a zebra stripe and of the gap next to it, in metres.
const STRIPE_M: f64 = 0.48;
/// Pavement slabs are squares of this side, in metres.
const SLAB_M: f64 = 0.90;

/// Paints all ground along the street; `cross_s_m` is the middle of the crossing. `seed` is that of
/// the surface grain, `covers_seed` that of the manhole covers.
pub(super) fn paint(
    painter: &mut Painter,
    route: &Route,
    cross_s_m: f64,
    [seed, covers_seed]: [u64; 2],
) {
    let ground = Ground { route, cross_s_m, seed, covers_seed };
    ground.covers().for_each(|(s_m, t_m)| ground.cover(painter, s_m, t_m));
    ground.cracks(painter);
    let drive = route.driven_m;
    // The stretches with zebra and stop line before and after the crossing, ascending in s.
    let [approach, leave] = [-1.0, 1.0].map(|side| {
        let near = cross_s_m + side * ZEBRA_M[0];
        let far = cross_s_m + side * STOP_M[1];
        [near.min(far), near.max(far)]
    });
    ground.lanes(painter, drive[0], approach[0]);
    ground.zebra(painter, approach);
    ground.lanes(painter, approach[1], leave[0]);
    ground.zebra(painter, leave);
    ground.lanes(painter, leave[1], drive[1]);
    for side in [-1.0, 1.0] {
        ground.verge(painter, side, drive[0], cross_s_m - SIDE_LANES_M);
        ground.verge(painter, side, cross_s_m + SIDE_LANES_M, drive[1]);
        ground.side_street(painter, side);
    }
    // Beyond the drive's ends, which no camera comes close to.
    painter.coarser(2.2, |painter| {
        let beyond = [[route.ends_m[0], drive[0]], [drive[1], route.ends_m[1]]];
        for [from_m, to_m] in beyond.into_iter().filter(|[from_m, to_m]| from_m < to_m) {
            ground.lanes(painter, from_m, to_m);
            for side in [-1.0, 1.0] {
                ground.verge(painter, side, from_m, to_m);
            }
        }
    });
}

struct Ground<'a> {
    route: &'a Route,
    cross_s_m: f64,
    seed: u64,
    covers_seed: u64,
}

impl Ground<'_> {
    /// Both lanes, their lines included.
    fn lanes(&self, painter: &mut Painter, from_s_m: f64, to_s_m: f64) {
        // Narrow cells beside the lines keep their edges sharp.
        let inner = painter.graded(LINE_M, LANES_M - 0.12, 0.06, 0.42);
        // From the right edge to the left: edge line, lane, centre line, lane, edge line.
        let edge = [LANES_M - 0.095, LANES_M - 0.025, LANES_M];
        let ts: Vec<_> = edge
            .iter()
            .rev()
            .chain(inner.iter().rev())
            .map(|t_m| -t_m)
            .chain([-LINE_M + 0.025, LINE_M - 0.025])
            .chain(inner.iter().copied())
            .chain(edge)
            .collect();
        // A dash is six cells long; the phase holds from one stretch to the next.
        let cell_m = (painter.even(0.0, DASH_M, DASH_M / 6.0)[1]).min(DASH_M);
        let first = (from_s_m / cell_m).ceil();
        let last = (to_s_m / cell_m).floor();
        let mut ss = vec![from_s_m];
        ss.extend((first as i64..=last as i64).map(|i| i as f64 * cell_m));
        // Not closer to an end than 0.3 cells: no sliver there.
        ss.retain(|s_m| s_m - from_s_m > 0.3 * cell_m && to_s_m - s_m > 0.3 * cell_m);
        ss.insert(0, from_s_m);
        ss.push(to_s_m);
        self.flat(painter, &ss, &ts, 0.0, |s_m, t_m| self.lane_paint(s_m, t_m));
    }

    /// The lanes where pedestrians cross, with the stop line in front of the crossing.
    fn zebra(&self, painter: &mut Painter, [from_s_m, to_s_m]: [f64; 2]) {
        let mut ts = vec![-LANES_M];
        while let Some(&t_m) = ts.last().filter(|&&t_m| t_m < LANES_M - 0.1) {
            let next_m = (t_m + STRIPE_M).min(LANES_M);
            ts.extend(painter.graded(t_m, next_m, 0.07, 0.2).into_iter().skip(1));
        }
        let ss = painter.graded(from_s_m, to_s_m, 0.10, 0.22);
        self.flat(painter, &ss, &ts, 0.0, |s_m, t_m| self.lane_paint(s_m, t_m));
    }

    /// Positions of manholes: one every 31 m, next to the wheel tracks of either lane.
    fn covers(&self) -> impl Iterator<Item = (f64, f64)> + use<> {
        let seed = self.covers_seed;
        let cross_s_m = self.cross_s_m;
        let [from_m, to_m] = self.route.driven_m;
        (0..((to_m - from_m) / 31.0) as usize).filter_map(move |index| {
            let mut random = Random::new(seed, "manhole", index);
            let s_m = from_m + 31.0 * (index as f64 + random.range(0.2, 0.8));
            let t_m = random.pick(&[-1.0, 1.0]) * random.range(1.5, 2.0);
            // None in the junction, whose marks it would cut.
            ((s_m - cross_s_m).abs() > JUNCTION_M + 1.0).then_some((s_m, t_m))
        })
    }

    /// A manhole cover: a ring and ribs of iron.
    fn cover(&self, painter: &mut Painter, s_m: f64, t_m: f64) {
        let around = painter.even(0.0, std::f64::consts::TAU, std::f64::consts::TAU / 14.0);
        let rings = [0.0, 0.09, 0.18, 0.27, 0.32, COVER_M];
        let place = |angle_rad: f64, radius_m: f64| {
            let (sin, cos) = angle_rad.sin_cos();
            // Turning clockwise, u × v looks up.
            self.route.at(s_m + radius_m * cos).beside(t_m - radius_m * sin, 0.008)
        };
        painter.sheet(&around, &rings, place, |angle_rad, radius_m| {
            let rib = (angle_rad * 14.0 / std::f64::consts::TAU + radius_m / 0.09) as i64 % 2 == 0;
            let ring = radius_m > 0.27;
            let tone = if ring {
                0.46
            } else if rib {
                0.24
            } else {
                0.33
            };
            Some(Paint::matt(tone, 0.98 * tone, 0.95 * tone).gloss(0.08))
        });
    }

    /// Cracks that were filled with tar: dark lines that wander along the lanes.
    fn cracks(&self, painter: &mut Painter) {
        let [from_m, to_m] = self.route.driven_m;
        for index in 0..((to_m - from_m) / CRACK_M) as usize {
            let mut random = Random::new(self.covers_seed, "crack", index);
            let mut s_m = from_m + CRACK_M * (index as f64 + random.range(0.0, 0.6));
            let mut t_m = random.range(-LANES_M + 0.4, LANES_M - 0.4);
            let along = random.chance(0.6);
            let mut places_m = Vec::new();
            for _ in 0..6 + random.below(9) {
                places_m.push(self.route.at(s_m).beside(t_m, 0.012));
                let ahead_m = random.range(0.25, 0.4);
                let aside_m = random.range(-0.14, 0.14);
                let [ds_m, dt_m] = if along { [ahead_m, aside_m] } else { [aside_m, ahead_m] };
                (s_m, t_m) = (s_m + ds_m, t_m + dt_m);
                if t_m.abs() > LANES_M - 0.25 || (t_m.abs() < 0.2) {
                    break;
                }
            }
            let tar = Paint::matt(0.24, 0.24, 0.25).gloss(0.06);
            painter.polyline(&places_m, DVec3::Z, [0.035, 0.45], tar);
        }
    }

    /// Asphalt or marking at a point of the lanes.
    fn lane_paint(&self, s_m: f64, t_m: f64) -> Option<Paint> {
        let covered = |(at_s_m, at_t_m): (f64, f64)| {
            (s_m - at_s_m).powi(2) + (t_m - at_t_m).powi(2) < (0.75 * COVER_M).powi(2)
        };
        if self.covers().any(covered) {
            return None;
        }
        let ahead_m = s_m - self.cross_s_m;
        let away_m = ahead_m.abs();
        let on_line = if (ZEBRA_M[0]..ZEBRA_M[1]).contains(&away_m) {
            ((t_m + LANES_M) / STRIPE_M) as i64 % 2 == 0
        } else if (STOP_M[0]..STOP_M[1]).contains(&away_m) {
            // Each lane stops before the crossing, on its own side of the centre line.
            t_m * ahead_m > 0.0 && t_m.abs() < LANES_M - 0.1
        } else if away_m < JUNCTION_M {
            false
        } else if t_m.abs() < LINE_M {
            let solid = away_m < JUNCTION_M + 18.0;
            solid || (s_m / DASH_M).floor() as i64 % 2 == 0
        } else {
            t_m.abs() > LANES_M - 0.12
        };
        // Worn away in patches.
        let worn = 0.10 * noise(self.seed + 1, 2.1 * s_m, 2.1 * t_m)
            + 0.08 * noise(self.seed + 2, 0.4 * s_m, 7.0 * t_m);
        Some(if on_line {
            Paint::matt(0.86, 0.86, 0.83).times(0.94 + worn).gloss(0.04)
        } else {
            self.asphalt(s_m, t_m)
        })
    }

    /// Asphalt with grain, wheel tracks, repaired patches and oil in the middle of each lane.
    fn asphalt(&self, s_m: f64, t_m: f64) -> Paint {
        let grain = 0.15 * noise(self.seed + 3, 4.0 * s_m, 4.0 * t_m)
            + 0.05 * noise(self.seed + 4, 0.35 * s_m, 0.9 * t_m)
            + 0.03 * noise(self.seed + 5, 0.05 * s_m, 0.3 * t_m);
        let off_lane_m = t_m.abs() - LANE_T_M.abs();
        // Two wheel tracks 0.8 m to either side of the lane's middle, and oil between them.
        let track = 0.03 * (1.0 - smooth((off_lane_m.abs() - 0.8).abs() / 0.35));
        let oil = -0.05 * (1.0 - smooth(off_lane_m.abs() / 0.5));
        // Some areas are repaired trenches.
        let trench = noise(self.seed + 6, (s_m / 9.0).floor(), (t_m / 1.8).floor());
        let patch = if trench > 0.72 { -0.15 } else { 0.0 };
        Paint::matt(0.400, 0.402, 0.412).times(1.0 + grain + track + oil + patch).gloss(0.10)
    }

    /// Parking, kerb and pavement of one side: `side` is 1 on the left, -1 on the right.
    fn verge(&self, painter: &mut Painter, side: f64, from_s_m: f64, to_s_m: f64) {
        let side_of = |ts: Vec<f64>| oriented(side, ts);
        let ss = painter.even(from_s_m, to_s_m, 0.52);
        let beside_m = LANES_M + 0.06;
        let mut columns = vec![LANES_M];
        columns.extend(painter.even(beside_m, KERB_M, 0.42));
        let bays = side_of(columns);
        self.flat(painter, &ss, &bays, 0.0, |s_m, t_m| {
            let gutter = smooth((t_m.abs() - (KERB_M - 0.5)) / 0.5);
            // The pattern of the asphalt, three times as fine across.
            let tint = self.asphalt(s_m, 3.0 * t_m).times(0.93);
            Some(tint.times(1.0 - 0.15 * gutter).open(1.0 - 0.25 * gutter))
        });
        painter.labelled(SemanticClass::Sidewalk, |painter| {
            self.kerb(painter, side, from_s_m, to_s_m);
            self.slabs(painter, side, from_s_m, to_s_m);
        });
    }

    /// The kerb stones of one side.
    fn kerb(&self, painter: &mut Painter, side: f64, from_s_m: f64, to_s_m: f64) {
        let stone = |s_m: f64| {
            let tone = noise(self.seed + 7, s_m.floor(), side);
            Paint::matt(0.66, 0.65, 0.63).times(1.0 + 0.06 * tone)
        };
        let top_m = [KERB_M, KERB_M + 0.5 * KERB_STONE_M, KERB_M + KERB_STONE_M];
        let stones = painter.even(from_s_m, to_s_m, 0.5);
        self.flat(painter, &stones, &oriented(side, top_m.to_vec()), PAVEMENT_M, |s_m, _| {
            Some(stone(s_m))
        });
        // The kerb faces the road.
        let along = oriented(side, stones);
        let up = [0.0, 0.5 * PAVEMENT_M, PAVEMENT_M];
        painter.sheet(
            &along,
            &up,
            |s_m, z_m| self.route.at(s_m * side).beside(side * KERB_M, z_m),
            |s_m, z_m| Some(stone(s_m * side).times(0.9).open(0.6 + 3.0 * z_m)),
        );
    }

    /// The pavement: slabs in slightly different tones with dark joints.
    fn slabs(&self, painter: &mut Painter, side: f64, from_s_m: f64, to_s_m: f64) {
        let near_m = KERB_M + KERB_STONE_M;
        let far_m = FRONT_M;
        let slab = |s_m: f64, t_m: f64| {
            let tone = noise(self.seed + 8, (s_m / SLAB_M).floor(), (t_m / SLAB_M).floor());
            let dirt = 0.04 * noise(self.seed + 9, 0.8 * s_m, 0.8 * t_m);
            let wall = smooth((FRONT_M - t_m.abs()) / 0.8);
            let cool = DVec3::new(0.02, 0.0, -0.02) * noise(self.seed + 10, s_m, t_m);
            let mut paint = Paint::matt(0.600, 0.585, 0.560).times(1.0 + 0.07 * tone + dirt);
            paint.rgb += cool;
            paint.open(0.72 + 0.28 * wall)
        };
        // Two by two cells a slab, and a joint of 3 cm on two of its sides.
        let rows = joints(painter, near_m, far_m);
        let columns = joints(painter, from_s_m, to_s_m);
        let ts = oriented(side, rows);
        self.flat(painter, &columns, &ts, PAVEMENT_M, |s_m, t_m| {
            let joint = |x_m: f64| x_m.rem_euclid(SLAB_M) < JOINT_M;
            let dark = joint(s_m) || joint(t_m.abs() - near_m);
            Some(if dark { slab(s_m, t_m).times(0.66) } else { slab(s_m, t_m) })
        });
    }

    /// The side street to one side of the crossing: asphalt, kerbs and pavements.
    fn side_street(&self, painter: &mut Painter, side: f64) {
        let crossing = self.route.at(self.cross_s_m);
        // In the side street's own axes: x away from the main street, y to the left of that.
        let place = |x_m: f64, y_m: f64, z_m: f64| {
            crossing.point_m
                + side * (x_m * crossing.left - y_m * crossing.forward)
                + z_m * DVec3::Z
        };
        let mut stretch = |from_m: f64, to_m: f64, factor: f64| {
            painter.coarser(factor, |painter| {
                let xs = painter.even(from_m, to_m, 0.40);
                let line = [-LINE_M, 0.0, LINE_M];
                let lane = painter.graded(LINE_M, SIDE_LANES_M, 0.12, 0.32);
                let mut ys: Vec<_> = lane.iter().rev().map(|y_m| -y_m).collect();
                ys.extend([line[1]]);
                ys.extend(lane);
                painter.sheet(
                    &xs,
                    &ys,
                    |x_m, y_m| place(x_m, y_m, 0.0),
                    |x_m, y_m| {
                        let dash = x_m > KERB_M + 4.0 && (x_m / 2.0) as i64 % 2 == 0;
                        let on_line = y_m.abs() < LINE_M && dash;
                        let line = Paint::matt(0.84, 0.84, 0.81);
                        Some(if on_line { line } else { self.asphalt(x_m + 400.0, y_m) })
                    },
                );
            });
        };
        stretch(LANES_M, 24.0, 1.0);
        stretch(24.0, SIDE_REACH_M, 1.8);

        // Kerb and pavement along the side street, from the main street's pavement on.
        painter.labelled(SemanticClass::Sidewalk, |painter| {
            painter.coarser(1.5, |painter| {
                for edge in [-1.0, 1.0] {
                    let xs = painter.even(KERB_M, SIDE_REACH_M, 0.6);
                    let top = [SIDE_LANES_M, SIDE_LANES_M + KERB_STONE_M];
                    let kerb = Paint::matt(0.66, 0.65, 0.63);
                    let flat = |x_m: f64, y_m: f64| place(x_m, y_m, PAVEMENT_M);
                    painter.sheet(&xs, &oriented(edge, top.to_vec()), flat, |_, _| Some(kerb));
                    let face = |x_m: f64, z_m: f64| place(edge * x_m, edge * SIDE_LANES_M, z_m);
                    painter.sheet(&oriented(edge, xs), &[0.0, PAVEMENT_M], face, |_, _| {
                        Some(kerb.times(0.9).open(0.7))
                    });
                    let xs = painter.even(FRONT_M, SIDE_REACH_M, 0.5);
                    let ys = painter.even(SIDE_LANES_M + KERB_STONE_M, SIDE_FRONT_M, 0.4);
                    painter.sheet(&xs, &oriented(edge, ys), flat, |x_m, y_m| {
                        let tone = noise(self.seed + 11, 1.4 * x_m, 1.4 * y_m);
                        let wall = smooth((SIDE_FRONT_M - y_m.abs()) / 0.8);
                        let slab = Paint::matt(0.590, 0.575, 0.550).times(1.0 + 0.05 * tone);
                        Some(slab.open(0.75 + 0.25 * wall))
                    });
                }
            });
        });
    }

    /// A level sheet at height `z_m` in the street's own coordinates.
    fn flat(
        &self,
        painter: &mut Painter,
        ss: &[f64],
        ts: &[f64],
        z_m: f64,
        paint: impl FnMut(f64, f64) -> Option<Paint>,
    ) {
        let place = |s_m: f64, t_m: f64| Station::beside(&self.route.at(s_m), t_m, z_m);
        painter.sheet(ss, ts, place, paint);
    }
}

/// Distance between two cracks along the street, in metres.
const CRACK_M: f64 = 2.5;

/// Radius of a manhole cover, in metres.
const COVER_M: f64 = 0.37;

/// Width of a pavement joint, in metres.
const JOINT_M: f64 = 0.03;

/// Break points of joints and slabs: a joint begins at every multiple of the slab from zero on the
/// street's long axis, or from `from_m` where the pavement begins on the short one.
fn joints(painter: &Painter, from_m: f64, to_m: f64) -> Vec<f64> {
    let long = to_m - from_m > 20.0;
    let first_m = if long { (from_m / SLAB_M).ceil() * SLAB_M } else { from_m };
    let slabs = painter.even(JOINT_M, SLAB_M, SLAB_M);
    let mut breaks = vec![from_m];
    let mut at_m = first_m;
    while at_m < to_m {
        breaks.push(at_m);
        breaks.extend(slabs.iter().map(|step_m| at_m + step_m));
        at_m += SLAB_M;
    }
    breaks.push(to_m);
    breaks.retain(|&b_m| (from_m..=to_m).contains(&b_m));
    breaks.dedup_by(|b, a| *b - *a < 0.02);
    breaks
}

/// Break points on the side of the street where t has this sign, in increasing order.
fn oriented(side: f64, mut breaks: Vec<f64>) -> Vec<f64> {
    if side < 0.0 {
        // Mirrored and reversed: increasing again, as `sheet` needs them.
        breaks.reverse();
        breaks.iter_mut().for_each(|b| *b = -*b);
    }
    breaks
}
