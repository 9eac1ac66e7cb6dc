//! How far an image may be believed: a twin is right where it was recorded.
//!
//! Two parts are seen in the image or the map, and count as the shares that they are: pixels that look
//! down and meet nothing, and rays to ground that was never trained. The third is seen in no image: what
//! was trained looks right from the recorded places, and nobody has looked from elsewhere. It fades with
//! the distance from there, and how fast is a convention that `tests/render/trust.rs` holds against what
//! a twin without training errors loses: less.

use std::collections::HashMap;

use glam::{DVec2, DVec3};

use wildcity_render::View;
use wildcity_scene::Manifest;
use wildcity_scene::chunk::{BLOCK_M, CELL_M};
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::route::BoxIndex;

/// Distance from the recorded places at which 1/e is left, in metres: half at 3.5 m, in the next lane.
const FADES_M: f64 = 5.0;

/// The same of a turn in place, in radians. A rig that looks around has recorded other cameras'
/// directions, too.
const FADES_RAD: f64 = 12.0;

/// A turn of so many metres is as far: between two drives through a place, the nearer one in this sense
/// is compared with.
const METRES_PER_RAD: f64 = FADES_M / FADES_RAD;

/// Every so many-th pixel is looked at, in rows and in columns: of 1440 x 928, 5,220 of 16 x 16, so that a
/// share is right within 0.7 %.
const PIXEL_STRIDE: usize = 16;

/// Every so many-th of those rays is followed through the map: of 1440 x 928, 345 of 64 x 64 px.
const RAY_STRIDE: usize = 4;

/// How far rays are followed, in metres: through 13 blocks.
const RAY_M: f64 = 200.0;

/// A ray that falls more slowly, per metre of its way, is taken to look at the horizon: from 1.6 m above a
/// road it meets it beyond 80 m.
const FALLS: f64 = 0.02;

/// Less opacity than this is a hole.
const HOLE_OPACITY: f32 = 0.5;

/// How far an image may be believed, and why.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trust {
    /// 1 where and as it was recorded, 0 where nothing is known.
    pub value: f64,
    /// From the rig to the nearest recorded keyframe, in metres.
    pub distance_m: f64,
    /// Between the rig's axes there and here, in radians.
    pub angle_rad: f64,
    /// Share of pixels of less than half opacity, of those that look down at the ground.
    pub low_coverage: f64,
    /// Share of rays that meet no block of the twin within 200 m, of those that look down.
    pub outside: f64,
}

/// Where a twin was recorded and trained.
#[derive(Debug)]
pub struct TrainingCoverage {
    keyframes: Vec<Pose>,
    boxes: BoxIndex,
    /// Lowest and highest content of every 16 m block of the map, in metres.
    columns: HashMap<[i64; 2], [f64; 2]>,
}

impl TrainingCoverage {
    /// Of a version of a twin; `None` without a recorded drive.
    pub fn new(manifest: &Manifest) -> Option<Self> {
        let logs = manifest.trajectories.iter();
        let keyframes: Vec<Pose> =
            logs.flat_map(|log| log.keyframes.iter().map(|key| key.world_from_rig)).collect();
        if keyframes.is_empty() {
            return None;
        }
        let point = |pose: &Pose| Bounds { min_m: pose.position_m, max_m: pose.position_m };
        let boxes = BoxIndex::new(&keyframes.iter().map(point).collect::<Vec<_>>());
        let mut columns: HashMap<[i64; 2], [f64; 2]> = HashMap::new();
        for chunk in &manifest.chunks {
            for section in chunk.sections.iter().filter(|section| section.level == 0) {
                let bounds = chunk.section_bounds(section);
                let block = [section.block % 4, section.block / 4].map(i64::from);
                let place = [0, 1].map(|axis| 4 * i64::from(chunk.cell[axis]) + block[axis]);
                let column = columns.entry(place).or_insert([f64::INFINITY, f64::NEG_INFINITY]);
                *column = [column[0].min(bounds.min_m.z), column[1].max(bounds.max_m.z)];
            }
        }
        Some(Self { keyframes, boxes, columns })
    }

    /// How far one image of a rig may be believed; `opacity` is the image's, row by row.
    pub fn trust(&self, world_from_rig: &Pose, view: &View, opacity: &[f32]) -> Trust {
        let (distance_m, angle_rad) = self.nearest(world_from_rig);
        let (low_coverage, outside) = self.seen(view, opacity);
        let recorded = (-distance_m / FADES_M - angle_rad / FADES_RAD).exp();
        let value = recorded * (1.0 - low_coverage) * (1.0 - outside);
        Trust { value, distance_m, angle_rad, low_coverage, outside }
    }

    /// Distance and angle to the nearest keyframe.
    fn nearest(&self, world_from_rig: &Pose) -> (f64, f64) {
        let here_m = world_from_rig.position_m;
        let apart = |index: usize| {
            let there = &self.keyframes[index];
            let angle_rad = there.rotation.angle_between(world_from_rig.rotation);
            (there.position_m.distance(here_m), angle_rad)
        };
        let cost_m = |index: usize| {
            let (distance_m, angle_rad) = apart(index);
            distance_m + METRES_PER_RAD * angle_rad
        };
        // There is one, and it is item 0 of none.
        apart(self.boxes.min_cost(here_m, cost_m).map_or(0, |(index, _)| index))
    }

    /// Shares of holes and of untrained ground among what is below the horizon; none if nothing is.
    fn seen(&self, view: &View, opacity: &[f32]) -> (f64, f64) {
        let (width, height) = (view.camera.width_px as usize, view.camera.height_px as usize);
        let from_m = view.world_from_camera.position_m;
        let (mut pixels, mut holes, mut rays, mut outside) = (0_u64, 0_u64, 0_u64, 0_u64);
        // From the middle of the first field of pixels: small images have a sample, too.
        let places = |side: usize| (PIXEL_STRIDE.min(side) / 2..side).step_by(PIXEL_STRIDE);
        for (row_number, row) in places(height).enumerate() {
            for (column_number, column) in places(width).enumerate() {
                let at_px = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                let Some(ray) = view.ray_world(at_px).filter(|ray| ray.z < -FALLS) else {
                    continue;
                };
                pixels += 1;
                holes += u64::from(opacity[row * width + column] < HOLE_OPACITY);
                if (row_number + column_number) % RAY_STRIDE == 0 && row_number % RAY_STRIDE == 0 {
                    rays += 1;
                    outside += u64::from(!self.meets(from_m, ray));
                }
            }
        }
        let share = |part: u64, of: u64| part as f64 / of.max(1) as f64;
        (share(holes, pixels), share(outside, rays))
    }

    /// Whether a ray goes through the height of something in a block of the map.
    fn meets(&self, from_m: DVec3, ray: DVec3) -> bool {
        let block_of = |m: f64| ((m + 0.5 * CELL_M) / BLOCK_M).floor();
        let mut block = [block_of(from_m.x), block_of(from_m.y)];
        let mut at_m = 0.0;
        while at_m < RAY_M {
            // Where it leaves the block: the nearer of two walls.
            let mut leaves_m = [RAY_M; 2];
            for axis in 0..2 {
                if ray[axis] != 0.0 {
                    let wall = block[axis] + f64::from(ray[axis] > 0.0);
                    leaves_m[axis] = (wall * BLOCK_M - 0.5 * CELL_M - from_m[axis]) / ray[axis];
                }
            }
            let axis = usize::from(leaves_m[1] < leaves_m[0]);
            let until_m = leaves_m[axis].min(RAY_M);
            if let Some([low_m, high_m]) = self.columns.get(&block.map(|index| index as i64)) {
                // It falls: from its height where it enters to that where it leaves.
                let [top_m, bottom_m] = [at_m, until_m].map(|way_m| from_m.z + way_m * ray.z);
                if bottom_m <= *high_m && top_m >= *low_m {
                    return true;
                }
            }
            block[axis] += ray[axis].signum();
            at_m = until_m;
        }
        false
    }
}
