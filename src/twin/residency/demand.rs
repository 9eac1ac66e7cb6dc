//! The inputs that determine which level of detail of a block a view draws.

use glam::DVec3;

use wildcity_scene::manifest::Section;
use wildcity_scene::{Rig, Selection, ViewSet};

/// The part of a camera that decides which sections its view draws.
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

/// The sections that a frame draws.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SelectedSections {
    /// Those of all views, in order of (cell y, cell x, block, level).
    pub sections: Vec<SectionRef>,
    /// Which views draw which of them; `None` if all views draw all.
    pub selection: Option<Selection>,
}

impl SelectedSections {
    /// The sections, and the views that draw each.
    pub fn iter(&self) -> impl Iterator<Item = (SectionRef, ViewSet)> {
        let by_chunk = self.selection.as_ref().map(|selection| &selection.by_chunk);
        let views = move |index: usize| by_chunk.map_or(ViewSet::ALL, |views| views[index]);
        self.sections.iter().enumerate().map(move |(index, &section)| (section, views(index)))
    }
}

impl Viewpoint {
    /// Most viewpoints of a frame.
    pub const MAX: usize = Rig::MAX_CAMERAS;
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
