//! Which kernels run on a device. No pixel depends on it.

use wgpu::{AdapterInfo, DeviceType};

use super::layout::RASTER_BATCH;

/// Thresholds between kernels that compute the same. Tests set them to run each kernel on every device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tuning {
    /// Tiles with more splats than this are blended by a kernel of their own, with four times as many threads for a tile;
    /// with the largest number there are no such tiles.
    pub long_tile_splats: u32,
}

impl Tuning {
    /// The fastest kernels of a device.
    pub(super) fn new(info: &AdapterInfo) -> Self {
        // A software device takes as long for a thread of one pixel as for one of four.
        let is_software = info.device_type == DeviceType::Cpu;
        Self { long_tile_splats: if is_software { u32::MAX } else { 16 * RASTER_BATCH } }
    }

    /// Whether there may be tiles with long lists.
    pub(super) fn has_long_tiles(self) -> bool {
        self.long_tile_splats < u32::MAX
    }
}
