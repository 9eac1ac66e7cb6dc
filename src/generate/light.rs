//! Baked light: one sun with shadows, and a sky.

use glam::{DVec2, DVec3};

use super::random::{noise, smooth};

/// Towards the sun: behind the driver's right shoulder, 44° above the horizon, so that the left
/// facades and half of the road are lit and the right row of houses throws its shadow on the rest.
/// Unit length to 1e-3, which is all that shading needs.
const TO_SUN: DVec3 = DVec3::new(-0.600, -0.400, 0.693);

/// Light from the sun on a surface that faces it, red, green, blue.
const SUN: DVec3 = DVec3::new(1.22, 1.11, 0.94);
/// Light from the whole sky on a surface that faces up.
const SKY: DVec3 = DVec3::new(0.50, 0.55, 0.63);
/// Light that the ground reflects to a surface that faces down.
const GROUND: DVec3 = DVec3::new(0.28, 0.27, 0.25);

/// Side of a cell of the shadow grid, in metres.
const CELL_M: f64 = 6.0;

/// An object that casts a shadow.
#[derive(Clone, Copy, Debug)]
pub(super) enum Occluder {
    /// A box on the ground plan, turned about z.
    Block {
        /// Middle of the base, in metres.
        base_m: DVec3,
        /// Unit, along the first half-size.
        along: DVec3,
        /// Half length, half width and full height, in metres.
        size_m: DVec3,
    },
    /// A tree's crown, which lets some light through.
    Crown { center_m: DVec3, radius_m: f64 },
}

/// The sun, the sky, and the objects that cast shadows.
///
/// Occluders are stored in a grid by the area of their shadow on the plane z = 0, so that a point
/// is tested only against those whose shadow can reach it.
#[derive(Clone, Debug)]
pub(super) struct Light {
    /// Whether the sun stands in the zenith: for objects that will turn.
    overhead: bool,
    occluders: Vec<Occluder>,
    first_cell: [i64; 2],
    columns: usize,
    cells: Vec<Vec<u32>>,
}

impl Light {
    /// The light of a street with these occluders.
    pub(super) fn new(occluders: Vec<Occluder>) -> Self {
        // Each occluder's shadow on the ground, as a box.
        let reaches: Vec<_> = occluders.iter().map(shadow_box_m).collect();
        let low_m = reaches.iter().fold(DVec2::INFINITY, |low, reach| low.min(reach[0]));
        let high_m = reaches.iter().fold(DVec2::NEG_INFINITY, |high, reach| high.max(reach[1]));
        if occluders.is_empty() {
            return Self {
                overhead: false,
                occluders,
                first_cell: [0, 0],
                columns: 0,
                cells: Vec::new(),
            };
        }
        let first_cell = cell_index(low_m);
        let last_cell = cell_index(high_m);
        let columns = (last_cell[0] - first_cell[0] + 1) as usize;
        let rows = (last_cell[1] - first_cell[1] + 1) as usize;
        let mut cells = vec![Vec::new(); columns * rows];
        for (index, [low_m, high_m]) in reaches.into_iter().enumerate() {
            let low = cell_index(low_m);
            let high = cell_index(high_m);
            // Into every cell that its box touches: a point is looked up in one cell only.
            for row in low[1]..=high[1] {
                for column in low[0]..=high[0] {
                    let row = row - first_cell[1];
                    let column = column - first_cell[0];
                    cells[row as usize * columns + column as usize].push(index as u32);
                }
            }
        }
        Self { overhead: false, occluders, first_cell, columns, cells }
    }

    /// Light for objects that will turn: half of the sun from the zenith, and more of the sky, so
    /// that it fits every heading.
    pub(super) fn overhead() -> Self {
        Self { overhead: true, ..Self::new(Vec::new()) }
    }

    /// Light that falls on a surface, to be multiplied by the albedo.
    pub(super) fn on(&self, point_m: DVec3, normal: DVec3) -> DVec3 {
        if self.overhead {
            let up = 0.5 + 0.5 * normal.z;
            // No direction but up, so that a turning car is not lit from a side that turns with it.
            return 0.55 * normal.z.max(0.0) * SUN + 1.35 * (up * SKY + (1.0 - up) * GROUND);
        }
        let facing = normal.dot(TO_SUN).max(0.0);
        // Not asked for a surface that faces away. 6 cm off the surface, which would shade
        // itself otherwise.
        let sun = if facing > 0.0 { facing * self.sun_at(point_m + 0.06 * normal) } else { 0.0 };
        let up = 0.5 + 0.5 * normal.z;
        sun * SUN + up * SKY + (1.0 - up) * GROUND
    }

    /// Share of the sunlight that reaches a point through all occluders, 0 to 1.
    fn sun_at(&self, point_m: DVec3) -> f64 {
        // A point above the ground is shaded by the occluders whose shadow falls where its
        // own does.
        let shadow_m = on_ground(point_m);
        let cell = cell_index(shadow_m);
        let column = cell[0] - self.first_cell[0];
        let row = cell[1] - self.first_cell[1];
        // A row beyond the last is caught by `get`; a column would be taken for one of the
        // next row.
        if column < 0 || row < 0 || column >= self.columns as i64 {
            return 1.0;
        }
        let Some(near) = self.cells.get(row as usize * self.columns + column as usize) else {
            return 1.0;
        };
        near.iter().fold(1.0, |sun, &index| {
            if sun <= 0.0 { 0.0 } else { sun * self.occluders[index as usize].passes(point_m) }
        })
    }
}

impl Occluder {
    /// Share of the sunlight that passes this occluder on its way to a point, 0 to 1.
    fn passes(&self, point_m: DVec3) -> f64 {
        match *self {
            Self::Block { base_m, along, size_m } => {
                let across = DVec3::new(-along.y, along.x, 0.0);
                let offset_m = point_m - base_m;
                let slabs = [
                    (offset_m.dot(along), TO_SUN.dot(along), -size_m.x, size_m.x),
                    (offset_m.dot(across), TO_SUN.dot(across), -size_m.y, size_m.y),
                    (offset_m.z, TO_SUN.z, 0.0, size_m.z),
                ];
                // The slab method (Kay and Kajiya 1986): the ray is within the box between the last
                // entry and the first exit.
                let mut enter_m = 0.0_f64;
                let mut leave_m = f64::INFINITY;
                for (position_m, slope, low_m, high_m) in slabs {
                    // A ray parallel to a slab never leaves it: a tiny slope puts entry and
                    // exit far away.
                    let slope = if slope.abs() < 1e-9 { 1e-9 } else { slope };
                    let a_m = (low_m - position_m) / slope;
                    let b_m = (high_m - position_m) / slope;
                    enter_m = enter_m.max(a_m.min(b_m));
                    leave_m = leave_m.min(a_m.max(b_m));
                }
                // A grazing ray is dimmed, not cut: the penumbra.
                1.0 - smooth((leave_m - enter_m) / 0.5)
            }
            Self::Crown { center_m, radius_m } => {
                // Pythagoras: from the ray's distance to the centre follows half the chord
                // within the ball.
                let offset_m = center_m - point_m;
                let ahead_m = offset_m.dot(TO_SUN);
                let miss_m2 = offset_m.length_squared() - ahead_m * ahead_m;
                let half_chord_m2 = radius_m * radius_m - miss_m2;
                if half_chord_m2 <= 0.0 {
                    return 1.0;
                }
                let half_chord_m = half_chord_m2.sqrt();
                // Only the part of the chord ahead of the point: it may lie within the crown.
                let chord_m = (ahead_m + half_chord_m).max(0.0) - (ahead_m - half_chord_m).max(0.0);
                // Light falls through gaps of about 0.4 m.
                let shadow_m = on_ground(point_m);
                let gaps = 0.5 + 0.5 * noise(17, 2.5 * shadow_m.x, 2.5 * shadow_m.y);
                1.0 - smooth(chord_m / (0.9 * radius_m)) * (0.95 - 0.4 * gaps)
            }
        }
    }
}

/// Position of the shadow of a point on the plane z = 0, in metres.
fn on_ground(point_m: DVec3) -> DVec2 {
    point_m.truncate() - TO_SUN.truncate() * (point_m.z / TO_SUN.z)
}

/// Box of the shadow on the plane z = 0, in metres: smallest and largest corner.
fn shadow_box_m(occluder: &Occluder) -> [DVec2; 2] {
    let (ends_m, radius_m) = match *occluder {
        Occluder::Block { base_m, size_m, .. } => {
            let top_m = base_m + size_m.z * DVec3::Z;
            ([on_ground(base_m), on_ground(top_m)], size_m.truncate().length())
        }
        Occluder::Crown { center_m, radius_m } => {
            // The shadow of a ball is an ellipse, longer by 1 / sin(44°).
            ([on_ground(center_m); 2], 1.5 * radius_m)
        }
    };
    [ends_m[0].min(ends_m[1]) - radius_m, ends_m[0].max(ends_m[1]) + radius_m]
}

fn cell_index(point_m: DVec2) -> [i64; 2] {
    [(point_m.x / CELL_M).floor() as i64, (point_m.y / CELL_M).floor() as i64]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_throws_its_shadow_away_from_the_sun() {
        let size_m = DVec3::new(2.0, 2.0, 10.0);
        let light =
            Light::new(vec![Occluder::Block { base_m: DVec3::ZERO, along: DVec3::X, size_m }]);
        let sun = |x: f64, y: f64| light.sun_at(DVec3::new(x, y, 0.0));
        // 5 m high: the shadow lies 5/0.693 times the sun's horizontal part away, on the far side.
        // The middle of the shadow of a point at half the height.
        let behind_m = -TO_SUN * (5.0 / TO_SUN.z);
        assert_eq!(sun(behind_m.x, behind_m.y), 0.0);
        assert_eq!(sun(-behind_m.x, -behind_m.y), 1.0);
        assert_eq!(sun(200.0, 0.0), 1.0);
        let lit = light.on(DVec3::new(-20.0, 0.0, 0.0), DVec3::Z);
        let shaded = light.on(behind_m.truncate().extend(0.0), DVec3::Z);
        assert!(lit.cmpgt(shaded * 1.5).all(), "{lit} {shaded}");
    }

    #[test]
    fn a_crown_lets_some_light_through() {
        let crown = Occluder::Crown { center_m: DVec3::new(0.0, 0.0, 5.0), radius_m: 2.0 };
        let light = Light::new(vec![crown]);
        let below_m = DVec3::new(0.0, 0.0, 5.0) - TO_SUN * (5.0 / TO_SUN.z);
        let sun = light.sun_at(below_m);
        assert!((0.01..0.6).contains(&sun), "{sun}");
    }
}
