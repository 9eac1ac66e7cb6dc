//! One wall of a house: bays of windows, balconies, cornice.

use glam::DVec3;

use super::random::{Random, noise, smooth};
use super::surface::{Paint, Painter};

/// A vertical plane: u runs to the right as seen from outside, v up, depth outwards.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wall {
    /// Left lower corner as seen from outside, in metres.
    pub(super) corner_m: DVec3,
    /// Unit vector along the wall, to the right as seen from outside.
    pub(super) right: DVec3,
    /// Unit vector out of the wall, towards the viewer.
    pub(super) out: DVec3,
    pub(super) width_m: f64,
}

impl Wall {
    /// The wall between two ground points, `left_m` and `right_m` as seen from outside.
    pub(super) fn between(left_m: DVec3, right_m: DVec3) -> Self {
        let right = (right_m - left_m).normalize();
        // Right x up.
        let out = right.cross(DVec3::Z);
        Self { corner_m: left_m, right, out, width_m: left_m.distance(right_m) }
    }

    /// The point at `u_m` to the right, `v_m` up and `depth_m` out of the wall.
    pub(super) fn at(&self, u_m: f64, v_m: f64, depth_m: f64) -> DVec3 {
        self.corner_m + u_m * self.right + v_m * DVec3::Z + depth_m * self.out
    }
}

/// The use of the ground floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum GroundFloor {
    /// Windows, and a door in one bay.
    Flats,
    /// Shop windows with a sign and awnings.
    Shop,
}

/// The outside of a house.
#[derive(Clone, Copy, Debug)]
pub(super) struct Style {
    /// The plaster or brick.
    pub(super) wall: Paint,
    /// Cornices, window surrounds, sills.
    pub(super) trim: Paint,
    /// Window frames and balcony railings.
    pub(super) frame: Paint,
    /// Shop sign and awnings.
    pub(super) accent: Paint,
    /// Floors above the ground floor.
    pub(super) upper_floors: usize,
    /// Approximate width of a window bay, in metres.
    pub(super) bay_m: f64,
    /// Height of a window, in metres.
    pub(super) window_m: f64,
    /// Brick courses instead of plaster.
    pub(super) brick: bool,
    /// Balconies in every second bay.
    pub(super) balconies: bool,
    /// The use of the ground floor.
    pub(super) ground_floor: GroundFloor,
    /// Whether the drive passes the house; then its windows have all their parts.
    pub(super) near: bool,
}

/// Height of a ground floor, in metres.
pub(super) const GROUND_FLOOR_M: f64 = 3.8;
/// Height of every other floor, in metres.
pub(super) const FLOOR_M: f64 = 3.1;
/// Height of the cornice above the last floor, in metres.
const CORNICE_M: f64 = 0.45;

impl Style {
    /// Height of the wall up to the eaves, in metres.
    pub(super) fn height_m(&self) -> f64 {
        GROUND_FLOOR_M + FLOOR_M * self.upper_floors as f64 + CORNICE_M
    }
}

/// Paints a wall with everything in it.
pub(super) fn paint(painter: &mut Painter, wall: &Wall, style: &Style, random: &mut Random) {
    // As many bays as fit, at least one; their width is adjusted.
    let count = (wall.width_m / style.bay_m).round().max(1.0) as usize;
    let mut facade = Facade { painter, wall, style, bay_m: wall.width_m / count as f64 };
    let door = random.below(count);
    for bay in 0..count {
        let u_m = bay as f64 * facade.bay_m;
        match style.ground_floor {
            _ if bay == door => facade.door_bay(u_m),
            GroundFloor::Shop => facade.shop_bay(u_m, random),
            GroundFloor::Flats => facade.window_bay(u_m, [0.0, GROUND_FLOOR_M], 1.25, random),
        }
    }
    for floor in 0..style.upper_floors {
        let from_m = GROUND_FLOOR_M + FLOOR_M * floor as f64;
        // Higher floors are farther from every camera.
        // A third coarser for each floor.
        facade.painter.coarser(1.0 + 0.32 * floor as f64, |painter| {
            let mut facade = Facade { painter, ..facade };
            for bay in 0..count {
                let u_m = bay as f64 * facade.bay_m;
                facade.window_bay(u_m, [from_m, from_m + FLOOR_M], 0.85, random);
                // Every second bay, the same ones on all floors, with one in the middle.
                let centred = bay % 2 == count / 2 % 2;
                if style.balconies && style.near && centred {
                    facade.balcony(u_m + 0.5 * facade.bay_m, from_m);
                }
            }
        });
    }
    facade.bands();
}

/// A wall that is being painted.
pub(super) struct Facade<'p, 'a, 'w> {
    pub(super) painter: &'p mut Painter<'a>,
    pub(super) wall: &'w Wall,
    pub(super) style: &'w Style,
    /// Width of a bay, in metres.
    pub(super) bay_m: f64,
}

/// Spacing on plain wall, next to an opening and in between, in metres. Surrounds cover its edge.
const WALL_M: [f64; 2] = [0.16, 0.60];
/// Width of wall that a surround hides, in metres.
const HIDDEN_M: f64 = 0.07;
/// Longest part of a level bar, in metres: a longer one would hide behind the wall beside it, for a
/// camera that looks along the street.
const BAR_M: f64 = 0.6;
/// Depth of window panes in the wall, in metres.
pub(super) const RECESS_M: f64 = 0.14;

impl Facade<'_, '_, '_> {
    /// One bay of one floor: wall around a window whose sill is `sill_m` above the floor.
    fn window_bay(&mut self, u_m: f64, v_m: [f64; 2], sill_m: f64, random: &mut Random) {
        // 42 % of the bay, but 0.9 to 1.5 m wide.
        let half_m = 0.5 * (0.42 * self.bay_m).clamp(0.9, 1.5);
        let middle_m = u_m + 0.5 * self.bay_m;
        let u = [middle_m - half_m, middle_m + half_m];
        // 35 cm of wall at least above the window.
        let v = [v_m[0] + sill_m, (v_m[0] + sill_m + self.style.window_m).min(v_m[1] - 0.35)];
        self.around(u_m, u, v_m, v);
        self.surround(u, v);
        self.window(u, v, random);
    }

    /// Wall of a bay around an opening: it ends behind the surround, so that it does not blur the
    /// opening's edge.
    pub(super) fn around(&mut self, u_m: f64, u: [f64; 2], v_m: [f64; 2], v: [f64; 2]) {
        let left_m = u[0] - HIDDEN_M;
        let right_m = u[1] + HIDDEN_M;
        self.pier([u_m, left_m], v_m);
        self.pier([right_m, u_m + self.bay_m], v_m);
        if v[0] > v_m[0] {
            self.plain([left_m, right_m], [v_m[0], v[0] - HIDDEN_M]);
        }
        self.plain([left_m, right_m], [v[1] + HIDDEN_M, v_m[1]]);
    }

    /// Wall next to openings: fine at its sides.
    pub(super) fn pier(&mut self, u: [f64; 2], v: [f64; 2]) {
        let us = self.painter.graded(u[0], u[1], WALL_M[0], WALL_M[1]);
        // Taller ones would reach above the eaves.
        let step_m = if self.style.near { self.painter.at_most(0.75, 1.1) } else { 0.75 };
        let vs = self.painter.even(v[0], v[1], step_m);
        self.wall(&us, &vs);
    }

    /// Wall above or below an opening: fine at its top and bottom.
    pub(super) fn plain(&mut self, u: [f64; 2], v: [f64; 2]) {
        let us = self.painter.even(u[0], u[1], WALL_M[1]);
        let vs = self.painter.graded(v[0], v[1], WALL_M[0], WALL_M[1]);
        self.wall(&us, &vs);
    }

    fn wall(&mut self, us: &[f64], vs: &[f64]) {
        let style = *self.style;
        let at_m = self.wall.corner_m;
        self.rect(us, vs, 0.0, |u_m, v_m| {
            // Stains are vertical, and splashes from the pavement darken the bottom of the wall.
            // A wall of its own pattern, by the place of its corner.
            let seed = (at_m.x * 16.0) as i64 as u64;
            let stain = 0.030 * noise(seed, 1.3 * u_m, 0.25 * v_m)
                + 0.025 * noise(seed.wrapping_add(1), 0.3 * u_m, 0.3 * v_m);
            let grain = if style.brick {
                0.06 * noise(
                    seed.wrapping_add(2),
                    // Courses of 12.5 cm, each moved by half a cell of the noise against the one
                    // below.
                    3.1 * u_m + (v_m * 8.0).floor() * 0.5,
                    (v_m * 8.0).floor(),
                )
            } else {
                0.012 * noise(seed.wrapping_add(2), 5.0 * u_m, 5.0 * v_m)
            };
            let foot = 0.72 + 0.28 * smooth(v_m / 1.2);
            let eaves = 0.75 + 0.25 * smooth((style.height_m() - v_m) / 1.2);
            style.wall.times(1.0 + stain + grain).open(foot * eaves)
        });
    }

    /// The stone frame around an opening, with its sill and the reveals to the panes.
    pub(super) fn surround(&mut self, u: [f64; 2], v: [f64; 2]) {
        let trim = self.style.trim;
        let wide_m = 0.13;
        let out_m = 0.06;
        // From far away, lintel and sill are enough.
        if !self.style.near {
            for v_m in [v[1] + 0.5 * wide_m, v[0] - 0.045] {
                self.bar([u[0] - wide_m, v_m], [u[1] + wide_m, v_m], 0.12, [0.12, 2.0], trim);
            }
            return;
        }
        for at_m in [u[0] - 0.5 * wide_m, u[1] + 0.5 * wide_m] {
            self.bar([at_m, v[0] - 0.05], [at_m, v[1] + wide_m], out_m, [wide_m, 1.0], trim);
        }
        let left_m = u[0] - wide_m;
        let right_m = u[1] + wide_m;
        let top_m = v[1] + 0.5 * wide_m + 0.01;
        self.bar([left_m, top_m], [right_m, top_m], out_m, [wide_m + 0.03, BAR_M], trim);
        // The sill stands out, and the wall below it is in its shade.
        let sill_m = v[0] - 0.045;
        self.bar([left_m, sill_m], [right_m, sill_m], 0.12, [0.09, BAR_M], trim.times(1.04));
        let shade_m = v[0] - 0.14;
        self.bar([left_m, shade_m], [right_m, shade_m], 0.03, [0.08, BAR_M], trim.times(0.62));
        // Reveals: the wall's thickness at the sides of the panes and above them.
        let shade = self.style.wall.open(0.6);
        let vs = self.painter.even(v[0], v[1], 0.85);
        for (at_m, outwards) in [(u[0], true), (u[1], false)] {
            let wall = *self.wall;
            // Seen from inside the opening: to the right goes inwards on its left side.
            let (from_m, to_m) = if outwards { (0.0, -RECESS_M) } else { (-RECESS_M, 0.0) };
            let place = move |d_m: f64, v_m: f64| wall.at(at_m, v_m, d_m);
            self.painter.sheet(&[from_m, to_m], &vs, place, |_, _| Some(shade));
        }
    }

    /// Frame and panes in an opening.
    fn window(&mut self, u: [f64; 2], v: [f64; 2], random: &mut Random) {
        let frame = self.style.frame;
        let rim_m = 0.065;
        let depth_m = -RECESS_M;
        let middle_m = 0.5 * (u[0] + u[1]);
        let transom_m = v[1] - 0.30 * (v[1] - v[0]);
        let verticals = [u[0] + 0.5 * rim_m, middle_m, u[1] - 0.5 * rim_m];
        // From far away a window is a dark rectangle.
        if !self.style.near {
            let us = self.painter.even(u[0], u[1], 0.2);
            let vs = self.painter.even(v[0], v[1], 0.2);
            return self.rect(&us, &vs, depth_m, |_, _| glass());
        }
        let out_m = depth_m + 0.05;
        for at_m in verticals {
            self.bar([at_m, v[0]], [at_m, v[1]], out_m, [rim_m, 1.0], frame);
        }
        for at_m in [v[0] + 0.5 * rim_m, transom_m, v[1] - 0.5 * rim_m] {
            self.bar([u[0], at_m], [u[1], at_m], out_m, [rim_m, BAR_M], frame);
        }
        // Some rooms are lit, some have curtains; all other panes are dark and reflect the sky.
        let curtain = random.chance(0.45);
        let drawn = random.range(0.1, 0.34);
        let tone = random.range(0.8, 1.25);
        let cloth = random.pick(&[
            Paint::matt(0.66, 0.63, 0.56),
            Paint::matt(0.60, 0.62, 0.64),
            Paint::matt(0.58, 0.47, 0.40),
        ]);
        for [u0, u1] in [[u[0] + rim_m, middle_m], [middle_m, u[1] - rim_m]] {
            let us = self.painter.even(u0, u1, 0.22);
            for [v0, v1] in [[v[0] + rim_m, transom_m], [transom_m, v[1] - rim_m]] {
                let vs = self.painter.even(v0, v1, 0.40);
                let [left_m, right_m] = u;
                let [low_m, high_m] = v;
                self.rect(&us, &vs, depth_m, |u_m, v_m| {
                    let aside = (u_m - left_m).min(right_m - u_m) / (right_m - left_m);
                    let height = (v_m - low_m) / (high_m - low_m);
                    // The lintel shades the upper part of the panes.
                    let open = 0.75 + 0.25 * smooth((high_m - v_m) / 0.4);
                    if curtain && aside < drawn {
                        cloth.times(0.72).gloss(0.16).open(open)
                    } else {
                        glass().times(tone * (0.85 + 0.4 * height)).open(open)
                    }
                });
            }
        }
    }

    /// A balcony in front of a window: slab, rails, and plants in a box.
    fn balcony(&mut self, middle_m: f64, floor_m: f64) {
        let half_m = (0.42 * self.bay_m).min(1.3);
        let deep_m = 0.95;
        let u = [middle_m - half_m, middle_m + half_m];
        // Slab, its lower side, upper rail, bars, and both ends.
        let stone = self.style.trim;
        let us = self.painter.even(u[0], u[1], 0.3);
        self.rect(&us, &[floor_m - 0.12, floor_m + 0.06], deep_m, |_, _| stone);
        let wall = *self.wall;
        let below = move |at_m: f64, d_m: f64| wall.at(at_m, floor_m - 0.12, d_m);
        self.painter.sheet(&us, &[0.0, 0.3, 0.6, deep_m], below, |_, _| Some(stone.open(0.8)));
        let rail = self.style.frame.times(0.45);
        self.rect(&us, &[floor_m + 0.98, floor_m + 1.05], deep_m, |_, _| rail);
        let bars = self.painter.even(u[0], u[1], 0.14);
        for at_m in bars {
            let ends_m = [[at_m, floor_m + 0.06], [at_m, floor_m + 0.98]];
            self.bar(ends_m[0], ends_m[1], deep_m, [0.03, 1.0], rail);
        }
        for (at_m, side) in [(u[0], -1.0), (u[1], 1.0)] {
            let ds = if side < 0.0 { [0.0, 0.5, deep_m] } else { [deep_m, 0.5, 0.0] };
            let place = move |d_m: f64, v_m: f64| wall.at(at_m, v_m, d_m);
            self.painter.sheet(&ds, &[floor_m - 0.12, floor_m + 0.06], place, |_, _| Some(stone));
            let ends_m = [0.0, deep_m].map(|d_m| wall.at(at_m, floor_m + 1.015, d_m));
            self.painter.polyline(&ends_m, side * wall.right, [0.07, 0.5], rail);
        }
    }

    /// Bands across the whole wall: plinth line above the ground floor, cornice below the eaves.
    fn bands(&mut self) {
        let width_m = self.wall.width_m;
        let top_m = self.style.height_m();
        let trim = self.style.trim;
        let us = self.painter.even(0.0, width_m, 0.6);
        let band = [GROUND_FLOOR_M - 0.16, GROUND_FLOOR_M - 0.03, GROUND_FLOOR_M + 0.10];
        self.rect(&us, &band, 0.09, |_, v_m| trim.times(0.8 + 0.2 * smooth((v_m - band[0]) / 0.1)));
        let base_m = top_m - CORNICE_M;
        let mould = [base_m, base_m + 0.12, base_m + 0.24];
        let lip = [base_m + 0.24, top_m];
        self.rect(&us, &mould, 0.10, |_, _| trim.times(0.86));
        self.rect(&us, &lip, 0.34, |_, _| trim);
        let wall = *self.wall;
        let below = move |u_m: f64, d_m: f64| wall.at(u_m, base_m + 0.24, d_m);
        self.painter.sheet(&us, &[0.0, 0.17, 0.34], below, |_, _| Some(trim.open(0.8)));
    }

    /// A bar from (u, v) to (u, v), `depth_m` out of the wall, of a width and of parts at most so
    /// long.
    pub(super) fn bar(
        &mut self,
        from: [f64; 2],
        to: [f64; 2],
        depth_m: f64,
        width: [f64; 2],
        paint: Paint,
    ) {
        let ends_m = [from, to].map(|[u_m, v_m]| self.wall.at(u_m, v_m, depth_m));
        self.painter.polyline(&ends_m, self.wall.out, width, paint);
    }

    /// A flat part of the wall between break points, `depth_m` out of its plane.
    pub(super) fn rect(
        &mut self,
        us: &[f64],
        vs: &[f64],
        depth_m: f64,
        paint: impl Fn(f64, f64) -> Paint,
    ) {
        let wall = *self.wall;
        let place = move |u_m: f64, v_m: f64| wall.at(u_m, v_m, depth_m);
        self.painter.sheet(us, vs, place, |u_m, v_m| Some(paint(u_m, v_m)));
    }
}

/// A pane with a dark room behind it.
pub(super) fn glass() -> Paint {
    Paint::matt(0.26, 0.31, 0.36).gloss(0.34)
}
