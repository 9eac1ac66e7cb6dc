//! Trust: confidence in an image, from 1 (as recorded) to 0 (no information).
//!
//! A twin is accurate at the poses where it was recorded. The trust is a product of three factors.
//! Two of them are one minus a measured share: of pixels that look down at the ground and have low
//! opacity, and of rays to the ground that leave the twin. The third cannot be measured: from other
//! poses, errors of the training become visible, and there is no recorded image to compare with. It
//! decays exponentially with the distance and the rotation from the nearest recorded pose. The rate
//! is a convention of this project; `tests/session/trust.rs` checks that the share of correct
//! pixels of a twin without training errors decays more slowly.
//!
//! It is computed on the render thread that finishes an image, from one in 256 of its pixels, while
//! other cameras are still rendered. The nearest keyframe is found in an index of boxes of 64
//! keyframes ([`wildcity_scene::route`]), so that 84 km of keyframes are not searched one by one.
//! An episode ends as `off_model` if the first factor of one of its poses was below
//! [`limits::OFF_MODEL_TRUST`](crate::limits::OFF_MODEL_TRUST), whether or not images have a trust;
//! and if the mean trust of an observation was, where they have one.

use std::collections::HashMap;

use glam::{DVec2, DVec3};

use wildcity_render::View;
use wildcity_scene::Manifest;
use wildcity_scene::chunk::{BLOCK_M, CELL_M};
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::route::BoxIndex;

/// Distance from the recorded poses at which the trust is 1/e, in metres; it is half at 3.5 m, in
/// the next lane.
// 5 m x ln 2 = 3.5 m.
const DECAY_M: f64 = 5.0;

/// Angle from the recorded pose at which the trust is 1/e, in radians. When a rig rotates in place,
/// its cameras look in directions that its other cameras recorded, so this decay is slow.
const DECAY_RAD: f64 = 12.0;

/// In the search for the nearest recorded pose, a rotation of one radian counts as this distance,
/// in metres.
// 5 / 12 = 0.42 m for a radian.
const METRES_PER_RAD: f64 = DECAY_M / DECAY_RAD;

/// Distance between sampled pixels, in rows and in columns. An image of 1440 x 928 px has 5,220
/// samples, one per 16 x 16 px, so that a share has a standard error of at most 0.7 %.
// 90 x 58 = 5,220, and √(1/4 / 5,220) = 0.7 %.
const PIXEL_STRIDE: usize = 16;

/// The rays of every fourth of these samples, in rows and in columns, are followed through the map.
/// An image of 1440 x 928 px has 345 of them, one per 64 x 64 px.
// ⌈90 / 4⌉ x ⌈58 / 4⌉ = 23 x 15 = 345.
const RAY_STRIDE: usize = 4;

/// How far a ray is followed, in metres: through 13 blocks.
const RAY_M: f64 = 200.0;

/// A ray that descends less than this per metre counts as looking at the horizon and not at the
/// ground: from 1.6 m above a road, it meets the road at a distance of more than 80 m.
// 1.6 m / 0.02 = 80 m.
const MIN_DESCENT: f64 = 0.02;

/// A pixel with less opacity is a hole.
const HOLE_OPACITY: f32 = 0.5;

/// Confidence in an image, and the values that it is computed from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trust {
    /// 1 at a recorded pose, 0 without any information.
    pub value: f64,
    /// From the rig to the nearest recorded keyframe, in metres.
    pub distance_m: f64,
    /// Angle between the rig's orientation and that of the keyframe, in radians.
    pub angle_rad: f64,
    /// Share of pixels with less than half opacity, of those that look down at the ground.
    pub low_coverage: f64,
    /// Of the rays that look down at the ground, the share that meets no block of the twin within
    /// 200 m. For an image without such rays: 1 if the twin has no block within 200 m, else 0.
    pub outside: f64,
}

/// The poses at which a twin was recorded.
#[derive(Debug)]
pub struct RecordedPoses {
    keyframes: Vec<Pose>,
    boxes: BoxIndex,
}

/// Where a twin was recorded and trained.
#[derive(Debug)]
pub struct TrainingCoverage {
    recorded: RecordedPoses,
    /// Lowest and highest content of each 16 m block of the map, in metres.
    heights_m: HashMap<[i64; 2], [f64; 2]>,
}

/// Distance and angle from a recorded pose.
struct Deviation {
    distance_m: f64,
    angle_rad: f64,
}

/// Result for the sampled pixels that look down at the ground: shares from 0 to 1.
struct GroundShares {
    /// Share of the pixels that have low opacity.
    holes: f64,
    /// Share of the followed rays that left the twin.
    outside: f64,
}

impl RecordedPoses {
    /// The poses of all recorded drives of a version of a twin; `None` if there is no drive.
    pub fn new(manifest: &Manifest) -> Option<Self> {
        let drives = manifest.trajectories.iter();
        let keyframes: Vec<Pose> =
            drives.flat_map(|drive| drive.keyframes.iter().map(|key| key.world_from_rig)).collect();
        if keyframes.is_empty() {
            return None;
        }
        let point = |pose: &Pose| Bounds { min_m: pose.position_m, max_m: pose.position_m };
        let boxes = BoxIndex::new(&keyframes.iter().map(point).collect::<Vec<_>>());
        Some(Self { keyframes, boxes })
    }

    /// The trust of a pose of the rig, 0 to 1: that of an image without holes in it.
    pub fn trust(&self, world_from_rig: &Pose) -> f64 {
        self.deviation(world_from_rig).trust()
    }

    /// Distance and angle from the nearest keyframe.
    fn deviation(&self, world_from_rig: &Pose) -> Deviation {
        let here_m = world_from_rig.position_m;
        let deviation_from = |index: usize| {
            let recorded = &self.keyframes[index];
            Deviation {
                distance_m: recorded.position_m.distance(here_m),
                angle_rad: recorded.rotation.angle_between(world_from_rig.rotation),
            }
        };
        // Never below the distance, with which the index excludes boxes.
        let cost_m = |index: usize| {
            let Deviation { distance_m, angle_rad } = deviation_from(index);
            distance_m + METRES_PER_RAD * angle_rad
        };
        // There is at least one keyframe, so the search finds one; 0 is never used.
        let nearest = self.boxes.min_cost(here_m, cost_m).map_or(0, |(index, _)| index);
        deviation_from(nearest)
    }
}

impl Deviation {
    fn trust(&self) -> f64 {
        (-self.distance_m / DECAY_M - self.angle_rad / DECAY_RAD).exp()
    }
}

impl TrainingCoverage {
    /// The coverage of a version of a twin; `None` without a recorded drive.
    pub fn new(manifest: &Manifest) -> Option<Self> {
        let recorded = RecordedPoses::new(manifest)?;
        let mut heights_m: HashMap<[i64; 2], [f64; 2]> = HashMap::new();
        for chunk in &manifest.chunks {
            for section in chunk.full_detail() {
                let bounds = chunk.section_bounds(section);
                // A cell of 64 m has 4 x 4 blocks.
                let block_in_cell = [section.block % 4, section.block / 4].map(i64::from);
                let block =
                    [0, 1].map(|axis| 4 * i64::from(chunk.cell[axis]) + block_in_cell[axis]);
                // An empty range, which the first section replaces.
                let height = heights_m.entry(block).or_insert([f64::INFINITY, f64::NEG_INFINITY]);
                *height = [height[0].min(bounds.min_m.z), height[1].max(bounds.max_m.z)];
            }
        }
        Some(Self { recorded, heights_m })
    }

    /// The trust of one image of a rig. `opacity` is the image's opacity map, row by row.
    pub fn trust(&self, world_from_rig: &Pose, view: &View, opacity: &[f32]) -> Trust {
        let deviation = self.recorded.deviation(world_from_rig);
        let GroundShares { holes, outside } = self.ground_shares(view, opacity);
        let value = deviation.trust() * (1.0 - holes) * (1.0 - outside);
        let Deviation { distance_m, angle_rad } = deviation;
        Trust { value, distance_m, angle_rad, low_coverage: holes, outside }
    }

    /// Samples the pixels that look down at the ground.
    fn ground_shares(&self, view: &View, opacity: &[f32]) -> GroundShares {
        let width = view.camera.width_px as usize;
        let height = view.camera.height_px as usize;
        let from_m = view.world_from_camera.position_m;
        // A pixel counts for the holes, and every sixteenth of them also for the rays.
        let mut pixels = 0_u64;
        let mut holes = 0_u64;
        let mut rays = 0_u64;
        let mut outside = 0_u64;
        // Rays to the ground that were not followed.
        let mut skipped: Vec<DVec3> = Vec::new();
        // Samples begin in the middle of the first stride, so that even a small image has one.
        let samples = |side: usize| (PIXEL_STRIDE.min(side) / 2..side).step_by(PIXEL_STRIDE);
        for (sample_row, row) in samples(height).enumerate() {
            for (sample_column, column) in samples(width).enumerate() {
                let at_px = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                // Outside of the lens there is no ray.
                let Some(ray) = view.ray_world(at_px).filter(|ray| ray.z < -MIN_DESCENT) else {
                    continue;
                };
                pixels += 1;
                holes += u64::from(opacity[row * width + column] < HOLE_OPACITY);
                let is_followed = sample_row % RAY_STRIDE == 0 && sample_column % RAY_STRIDE == 0;
                if is_followed {
                    rays += 1;
                    outside += u64::from(!self.meets_content(from_m, ray));
                } else if rays == 0 {
                    // Kept until the first ray is followed. In a large image that is soon.
                    skipped.push(ray);
                }
            }
        }
        if rays == 0 {
            // An image of less than 64 rows may have all of its followed samples above the horizon.
            rays = skipped.len() as u64;
            outside =
                skipped.iter().filter(|ray| !self.meets_content(from_m, **ray)).count() as u64;
        }
        // Nothing looks down at the ground, as in an image of the sky.
        if rays == 0 {
            let outside = if self.is_near_content(from_m) { 0.0 } else { 1.0 };
            return GroundShares { holes: 0.0, outside };
        }
        let share = |part: u64, of: u64| part as f64 / of.max(1) as f64;
        GroundShares { holes: share(holes, pixels), outside: share(outside, rays) }
    }

    /// Whether the twin has a block within [`RAY_M`], in any direction.
    fn is_near_content(&self, from_m: DVec3) -> bool {
        // 12 blocks each way: at most 25 x 25 = 625 look-ups.
        let around = (RAY_M / BLOCK_M) as i64;
        let here = [from_m.x, from_m.y].map(|m| block_index(m) as i64);
        (-around..=around).any(|x| {
            (-around..=around).any(|y| self.heights_m.contains_key(&[here[0] + x, here[1] + y]))
        })
    }

    /// Whether a ray passes through the height of the content of a block, within [`RAY_M`]. The ray
    /// descends, and has unit length.
    fn meets_content(&self, from_m: DVec3, ray: DVec3) -> bool {
        // From block to block through the map (Amanatides and Woo 1987).
        // As f64, because walls are computed from it. The values are far below 2⁵³.
        let mut block = [block_index(from_m.x), block_index(from_m.y)];
        let mut enter_m = 0.0;
        while enter_m < RAY_M {
            // The ray leaves the block through the nearer of the two walls that it moves towards.
            // A wall that the ray never meets counts as its end.
            let mut walls_m = [RAY_M; 2];
            for axis in 0..2 {
                if ray[axis] != 0.0 {
                    let wall = block[axis] + f64::from(ray[axis] > 0.0);
                    walls_m[axis] = (wall * BLOCK_M - 0.5 * CELL_M - from_m[axis]) / ray[axis];
                }
            }
            let axis = usize::from(walls_m[1] < walls_m[0]);
            let leave_m = walls_m[axis].min(RAY_M);
            if let Some([low_m, high_m]) = self.heights_m.get(&block.map(|index| index as i64)) {
                // It descends from its height at the entry to that at the exit.
                let top_m = from_m.z + enter_m * ray.z;
                let bottom_m = from_m.z + leave_m * ray.z;
                // The heights of the ray in this block and those of the content overlap.
                if bottom_m <= *high_m && top_m >= *low_m {
                    return true;
                }
            }
            // An axis without motion is only chosen if the ray ends here.
            block[axis] += ray[axis].signum();
            enter_m = leave_m;
        }
        false
    }
}

/// Index of the block at a coordinate, in x or in y. Cells, and so blocks, are offset by half a
/// cell from the origin.
fn block_index(m: f64) -> f64 {
    ((m + 0.5 * CELL_M) / BLOCK_M).floor()
}
