//! Bandwidth model: the fewest bytes that each stage must move, computed from the counts of a
//! frame. It is the memory side of the stage's roofline.

use super::layout::{
    DIGITS, EXPAND_BATCH, Frame as GpuFrame, GEOMETRY_WORDS, MACRO_COLUMNS, MACRO_ROWS, SOA_BLOCK,
    SORT_BLOCK,
};
use super::read_back::Head;
use super::resolve::Planes;
use super::sort::DIGIT_BITS;
use crate::Frame;
use crate::constants::{DEPTH_BITS, TILE_PX};
use wildcity_scene::chunk::CLUSTER;
use wildcity_scene::sh;

/// Counts of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameCounts {
    /// SH degree of the scene.
    pub sh_degree: u8,
    pub views: u32,
    /// Pixels of all views.
    pub pixels: u64,
    /// Bytes per pixel of the values that were requested: 3 for colours of 8 bits, 4 for each other
    /// value.
    pub pixel_bytes: u64,
    /// Tiles of all views.
    pub tiles: u64,
    /// Macro tiles of all views.
    pub macro_tiles: u64,
    /// (Cluster, view) pairs that the host did not cull.
    pub cluster_views: u64,
    /// Visible (Gaussian, view) pairs.
    pub splats: u64,
    /// (Splat, macro tile) pairs.
    pub touches: u64,
    /// (Splat, tile) pairs of all views.
    pub instances: u64,
    /// Evaluations of a splat at a pixel.
    pub evaluations: u64,
}

impl FrameCounts {
    /// The counts of a frame before its first region is drawn.
    pub(super) fn new(frame: &Frame<'_>, planes: Planes, gpu_frame: &GpuFrame) -> Self {
        Self {
            sh_degree: frame.scene.sh_degree(),
            views: gpu_frame.views,
            pixels: frame.views.iter().map(|view| view.camera.pixels() as u64).sum(),
            pixel_bytes: planes.tile_bytes() / u64::from(TILE_PX * TILE_PX),
            tiles: gpu_frame.tiles.into(),
            macro_tiles: gpu_frame.macro_tiles.into(),
            ..Self::default()
        }
    }

    /// Adds the counts of a region.
    pub(super) fn add(&mut self, cluster_views: u32, head: &Head) {
        let Head { counters, tile_counters, .. } = head;
        self.cluster_views += u64::from(cluster_views);
        self.splats += u64::from(counters.splats);
        self.touches += u64::from(counters.touches);
        self.instances += u64::from(counters.instances);
        self.evaluations += tile_counters.evaluations();
    }

    /// Name and bytes of each stage: what it reads and writes if each kernel reads and writes every
    /// array exactly once, and nothing stays in a cache from one kernel to the next.
    ///
    /// | stage | per | bytes |
    /// |---|---|---|
    /// | project | cluster view | header, geometry of 256 Gaussians (36 B each), a visibility bit per Gaussian written and read, cluster view, count, prefix sum |
    /// | | visible pair | geometry and colour; shape 32, colour 16, key and index 8 |
    /// | sort | visible pair, pass of 8 bits | histogram 4, key and value read and written 16, counters 5/4 |
    /// | bin | visible pair | key, index, and shape twice (40 each), offset and its prefix sum 20 |
    /// | | touch | macro tile, splat, mask 12 |
    /// | tile sort | touch, pass of 8 bits | histogram 4, key and two values read and written 24, counters 5/4 |
    /// | expand | touch | macro tile 4, mask 8, splat 4 |
    /// | | instance | splat 4 |
    /// | | tile of a batch of touches | offset and its prefix sum 20 |
    /// | | tile | range 8 |
    /// | | macro tile | range 8, written once and read three times; number of batches, its prefix sum, and two reads of it 24 |
    /// | rasterize | visible pair | shape and colour 48, once: neighbouring tiles find them in the cache |
    /// | | instance, tile, pixel | splat 4; range 8; 3 for colours of 8 bits, 4 for each other value |
    pub fn stage_bytes(&self) -> [(&'static str, u64); 6] {
        let Self { cluster_views, splats, touches, instances, tiles, macro_tiles, .. } = *self;
        let cluster = CLUSTER as u64;
        let geometry = 4 * u64::from(GEOMETRY_WORDS);
        let color = 4 * (3 * sh::coefficients(self.sh_degree) as u64).div_ceil(2);
        let header = 4 * u64::from(SOA_BLOCK);
        // A counter is written by the histogram, read by the prefix sum's first pass, read and
        // written by its last pass, and read by the scatter.
        let counters = |keys: u64| keys.div_ceil(SORT_BLOCK.into()) * u64::from(DIGITS) * 4 * 5;
        let sorted = |keys: u64, bits: u32, values: u64| {
            let pass = keys * (4 + 2 * 4 * (1 + values)) + counters(keys);
            u64::from(bits.div_ceil(DIGIT_BITS)) * pass
        };
        let scanned = 4 + 12 + 4;
        let batches = touches.div_ceil(EXPAND_BATCH.into());
        let batch_tiles = batches * u64::from(MACRO_COLUMNS * MACRO_ROWS);
        let bits = |number: u64| u64::BITS - number.leading_zeros();
        let depth_bits = DEPTH_BITS + bits(u64::from(self.views.max(1) - 1));
        [
            (
                "project",
                cluster_views * (header + cluster * geometry + 2 * cluster / 8 + 2 * 8 + scanned)
                    + splats * (geometry + color + 32 + 16 + 8),
            ),
            ("sort", sorted(splats, depth_bits, 1)),
            ("bin", splats * (2 * 40 + scanned) + touches * 12),
            ("tile sort", sorted(touches, bits(macro_tiles), 2)),
            (
                "expand",
                touches * 16 + instances * 4 + batch_tiles * scanned + tiles * 8 + macro_tiles * 56,
            ),
            ("rasterize", splats * 48 + instances * 4 + tiles * 8 + self.pixels * self.pixel_bytes),
        ]
    }

    /// Estimated number of multiply-adds, or instructions of the same cost, in stage rasterize: 18
    /// for four evaluations, of which six are shared by the four pixels. It is not a bound: pixels
    /// that have stopped are counted although they take none, and the ten additional ones of each
    /// blended pixel are not counted.
    pub fn rasterize_operations(&self) -> u64 {
        self.evaluations * 9 / 2
    }
}
