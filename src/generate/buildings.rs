//! Houses: their positions, roofs and side walls.

use glam::{DMat3, DQuat, DVec3};

use super::facade::{self, GroundFloor, Style, Wall};
use super::light::Occluder;
use super::random::{Random, noise};
use super::road::{FRONT_M, SIDE_FRONT_M, SIDE_REACH_M};
use super::route::Route;
use super::surface::{Paint, Painter};

/// Depth of a house behind its front, in metres.
pub(super) const DEPTH_M: f64 = 13.0;
/// Narrowest and widest front, in metres.
const FRONTS_M: [f64; 2] = [9.0, 17.0];

/// A house, not yet painted.
#[derive(Clone, Debug)]
pub(super) struct Building {
    front: Wall,
    style: Style,
    /// Sides with windows, because they face a street: left and right as seen from the front.
    open_sides: [bool; 2],
    /// Height of the neighbours, in metres: only the part of a side above it is visible.
    neighbours_m: [f64; 2],
    spacing: f64,
    random: Random,
}

/// All houses along the street and the side street; `cross_s_m` is the middle of the crossing.
pub(super) fn plan(route: &Route, cross_s_m: f64, seed: u64) -> Vec<Building> {
    let mut buildings = Vec::new();
    let mut row = |name: &str, ends_m: [f64; 2], at: &dyn Fn(f64) -> DVec3, open: [bool; 2]| {
        let mut random = Random::new(seed, name, 0);
        let breaks_m = fronts(&mut random, ends_m);
        let first = buildings.len();
        for (index, pair) in breaks_m.windows(2).enumerate() {
            // A wall is given by two ground points, so that a row may follow a bend.
            let front = Wall::between(at(pair[0]), at(pair[1]));
            // A stream of its own for each house: another width of one changes no other house.
            let mut random = Random::new(seed, name, index + 1);
            let main = name.starts_with("main");
            let style = style(&mut random, main);
            // Houses where no camera drives are coarser: 2.5 times the spacing takes a sixth of the
            // Gaussians.
            let (s_m, _) = route.project(front.at(0.5 * front.width_m, 0.0, 0.0));
            let beyond_m = route.beyond_m(s_m);
            let near = main && beyond_m < 32.0;
            let spacing = if main && beyond_m < 6.0 {
                1.0
            } else if near {
                1.4
            } else {
                2.5
            };
            let style = Style { near, ..style };
            let last = index + 2 == breaks_m.len();
            buildings.push(Building {
                front,
                style,
                // Only the outer sides of a row's first and last house face a street.
                open_sides: [open[0] && index == 0, open[1] && last],
                neighbours_m: [0.0; 2],
                spacing,
                random,
            });
        }
        // Only within the row: corner houses of two rows are not neighbours.
        for index in first..buildings.len() {
            if index > first {
                buildings[index].neighbours_m[0] = buildings[index - 1].style.height_m();
            }
            if index + 1 < buildings.len() {
                buildings[index].neighbours_m[1] = buildings[index + 1].style.height_m();
            }
        }
    };

    let ends_m = route.ends_m;
    let gap_m = [cross_s_m - SIDE_FRONT_M, cross_s_m + SIDE_FRONT_M];
    // Seen from the street, the left row runs along s and the right row against it.
    let left = |s_m: f64| route.at(s_m).beside(FRONT_M, 0.0);
    let right = |s_m: f64| route.at(-s_m).beside(-FRONT_M, 0.0);
    row("main left, before", [ends_m[0], gap_m[0]], &left, [false, true]);
    row("main left, after", [gap_m[1], ends_m[1]], &left, [true, false]);
    row("main right, before", [-gap_m[0], -ends_m[0]], &right, [true, false]);
    row("main right, after", [-ends_m[1], -gap_m[1]], &right, [false, true]);

    // The side street begins behind the corner houses.
    let crossing = route.at(cross_s_m);
    // In the axes of the crossing, since the side street is straight.
    let side_point = |t_m: f64, d_m: f64| crossing.beside(t_m, 0.0) + d_m * crossing.forward;
    let near_m = FRONT_M + DEPTH_M;
    let far_m = SIDE_REACH_M;
    let before = |t_m: f64| side_point(t_m, -SIDE_FRONT_M);
    let after = |t_m: f64| side_point(-t_m, SIDE_FRONT_M);
    row("side left, before", [near_m, far_m], &before, [false; 2]);
    row("side right, before", [-far_m, -near_m], &before, [false; 2]);
    row("side left, after", [-far_m, -near_m], &after, [false; 2]);
    row("side right, after", [near_m, far_m], &after, [false; 2]);

    // A house across every end closes the view.
    let across = |d_m: f64| side_point(SIDE_REACH_M, d_m);
    row("end of the side street, left", [-13.0, 13.0], &across, [false; 2]);
    let across = |d_m: f64| side_point(-SIDE_REACH_M, -d_m);
    row("end of the side street, right", [-13.0, 13.0], &across, [false; 2]);
    if route.closed[1] {
        let across = |t_m: f64| route.at(ends_m[1]).beside(-t_m, 0.0);
        row("end of the street, ahead", [-22.0, 22.0], &across, [false; 2]);
    }
    if route.closed[0] {
        let across = |t_m: f64| route.at(ends_m[0]).beside(t_m, 0.0);
        row("end of the street, behind", [-22.0, 22.0], &across, [false; 2]);
    }
    buildings
}

impl Building {
    /// The body that casts the house's shadow.
    pub(super) fn occluder(&self) -> Occluder {
        let Wall { width_m, right, .. } = self.front;
        // The middle of the ground plan: half the depth behind the front.
        let base_m = self.front.at(0.5 * width_m, 0.0, -0.5 * DEPTH_M);
        let height_m = self.style.height_m() + 1.0;
        Occluder::Block {
            base_m,
            along: right,
            // 2 cm less deep than the house, or its own front would lie in its shadow.
            size_m: DVec3::new(0.5 * width_m, 0.5 * DEPTH_M - 0.02, height_m),
        }
    }

    /// Paints front, sides and roof.
    pub(super) fn paint(&self, painter: &mut Painter) {
        // A copy of the stream: a house that is painted twice looks the same.
        let mut random = self.random.clone();
        painter.coarser(self.spacing, |painter| {
            facade::paint(painter, &self.front, &self.style, &mut random);
            self.back(painter, &self.front);
            self.sides(painter, &mut random);
            self.rear(painter, &mut random);
            self.roof(painter, &mut random);
        });
    }

    fn sides(&self, painter: &mut Painter, random: &mut Random) {
        let Wall { width_m, .. } = self.front;
        let at = |u_m: f64, depth_m: f64| self.front.at(u_m, 0.0, depth_m);
        let walls = [
            Wall::between(at(0.0, -DEPTH_M), at(0.0, 0.0)),
            Wall::between(at(width_m, 0.0), at(width_m, -DEPTH_M)),
        ];
        let top_m = self.style.height_m();
        for (side, wall) in walls.into_iter().enumerate() {
            if self.open_sides[side] {
                let style =
                    Style { balconies: false, ground_floor: GroundFloor::Flats, ..self.style };
                // A side is seen at a grazing angle only.
                painter.coarser(1.25, |painter| facade::paint(painter, &wall, &style, random));
                self.back(painter, &wall);
            } else if self.neighbours_m[side] < top_m {
                // The part above a lower neighbour.
                let us = painter.even(0.0, DEPTH_M, 0.8);
                let vs = painter.even(self.neighbours_m[side], top_m, 0.8);
                let paint = self.style.wall.times(0.92);
                let place = |u_m: f64, v_m: f64| wall.at(u_m, v_m, 0.0);
                painter.sheet(&us, &vs, place, |u_m, v_m| {
                    Some(paint.times(1.0 + 0.04 * noise(5, u_m, v_m)))
                });
            }
        }
    }

    /// The wall towards the yard, coarse: no camera drives there.
    fn rear(&self, painter: &mut Painter, random: &mut Random) {
        let at = |u_m: f64| self.front.at(u_m, 0.0, -DEPTH_M);
        let wall = Wall::between(at(self.front.width_m), at(0.0));
        let style = Style {
            wall: self.style.wall.times(0.94),
            balconies: false,
            ground_floor: GroundFloor::Flats,
            near: false,
            bay_m: 1.45 * self.style.bay_m,
            ..self.style
        };
        painter.coarser(3.2 / self.spacing.min(1.4), |painter| {
            facade::paint(painter, &wall, &style, random);
        });
    }

    /// A dark surface 1.6 m behind a wall, which is visible through gaps between its surfels.
    fn back(&self, painter: &mut Painter, wall: &Wall) {
        let inset_m = 1.6;
        let top_m = self.style.height_m() - 1.6;
        let rotation = DQuat::from_mat3(&DMat3::from_cols(wall.right, DVec3::Z, wall.out));
        // 2.2 m: nothing but a dark colour is seen of it.
        let us = painter.even(inset_m, wall.width_m - inset_m, 2.2);
        let vs = painter.even(0.6, top_m, 2.2);
        for v in vs.windows(2) {
            for u in us.windows(2) {
                let middle_m = wall.at(0.5 * (u[0] + u[1]), 0.5 * (v[0] + v[1]), -inset_m);
                let sigmas_m = DVec3::new(0.65 * (u[1] - u[0]), 0.65 * (v[1] - v[0]), 0.05);
                let rgb = 0.38 * self.style.wall.rgb;
                painter.gaussian(middle_m, rotation, sigmas_m, 0.96, rgb, DVec3::ZERO);
            }
        }
    }

    /// A tiled slope behind the eaves up to the ridge, gables on both sides, and chimneys.
    fn roof(&self, painter: &mut Painter, random: &mut Random) {
        let wall = self.front;
        let eaves_m = self.style.height_m();
        let tiles = random.pick(&[
            Paint::matt(0.55, 0.33, 0.26),
            Paint::matt(0.50, 0.29, 0.24),
            Paint::matt(0.36, 0.36, 0.39),
            Paint::matt(0.42, 0.38, 0.36),
        ]);
        let run_m = 0.5 * DEPTH_M;
        let rise_m = random.range(2.8, 4.0);
        let us = painter.graded(-0.1, wall.width_m + 0.1, 0.3, 0.9);
        let vs = painter.even(0.0, 1.0, 0.19);
        let place =
            |u_m: f64, t: f64| wall.at(u_m, eaves_m + rise_m * t, 0.30 - (run_m + 0.30) * t);
        let courses = |u_m: f64, t: f64| 0.07 * noise(11, 2.0 * u_m, (t * 24.0).floor());
        painter.sheet(&us, &vs, place, |u_m, t| Some(tiles.times(1.0 + courses(u_m, t))));
        // The slope towards the yard, down from the ridge.
        let rear = |u_m: f64, t: f64| {
            wall.at(u_m, eaves_m + rise_m * (1.0 - t), -run_m - (run_m + 0.30) * t)
        };
        let wide = painter.even(-0.1, wall.width_m + 0.1, 1.5);
        painter.sheet(&wide, &[0.04, 0.12, 0.25, 0.5, 0.75, 1.0], rear, |u_m, t| {
            Some(tiles.times(1.0 + courses(u_m, t)))
        });

        let gable = self.style.wall.times(0.92);
        let depths = [painter.even(-DEPTH_M, 0.0, 1.2), painter.even(0.0, DEPTH_M, 1.2)];
        for (u_m, depths, sign) in [(0.0, &depths[0], 1.0), (wall.width_m, &depths[1], -1.0)] {
            // A triangle: `rise` above the ridge in the middle of the depth, 0 at both ends.
            let top_m = |depth_m: f64| rise_m * (1.0 - (depth_m / run_m + 1.0).abs());
            let place =
                |d_m: f64, t: f64| wall.at(u_m, eaves_m + t * top_m(sign * d_m), sign * d_m);
            painter.sheet(depths, &[0.0, 0.4, 0.75, 0.93, 1.0], place, |_, _| Some(gable));
        }

        let brick = Paint::matt(0.52, 0.36, 0.31);
        for _ in 0..1 + random.below(2) {
            let u_m = random.range(1.5, wall.width_m - 1.5);
            // Just in front of the ridge, which is half the depth behind the front.
            let at_m = wall.at(u_m, eaves_m, -run_m + 0.3);
            let half_m = 0.38;
            let top_m = rise_m + 1.1;
            let vs = painter.even(rise_m - 1.0, top_m, 0.35);
            let corners = [
                at_m - half_m * wall.right + half_m * wall.out,
                at_m + half_m * wall.right + half_m * wall.out,
                at_m + half_m * wall.right - half_m * wall.out,
                at_m - half_m * wall.right - half_m * wall.out,
            ];
            for side in 0..4 {
                let face = Wall::between(corners[side], corners[(side + 1) % 4]);
                let us = painter.even(0.0, face.width_m, 0.38);
                painter.sheet(
                    &us,
                    &vs,
                    |u_m, v_m| face.at(u_m, v_m, 0.0),
                    |_, v_m| Some(if v_m > top_m - 0.2 { brick.times(1.25) } else { brick }),
                );
            }
        }
    }
}

/// Boundaries between the fronts of a row, from one end to the other.
fn fronts(random: &mut Random, [from_m, to_m]: [f64; 2]) -> Vec<f64> {
    let mut breaks_m = vec![from_m];
    let mut at_m = from_m;
    // Ends when the rest is no wider than a house may be.
    while to_m - at_m > FRONTS_M[1] {
        at_m += random.range(FRONTS_M[0], FRONTS_M[1]);
        breaks_m.push(at_m);
    }
    // A rest of less than half the narrowest front is given to the other houses.
    // Stretch the row so that its last house ends at the end of the row.
    if to_m - at_m > 0.5 * FRONTS_M[0] {
        at_m = to_m;
        breaks_m.push(at_m);
    }
    let stretch = (to_m - from_m) / (at_m - from_m);
    breaks_m.iter().map(|b_m| from_m + stretch * (b_m - from_m)).collect()
}

fn style(random: &mut Random, main_street: bool) -> Style {
    let walls = [
        Paint::matt(0.84, 0.79, 0.68),
        Paint::matt(0.86, 0.85, 0.81),
        Paint::matt(0.80, 0.66, 0.50),
        Paint::matt(0.78, 0.70, 0.58),
        Paint::matt(0.70, 0.74, 0.74),
        Paint::matt(0.84, 0.72, 0.64),
        Paint::matt(0.72, 0.75, 0.66),
        Paint::matt(0.66, 0.55, 0.47),
    ];
    let bricks = [Paint::matt(0.60, 0.38, 0.31), Paint::matt(0.66, 0.50, 0.40)];
    let accents = [
        Paint::matt(0.20, 0.34, 0.28),
        Paint::matt(0.48, 0.16, 0.16),
        Paint::matt(0.18, 0.28, 0.46),
        Paint::matt(0.80, 0.62, 0.24),
        Paint::matt(0.24, 0.23, 0.24),
        Paint::matt(0.60, 0.34, 0.20),
    ];
    let brick = random.chance(0.25);
    let shop = main_street && random.chance(0.5);
    Style {
        wall: if brick { random.pick(&bricks) } else { random.pick(&walls) },
        trim: random.pick(&[Paint::matt(0.88, 0.87, 0.84), Paint::matt(0.82, 0.79, 0.73)]),
        frame: random.pick(&[
            Paint::matt(0.90, 0.90, 0.88),
            Paint::matt(0.84, 0.83, 0.80),
            Paint::matt(0.34, 0.26, 0.21),
        ]),
        accent: random.pick(&accents),
        upper_floors: 2 + random.below(3),
        bay_m: random.range(2.6, 3.3),
        window_m: random.range(1.5, 1.9),
        brick,
        balconies: random.chance(0.35),
        near: true,
        ground_floor: if shop { GroundFloor::Shop } else { GroundFloor::Flats },
    }
}
