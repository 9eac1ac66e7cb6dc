//! Maps that a frame needs and that its observation does not hold.

use crate::observe::encode::PixelMaps;
use crate::repair::session_repair::SessionRepair;

/// Trust is computed from opacity, normals are computed from depth, and a repair model may need
/// each of them.
pub(super) struct NeededMaps {
    pub(super) opacity: bool,
    pub(super) depth: bool,
    pub(super) normals: bool,
}

impl NeededMaps {
    /// The maps that are needed in addition to those that the observation `holds`, if the capture
    /// `is_shown`. `repair` is the session's, if the images of the capture may be repaired.
    pub(super) fn new(
        holds: PixelMaps,
        is_shown: bool,
        has_trust: bool,
        repair: Option<&SessionRepair>,
    ) -> Self {
        let held = |map: bool| map && is_shown;
        let normals = repair.is_some_and(SessionRepair::needs_normals);
        let depth = held(holds.normals) || repair.is_some_and(SessionRepair::needs_depth);
        Self {
            opacity: has_trust && !held(holds.opacity),
            depth: depth && !held(holds.depth),
            normals: normals && !held(holds.normals),
        }
    }

    /// Floats a pixel: opacity and depth take one each, a normal three.
    pub(super) fn values(&self) -> u64 {
        u64::from(self.opacity) + u64::from(self.depth) + 3 * u64::from(self.normals)
    }
}
