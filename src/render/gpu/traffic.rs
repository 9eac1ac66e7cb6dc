//! The least that each stage must move, from what a frame counted: its memory roofline.

use super::layout::{
    Counters, DIGITS, Frame as GpuFrame, GEOMETRY_WORDS, RASTER_BATCH, SORT_BLOCK, STRIP,
};
use super::resolve::Planes;
use super::sort::DIGIT_BITS;
use crate::Frame;
use crate::constants::{DEPTH_BITS, TILE_PX};
use wildcity_scene::chunk::CLUSTER;
use wildcity_scene::sh;

/// What the last frame counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameCounts {
    /// SH degree of the scene.
    pub sh_degree: u8,
    /// Views, their pixels, and how many 32-bit planes of these were asked for.
    pub views: u32,
    /// Pixels of all views.
    pub pixels: u64,
    /// 32-bit values per pixel that were asked for.
    pub planes: u64,
    /// Tiles of all views.
    pub tiles: u64,
    /// Macro tiles of all views.
    pub macros: u64,
    /// (Cluster, view) pairs that the host did not cull.
    pub clusters: u64,
    /// Visible (Gaussian, view) pairs.
    pub splats: u64,
    /// (Splat, macro tile) pairs.
    pub touches: u64,
    /// (Splat, tile) pairs.
    pub instances: u64,
    /// Batches of [`RASTER_BATCH`] splats that tiles blended.
    pub batches: u64,
}

impl FrameCounts {
    /// Of a frame of which nothing is drawn yet.
    pub(super) fn new(frame: &Frame<'_>, planes: Planes, gpu_frame: &GpuFrame) -> Self {
        Self {
            sh_degree: frame.scene.sh_degree(),
            views: gpu_frame.views,
            pixels: frame.views.iter().map(|view| view.camera.pixels() as u64).sum(),
            planes: planes.tile_bytes() / u64::from(4 * TILE_PX * TILE_PX),
            tiles: gpu_frame.tiles.into(),
            macros: gpu_frame.macros.into(),
            ..Self::default()
        }
    }

    /// Adds what a part of the frame counted.
    pub(super) fn add(&mut self, clusters: u32, counters: &Counters) {
        self.clusters += u64::from(clusters);
        self.splats += u64::from(counters.splats);
        self.touches += u64::from(counters.touches);
        self.instances += u64::from(counters.instances);
        self.batches += u64::from(counters.batches);
    }

    /// Bytes that each stage reads and writes if every array passes once per kernel, nothing is read
    /// twice by one, and all that is read again by another comes from memory again:
    ///
    /// | stage | per | bytes |
    /// |---|---|---|
    /// | project | cluster in a view | header and geometry of 256 (36 B each), a bit per Gaussian to and fro, item, count, prefix sum |
    /// | | visible pair | geometry and colour again; shape 32, colour 16, key and place 8 |
    /// | sort | visible pair, pass of 8 bits | histogram 4, key and value to and fro 16, counters 5/4 |
    /// | bin | visible pair | twice key, place and shape (40), offset and its prefix sum 20 |
    /// | | touch | macro tile, place, mask 12 |
    /// | tile sort | touch, pass | histogram 4, key and two values to and fro 24, counters 5/4 |
    /// | expand | touch | macro tile 4, mask 8, place 4 |
    /// | | instance | place 4 |
    /// | | tile | offset and its prefix sum 20, range 8 |
    /// | | macro tile | range 8, written once and read twice |
    /// | rasterize | visible pair | shape and colour 48, once: neighbouring tiles find them in the cache |
    /// | | instance, tile, pixel | place 4; range 8; 4 for each value that is asked for |
    pub fn stage_bytes(&self) -> [(&'static str, u64); 6] {
        let Self { clusters, splats, touches, instances, tiles, macros, .. } = *self;
        let cluster = CLUSTER as u64;
        let geometry = 4 * u64::from(GEOMETRY_WORDS);
        let color = 4 * (3 * sh::coefficients(self.sh_degree) as u64).div_ceil(2);
        let header = 4 * u64::from(STRIP);
        // A counter is written, read and written by the prefix sum, read once more to add up its
        // block, and read to place keys.
        let counters = |keys: u64| keys.div_ceil(SORT_BLOCK.into()) * u64::from(DIGITS) * 4 * 5;
        let sorted = |keys: u64, bits: u32, values: u64| {
            let pass = keys * (4 + 2 * 4 * (1 + values)) + counters(keys);
            u64::from(bits.div_ceil(DIGIT_BITS)) * pass
        };
        let scanned = 4 + 12 + 4;
        let bits = |number: u64| u64::BITS - number.leading_zeros();
        let depth_bits = DEPTH_BITS + bits(u64::from(self.views.max(1) - 1));
        [
            (
                "project",
                clusters * (header + cluster * geometry + 2 * cluster / 8 + 2 * 8 + scanned)
                    + splats * (geometry + color + 32 + 16 + 8),
            ),
            ("sort", sorted(splats, depth_bits, 1)),
            ("bin", splats * (2 * 40 + scanned) + touches * 12),
            ("tile sort", sorted(touches, bits(macros), 2)),
            ("expand", touches * 16 + instances * 4 + tiles * (scanned + 8) + macros * 24),
            ("rasterize", splats * 48 + instances * 4 + tiles * 8 + self.pixels * 4 * self.planes),
        ]
    }

    /// Multiply-adds and instructions of their cost that rasterize cannot do without: five per splat
    /// of a batch and pixel of the tile, for `d`, `u` (two), the exponent and its comparison. What is
    /// touched takes ten more; pixels that have stopped take none.
    pub fn rasterize_operations(&self) -> u64 {
        5 * self.batches * u64::from(RASTER_BATCH) * u64::from(TILE_PX * TILE_PX)
    }
}
