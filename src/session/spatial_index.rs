//! What of a version of a twin is near a place: its sections at full detail, and its recorded
//! drives.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use glam::DVec2;

use wildcity_scene::chunk::{BLOCK_M, CELL_M};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_sim::DriveBoxes;
use wildcity_twin::store::Version;

use crate::observe::trust::RecordedPoses;

/// A block of 16 m by its place in the world, in x and in y.
pub(crate) type Block = [i64; 2];

/// Between two keyframes that are farther apart than this, in metres, nothing was recorded: the
/// drive has a gap.
const GAP_M: f64 = 64.0;

/// A section at full detail: the index of its chunk, and its own within the chunk.
pub(crate) type SectionId = [usize; 2];

/// A version of a twin by place.
#[derive(Debug)]
pub(crate) struct SpatialIndex {
    version: Arc<Version>,
    /// The sections that may have Gaussians in the block: blocks with few Gaussians share a section
    /// with others.
    sections: HashMap<Block, Vec<SectionId>>,
    /// Index of the drive, and of the keyframe with which a part of the drive begins that touches
    /// the block.
    drives: HashMap<Block, Vec<[usize; 2]>>,
    /// `None` without a recorded drive.
    recorded: Option<Arc<RecordedPoses>>,
    boxes: DriveBoxes,
}

impl SpatialIndex {
    pub(crate) fn new(version: Arc<Version>) -> Self {
        let manifest = &version.manifest;
        let mut sections: HashMap<Block, Vec<SectionId>> = HashMap::new();
        for (chunk_index, chunk) in manifest.chunks.iter().enumerate() {
            let center_m = CELL_M * DVec2::from_array(chunk.cell.map(f64::from));
            // The bounds are those of whole Gaussians, and the centres are within the cell. The end
            // of a cell is in the next one.
            let cell_m = [-0.5, 0.5 - 1e-9].map(|edge| center_m + CELL_M * edge);
            for (section_index, section) in chunk.sections.iter().enumerate() {
                if section.is_full_detail() {
                    let bounds = chunk.section_bounds(section);
                    let [low_m, high_m] = [bounds.min_m, bounds.max_m]
                        .map(|corner_m| corner_m.truncate().clamp(cell_m[0], cell_m[1]));
                    // A section of few Gaussians may cover many blocks, up to the whole cell.
                    for block in blocks_between(low_m, high_m) {
                        sections.entry(block).or_default().push([chunk_index, section_index]);
                    }
                }
            }
        }
        let mut drives: HashMap<Block, Vec<[usize; 2]>> = HashMap::new();
        for (drive_index, drive) in manifest.trajectories.iter().enumerate() {
            for (key_index, pair) in drive.keyframes.windows(2).enumerate() {
                let [a_m, b_m] =
                    [&pair[0], &pair[1]].map(|key| key.world_from_rig.position_m.truncate());
                if a_m.distance(b_m) > GAP_M {
                    continue;
                }
                // Of the rectangle around the part: a few more than a slanted line touches.
                for block in blocks_between(a_m.min(b_m), a_m.max(b_m)) {
                    drives.entry(block).or_default().push([drive_index, key_index]);
                }
            }
        }
        let recorded = RecordedPoses::new(manifest).map(Arc::new);
        let boxes = DriveBoxes::new(&manifest.trajectories);
        Self { version, sections, drives, recorded, boxes }
    }

    pub(crate) fn version(&self) -> &Arc<Version> {
        &self.version
    }

    /// The sections that may have Gaussians in a rectangle, in a fixed order.
    pub(crate) fn sections(&self, low_m: DVec2, high_m: DVec2) -> BTreeSet<SectionId> {
        // Blocks may share sections. A set has each once, in an order that sums of areas can rely
        // on.
        let of_block = |block| self.sections.get(&block).into_iter().flatten().copied();
        blocks_between(low_m, high_m).flat_map(of_block).collect()
    }

    /// A section with its chunk.
    pub(crate) fn section(&self, [chunk, section]: SectionId) -> (&ChunkEntry, &Section) {
        let chunk = &self.version.manifest.chunks[chunk];
        (chunk, &chunk.sections[section])
    }

    /// The parts of the recorded drives, each between two keyframes, that may pass through a block.
    pub(crate) fn drives(&self, block: Block) -> impl Iterator<Item = [Pose; 2]> {
        let drives = &self.version.manifest.trajectories;
        self.drives.get(&block).into_iter().flatten().map(|[drive, key]| {
            // The key is the first of a pair, so that there is one after it.
            let keyframes = &drives[*drive].keyframes;
            [keyframes[*key].world_from_rig, keyframes[*key + 1].world_from_rig]
        })
    }

    /// The boxes of the recorded drives, by which the ground is found.
    pub(crate) fn boxes(&self) -> &DriveBoxes {
        &self.boxes
    }

    /// The recorded poses; `None` without a recorded drive.
    pub(crate) fn recorded(&self) -> Option<&Arc<RecordedPoses>> {
        self.recorded.as_ref()
    }
}

/// The block of a point.
pub(crate) fn block_at(point_m: DVec2) -> Block {
    // Cells, and so blocks, are offset by half a cell from the origin.
    ((point_m + 0.5 * CELL_M) / BLOCK_M).floor().as_i64vec2().to_array()
}

/// The blocks that a rectangle touches, from west to east and from south to north.
pub(crate) fn blocks_between(low_m: DVec2, high_m: DVec2) -> impl Iterator<Item = Block> {
    // None if the rectangle is empty.
    let [[west, south], [east, north]] = [low_m, high_m].map(block_at);
    (west..=east).flat_map(move |x| (south..=north).map(move |y| [x, y]))
}
