//! What a frame draws: a function of its cameras, the profile and the manifest's table alone.

use glam::DVec3;

use wildcity_scene::manifest::Section;
use wildcity_scene::{Manifest, RenderProfile};

use super::BlockIndex;

/// A camera, as far as it matters here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    /// Its centre in the world, in metres.
    pub position_m: DVec3,
    /// Its larger focal length, in pixels.
    pub focal_px: f64,
}

/// One level of one block that a frame draws: places in [`Manifest::chunks`] and in
/// [`ChunkEntry::sections`](wildcity_scene::manifest::ChunkEntry::sections).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SectionRef {
    /// The chunk.
    pub chunk: usize,
    /// Its section.
    pub section: usize,
}

/// The sections that a frame draws, in order of (cell y, cell x, block): one for every block within
/// `reach_m` of a camera.
///
/// An error of `e` metres at a distance of `d` is `f e / d` pixels wide. A block is drawn at the
/// coarsest level for which that is at most `tau_px`, with the longest focal length of the frame, and
/// the distance of the nearest camera from the box of everything in the block. Memory has no say.
///
/// WorstCaseKey at every block of the twin; whoever asks often keeps an [`BlockIndex`].
pub fn demand(manifest: &Manifest, eyes: &[Viewpoint], profile: &RenderProfile) -> Vec<SectionRef> {
    BlockIndex::new(manifest).demand(manifest, eyes, profile)
}

/// The coarsest level of a block, an index of its sections in order of level, whose error is at most
/// `tau_px` from a distance.
pub(super) fn coarsest_level(
    block: &[Section],
    focal_px: f64,
    distance_m: f64,
    tau_px: f64,
) -> usize {
    // Errors rise with the level, and level 0 has none.
    let small = |error_m: f32| focal_px * f64::from(error_m) <= tau_px * distance_m;
    block.iter().rposition(|section| small(section.error_m)).unwrap_or(0)
}

/// The longest focal length of a frame, in pixels.
pub(super) fn longest_px(eyes: &[Viewpoint]) -> f64 {
    eyes.iter().fold(0.0_f64, |most, eye| most.max(eye.focal_px))
}
