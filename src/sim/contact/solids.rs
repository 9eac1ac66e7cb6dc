//! The solid Gaussians of a part of a twin in a grid, in which the ego's box finds those that it
//! overlaps.

use std::collections::{BTreeMap, HashMap};
use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec2, DVec3};

use wildcity_scene::geometry::Pose;

use super::solid::{GROUND_MARGIN_M, SOLID_OPACITY, SolidPoint, is_in_tested_box};
use crate::traffic::EgoBox;

/// Edge of a grid cell, in metres: a car lies in 6 to 12 of them.
const CELL_M: f64 = 2.0;
/// Gaussians in the same cube of this edge are added up, in metres. A car does not notice 10 cm,
/// since the tested box is 10 cm smaller than the car on each side; and a capture with a hundred
/// Gaussians in each cube takes the memory of one.
const MERGED_M: f64 = 0.1;

/// The solid Gaussians of a part of a twin.
///
/// The sum of areas is in a fixed order, so that a decision does not depend on threads.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Solids {
    /// By rising height within a cell.
    cells: BTreeMap<[i32; 2], Vec<Solid>>,
}

/// The Gaussians of a cube, in 16 bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Solid {
    /// Their mean, weighted by area, from the south-west corner of the cell at height 0, in metres.
    mean_m: [f32; 3],
    /// Opacity times the area of their largest cross-sections, in m².
    area_m2: f32,
}

/// A cell, and a cube within it.
type CubeKey = ([i32; 2], [i32; 3]);

/// A Gaussian with its cell, and its cube within the cell.
struct CubePoint {
    cell: [i32; 2],
    cube: [i32; 3],
    from_corner_m: DVec3,
    area_m2: f64,
}

impl CubePoint {
    fn new(point: SolidPoint) -> Self {
        let cell = cell_at(point.mean_m.truncate());
        let from_corner_m = point.mean_m - corner_m(cell).extend(0.0);
        // The cube counts from the cell's corner. Its index is 0 to 19 in x and y, and has any sign
        // in z.
        let cube = (from_corner_m / MERGED_M).floor().as_ivec3().to_array();
        Self { cell, cube, from_corner_m, area_m2: point.area_m2() }
    }

    fn key(&self) -> CubeKey {
        (self.cell, self.cube)
    }
}

/// The part of the ego's box in which Gaussians are a contact, at a pose.
///
/// It is tilted as the pose is: on a slope of 15 % the road is 0.36 m higher below the front of an
/// upright car than below its middle, and would count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TestedBox {
    /// The middle of the box, on the ground.
    center_m: DVec3,
    box_from_world: DQuat,
    size_m: DVec3,
    /// Lowest and greatest height of a point of the box, in metres.
    heights_m: [f64; 2],
}

impl TestedBox {
    /// The box of an ego at a pose, `world_from_rig`.
    pub fn new(world_from_rig: &Pose, ego: &EgoBox) -> Self {
        let center_m = world_from_rig.transform_point(DVec3::new(ego.center_x_m, 0.0, 0.0));
        let size_m = DVec3::new(ego.box_.length_m, ego.box_.width_m, ego.box_.height_m);
        let up = world_from_rig.rotation * DVec3::Z;
        let tilt_rad = up.angle_between(DVec3::Z).min(FRAC_PI_2);
        // A tilt θ lifts the end of a horizontal half diagonal d by `d sin θ`. This bounds the
        // heights of all corners without computing them. Beyond 90° no corner is higher than d.
        let edge_m = 0.5 * size_m.truncate().length() * tilt_rad.sin();
        // Along the tilted up axis, a height h of the box is `h up.z` above its middle. A rig that
        // lies on its roof has a negative `up.z`, hence the minimum and maximum below.
        let base_m = GROUND_MARGIN_M * up.z;
        let top_m = size_m.z * up.z;
        Self {
            center_m,
            box_from_world: world_from_rig.rotation.inverse(),
            size_m,
            heights_m: [base_m.min(top_m) - edge_m, base_m.max(top_m) + edge_m]
                .map(|height_m| center_m.z + height_m),
        }
    }

    /// Smallest and greatest x and y of its points, in metres.
    pub fn extent_m(&self) -> [DVec2; 2] {
        // A box that lies on its side reaches as far as it is high.
        // The half diagonal covers every heading, and the rise covers every tilt. The extent may be
        // too large: it only selects cells, and `has` decides.
        let reach_m = DVec2::splat((0.5 * self.size_m.truncate().length()).hypot(self.rise_m()));
        [self.center_m.truncate() - reach_m, self.center_m.truncate() + reach_m]
    }

    /// How far its top is displaced horizontally by the tilt, in metres.
    fn rise_m(&self) -> f64 {
        let up = self.box_from_world.inverse() * DVec3::Z;
        self.size_m.z * up.truncate().length()
    }

    fn has(&self, from_center_m: DVec3) -> bool {
        is_in_tested_box(self.box_from_world * from_center_m, self.size_m)
    }
}

impl Solids {
    /// The Gaussians among `points` that are solid, each in world axes.
    pub fn new(points: impl IntoIterator<Item = SolidPoint>) -> Self {
        let mut sums = SolidSums::default();
        sums.extend(points);
        sums.solids()
    }

    /// The area of the Gaussians that a box overlaps, in m².
    pub fn area_m2(&self, tested: &TestedBox) -> f64 {
        let [low_m, high_m] = tested.heights_m;
        let [west_south, east_north] = tested.extent_m().map(cell_at);
        let mut area_m2 = 0.0;
        for x in west_south[0]..=east_north[0] {
            // Keys are ordered by x, then y. So one range query per column of cells is enough, and
            // cells without Gaussians cost nothing.
            for (cell, solids) in self.cells.range([x, west_south[1]]..=[x, east_north[1]]) {
                let corner_from_center_m = corner_m(*cell).extend(0.0) - tested.center_m;
                // Most solid Gaussians are the road, below the box.
                let first = solids.partition_point(|solid| f64::from(solid.mean_m[2]) < low_m);
                // A cell is sorted by height, so the loop begins at the lowest Gaussian in reach
                // and stops above the highest.
                let in_reach = solids[first..].iter();
                for solid in in_reach.take_while(|solid| f64::from(solid.mean_m[2]) <= high_m) {
                    let mean_m = DVec3::from_array(solid.mean_m.map(f64::from));
                    if tested.has(corner_from_center_m + mean_m) {
                        area_m2 += f64::from(solid.area_m2);
                    }
                }
            }
        }
        area_m2
    }

    /// Memory that it takes, in bytes.
    pub fn bytes(&self) -> usize {
        // A key of 8 bytes and a vector's header of 24, in nodes of the tree that are at least half
        // full.
        let of_cell = |solids: &Vec<Solid>| solids.capacity() * size_of::<Solid>() + 64;
        self.cells.values().map(of_cell).sum()
    }
}

/// Solids that are being added up. The memory is that of their cubes, however many Gaussians these
/// have.
#[derive(Debug, Default)]
pub struct SolidSums {
    cubes: HashMap<CubeKey, CubeSum>,
}

/// The sums of the Gaussians of a cube, in the order in which they came: the last digits of a sum
/// depend on it.
#[derive(Clone, Copy, Debug, Default)]
struct CubeSum {
    area_m2: f64,
    /// Areas times means from the corner of the cell.
    moment: DVec3,
}

impl Extend<SolidPoint> for SolidSums {
    /// Adds the Gaussians that are solid, each in world axes.
    fn extend<I: IntoIterator<Item = SolidPoint>>(&mut self, points: I) {
        for point in points.into_iter().filter(|point| point.opacity >= SOLID_OPACITY) {
            let point = CubePoint::new(point);
            let sum = self.cubes.entry(point.key()).or_default();
            sum.area_m2 += point.area_m2;
            sum.moment += point.area_m2 * point.from_corner_m;
        }
    }
}

impl SolidSums {
    /// The sums as solids, cell by cell.
    pub fn solids(self) -> Solids {
        let mut cubes: Vec<(CubeKey, CubeSum)> = self.cubes.into_iter().collect();
        cubes.sort_unstable_by_key(|(key, _)| *key);
        let mut cells: BTreeMap<[i32; 2], Vec<Solid>> = BTreeMap::new();
        for ((cell, _), CubeSum { area_m2, moment }) in cubes {
            // A Gaussian without extent has no area, and no contact.
            if area_m2 > 0.0 {
                // Weighted by area, so that a merged cube lies where most of its surface is.
                let mean_m = (moment / area_m2).as_vec3().to_array();
                let solid = Solid { mean_m, area_m2: area_m2 as f32 };
                cells.entry(cell).or_default().push(solid);
            }
        }
        for solids in cells.values_mut() {
            // Stable, so that cubes of equal height keep their order.
            solids.sort_by(|a, b| a.mean_m[2].total_cmp(&b.mean_m[2]));
            // Solids count towards a memory budget, so that spare capacity would be a waste.
            solids.shrink_to_fit();
        }
        Solids { cells }
    }
}

fn cell_at(point_m: DVec2) -> [i32; 2] {
    (point_m / CELL_M).floor().as_ivec2().to_array()
}

fn corner_m(cell: [i32; 2]) -> DVec2 {
    let [x, y] = cell.map(f64::from);
    CELL_M * DVec2::new(x, y)
}
