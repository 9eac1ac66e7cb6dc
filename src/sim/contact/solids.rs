//! The solid Gaussians of a twin in a grid, in which the ego's box finds those that it overlaps.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;

use super::body::Body;
use super::solid::{SOLID_OPACITY, SolidPoint, StaticLimit, is_in_tested_box};
use crate::traffic::EgoBox;

/// Edge of a cell, in metres: a car lies in 4 to 9 of them.
const CELL_M: f64 = 4.0;
/// Largest distance between two places at which the area is measured along a recorded drive, in metres.
const MEASURED_M: f64 = 0.5;

/// The solid Gaussians of a part of a twin, and the area above which they are a contact.
///
/// The sum of areas is in a fixed order, so that a decision does not depend on threads.
#[derive(Clone, Debug, PartialEq)]
pub struct Solids {
    cells: BTreeMap<[i32; 2], Vec<Solid>>,
    limit: StaticLimit,
}

/// A Gaussian, in 16 bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Solid {
    /// Its centre from the south-west corner of its cell at height 0, in metres.
    mean_m: [f32; 3],
    /// Opacity times the area of its largest cross-section, in m².
    area_m2: f32,
}

impl Solids {
    /// The Gaussians among `points` that are solid, each in world axes. The contact threshold is at least twice the
    /// largest area that the ego's box overlaps along the recorded drives, so that the drives have no contact.
    pub fn new(
        points: impl IntoIterator<Item = SolidPoint>,
        drives: &[Trajectory],
        ego: &EgoBox,
    ) -> Self {
        let mut cells: BTreeMap<[i32; 2], Vec<Solid>> = BTreeMap::new();
        for point in points.into_iter().filter(|point| point.opacity >= SOLID_OPACITY) {
            let cell = cell_at(point.mean_m.truncate());
            let from_corner_m = point.mean_m - corner_m(cell).extend(0.0);
            let solid = Solid {
                mean_m: from_corner_m.as_vec3().to_array(),
                area_m2: point.area_m2() as f32,
            };
            cells.entry(cell).or_default().push(solid);
        }
        let mut solids = Self { cells, limit: StaticLimit { most_on_drive_m2: 0.0 } };
        for drive in drives {
            for pair in drive.keyframes.windows(2) {
                let [from, to] = [pair[0].world_from_rig, pair[1].world_from_rig];
                let way_m = from.position_m.distance(to.position_m);
                let parts = (way_m / MEASURED_M).ceil().max(1.0);
                for part in 0..=parts as u32 {
                    let pose = from.interpolate(&to, f64::from(part) / parts);
                    let most_m2 = &mut solids.limit.most_on_drive_m2;
                    *most_m2 = most_m2.max(area_m2(&solids.cells, &pose, ego));
                }
            }
        }
        solids
    }

    /// The area that the ego's box overlaps at a pose, in m².
    pub fn area_m2(&self, world_from_rig: &Pose, ego: &EgoBox) -> f64 {
        area_m2(&self.cells, world_from_rig, ego)
    }

    /// The area above which there is a contact.
    pub fn limit(&self) -> StaticLimit {
        self.limit
    }
}

fn area_m2(cells: &BTreeMap<[i32; 2], Vec<Solid>>, world_from_rig: &Pose, ego: &EgoBox) -> f64 {
    let Body { footprint, bottom_m, .. } = Body::new(world_from_rig, &ego.box_, ego.center_x_m);
    let size_m = DVec3::new(ego.box_.length_m, ego.box_.width_m, ego.box_.height_m);
    let reach_m = DVec2::splat(0.5 * size_m.truncate().length());
    let [west, south] = cell_at(footprint.center_m - reach_m);
    let [east, north] = cell_at(footprint.center_m + reach_m);
    let left = footprint.forward.perp();
    let mut area_m2 = 0.0;
    for x in west..=east {
        for (cell, solids) in cells.range([x, south]..=[x, north]) {
            let corner_from_center_m = corner_m(*cell) - footprint.center_m;
            for solid in solids {
                let [x_m, y_m, z_m] = solid.mean_m.map(f64::from);
                let from_center_m = corner_from_center_m + DVec2::new(x_m, y_m);
                let in_box_m = DVec3::new(
                    from_center_m.dot(footprint.forward),
                    from_center_m.dot(left),
                    z_m - bottom_m,
                );
                if is_in_tested_box(in_box_m, size_m) {
                    area_m2 += f64::from(solid.area_m2);
                }
            }
        }
    }
    area_m2
}

fn cell_at(point_m: DVec2) -> [i32; 2] {
    (point_m / CELL_M).floor().as_ivec2().to_array()
}

fn corner_m(cell: [i32; 2]) -> DVec2 {
    let [x, y] = cell.map(f64::from);
    CELL_M * DVec2::new(x, y)
}
