//! What a frame draws: a function of its cameras, the profile and the manifest's table alone.

use glam::DVec3;

use crate::scene::{Manifest, RenderProfile};

/// A camera, as far as it matters here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eye {
    /// Its centre in the world, in metres.
    pub position_m: DVec3,
    /// Its larger focal length, in pixels.
    pub focal_px: f64,
}

/// One level of one block that a frame draws: places in [`Manifest::chunks`] and in
/// [`ChunkEntry::sections`](crate::scene::manifest::ChunkEntry::sections).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Needed {
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
pub fn demand(manifest: &Manifest, eyes: &[Eye], profile: &RenderProfile) -> Vec<Needed> {
    let focal_px = eyes.iter().fold(0.0_f64, |most, eye| most.max(eye.focal_px));
    let mut needed = Vec::new();
    for (chunk, entry) in manifest.chunks.iter().enumerate() {
        let mut first = 0;
        for block in entry.sections.chunk_by(|a, b| a.block == b.block) {
            let bounds = entry.section_bounds(&block[0]);
            let distance_m = eyes
                .iter()
                .map(|eye| bounds.distance_m(eye.position_m))
                .fold(f64::INFINITY, f64::min);
            if profile.reach_m.is_none_or(|reach_m| distance_m <= reach_m) {
                // Errors rise with the level, and level 0 has none.
                let small =
                    |error_m: f32| focal_px * f64::from(error_m) <= profile.tau_px * distance_m;
                let coarsest = block.iter().rposition(|section| small(section.error_m));
                needed.push(Needed { chunk, section: first + coarsest.unwrap_or(0) });
            }
            first += block.len();
        }
    }
    needed
}
