//! The inputs that determine which level of detail of a block a frame draws.

use glam::DVec3;

use wildcity_scene::manifest::Section;

/// The part of a camera that decides which sections a frame draws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    /// The camera's centre in the world, in metres.
    pub position_m: DVec3,
    /// The larger of its two focal lengths, in pixels.
    pub focal_px: f64,
}

/// One level of one block that a frame draws, as indices into
/// [`Manifest::chunks`](wildcity_scene::Manifest::chunks) and
/// [`ChunkEntry::sections`](wildcity_scene::manifest::ChunkEntry::sections).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SectionRef {
    /// Index of the chunk.
    pub chunk: usize,
    /// Index of the section within its chunk.
    pub section: usize,
}

/// The coarsest level of a block with an error of at most `tau_px` pixels at a distance, as an
/// index into the block's sections in order of level.
pub(super) fn coarsest_level(
    block: &[Section],
    focal_px: f64,
    distance_m: f64,
    tau_px: f64,
) -> usize {
    // `f e / d <= tau` without the division, so that a distance of 0 needs no special case. Errors
    // rise with the level, and level 0 has none.
    let small = |error_m: f32| focal_px * f64::from(error_m) <= tau_px * distance_m;
    // From the coarsest level down: the first that passes is drawn. Level 0 passes at every
    // distance, so that 0 is only for a block without sections.
    block.iter().rposition(|section| small(section.error_m)).unwrap_or(0)
}

/// The longest focal length of a frame, in pixels.
pub(super) fn longest_focal_px(viewpoints: &[Viewpoint]) -> f64 {
    viewpoints.iter().fold(0.0_f64, |longest, viewpoint| longest.max(viewpoint.focal_px))
}
