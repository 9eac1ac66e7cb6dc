//! Instance ids: whose splat brings a pixel's transmittance to a half or less. Twin of `shaders/instances.wgsl`.

use super::project::Projected;
use super::resolve::BLOCKS;
use wildcity_scene::chunk::LANES;

/// For each pixel of a tile, the place of the splat that halves the transmittance, plus 1; 0 if none has.
pub(super) type HalvedBy = [[u32; LANES]; BLOCKS];

/// Before any splat is blended.
pub(super) const NOT_HALVED: HalvedBy = [[0; LANES]; BLOCKS];

/// The instance of a pixel.
pub(super) fn instance_of(projected: &Projected, halved_by: u32) -> u16 {
    halved_by.checked_sub(1).map_or(0, |place| projected.instance(place))
}
