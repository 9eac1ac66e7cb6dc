//! Stage resolve, the host's part: copies the device's output, which is tile after tile, to the
//! rows of the targets.
//!
//! The arithmetic is in `shaders/resolve.wgsl`. Twin of `render/cpu/resolve.rs`.

use std::ops::Range;

use rayon::prelude::*;

use super::layout::FrameView;
use crate::Target;
use crate::constants::TILE_PX;
use crate::samples::SAMPLES;
use wildcity_scene::ViewSet;
use wildcity_scene::appearance::Appearance;

/// Pixels of a tile, and words of a plane of 32-bit values.
const PLANE: usize = (TILE_PX * TILE_PX) as usize;
/// A tile takes a multiple of this many words.
const TILE_WORDS: usize = 64;

/// Which values of a pixel the device computes and the host reads: those that any target requests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Planes {
    rgb8: bool,
    rgb: bool,
    opacity: bool,
    depth: bool,
    /// The owner of each pixel: instance ids, or classes.
    owners: bool,
    /// Whether owners have classes.
    semantics: bool,
    tiles: TileKinds,
}

/// What the tiles of a frame have: the pixels of its images, or 2 x 2 samples of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TileKinds {
    Pixels,
    /// Some have pixels, and some samples.
    Both,
    Samples,
}

/// The outputs that the targets of a frame request.
#[derive(Clone, Debug)]
pub(super) struct Outputs {
    pub(super) planes: Planes,
    /// Exposure and overlay of each camera; empty if no camera has either.
    pub(super) appearances: Vec<Appearance>,
    /// The views whose tiles have samples.
    pub(super) sampled: ViewSet,
}

impl Outputs {
    /// The outputs that these targets request. The tiles of the views `sampled` have samples.
    pub(super) fn from_targets(targets: &[Target<'_>], sampled: ViewSet) -> Self {
        let appearances = targets.iter().map(|t| t.appearance.cloned().unwrap_or_default());
        let appearances: Vec<Appearance> = appearances.collect();
        let all_identity = appearances.iter().all(Appearance::is_identity);
        // Without any, the shaders that have no background can run.
        let appearances = if all_identity { Vec::new() } else { appearances };
        Self { planes: Planes::from_targets(targets, sampled), appearances, sampled }
    }

    /// The outputs that a loss is a function of.
    pub(super) fn for_gradients(depth: bool) -> Self {
        let planes = Planes::for_gradients(depth);
        Self { planes, appearances: Vec::new(), sampled: ViewSet::default() }
    }
}

impl Planes {
    /// Three kinds of tiles, with or without each of five values.
    pub(super) const VARIANTS: usize = 3 * 32;

    /// The values that these targets request.
    fn from_targets(targets: &[Target<'_>], sampled: ViewSet) -> Self {
        let samples = (0..targets.len()).filter(|&view| sampled.contains(view)).count();
        let tiles = match samples {
            0 => TileKinds::Pixels,
            _ if samples == targets.len() => TileKinds::Samples,
            _ => TileKinds::Both,
        };
        let any = |requests: fn(&Target<'_>) -> bool| targets.iter().any(requests);
        Self {
            rgb8: any(|t| t.rgb8.is_some()),
            rgb: any(|t| t.rgba.is_some()),
            // Opacity is the fourth channel of rgba.
            opacity: any(|t| t.rgba.is_some() || t.opacity.is_some()),
            depth: any(|t| t.depth_m.is_some()),
            owners: any(|t| t.instances.is_some() || t.semantics.is_some()),
            semantics: any(|t| t.semantics.is_some()),
            tiles,
        }
    }

    /// Those that a loss is a function of.
    fn for_gradients(depth: bool) -> Self {
        let tiles = TileKinds::Pixels;
        Self {
            rgb8: false,
            rgb: true,
            opacity: true,
            depth,
            owners: false,
            semantics: false,
            tiles,
        }
    }

    /// A number below [`Planes::VARIANTS`]. Owners with classes have shaders of their own.
    pub(super) fn variant(self) -> usize {
        let bits = [self.rgb8, self.rgb, self.opacity, self.depth, self.owners];
        bits.into_iter().fold(self.tiles as usize, |number, bit| 2 * number + usize::from(bit))
    }

    /// The override constants of `shaders/resolve.wgsl` and `has_samples.wgsl`.
    pub(super) fn constants(self) -> [(&'static str, f64); 6] {
        let switch = |name, on| (name, f64::from(u8::from(on)));
        [
            switch("RGB8", self.rgb8),
            switch("RGB", self.rgb),
            switch("OPACITY", self.opacity),
            switch("DEPTH", self.depth),
            switch("SAMPLES", self.tiles != TileKinds::Pixels),
            switch("QUARTER_TILES", self.tiles == TileKinds::Samples),
        ]
    }

    /// Words of a plane of 32-bit values: a tile of samples has a quarter of the pixels. In frames
    /// with both kinds each has the larger size.
    fn plane(self) -> usize {
        if self.tiles == TileKinds::Samples { PLANE / 4 } else { PLANE }
    }

    /// Whether depth is computed.
    pub(super) fn has_depth(self) -> bool {
        self.depth
    }

    /// Whether the owner of each pixel is computed.
    pub(super) fn has_owners(self) -> bool {
        self.owners
    }

    /// Whether the owners have classes.
    pub(super) fn has_semantics(self) -> bool {
        self.semantics
    }

    /// Bytes of the pixels of one tile, at least 64 words, so that buffers are never empty. They
    /// are a multiple of 256, so that a binding may start at any tile.
    pub(super) fn tile_bytes(self) -> u64 {
        4 * self.words().max(1).next_multiple_of(TILE_WORDS) as u64
    }

    /// Words of a tile.
    fn words(self) -> usize {
        self.parts().iter().map(|(requested, words)| usize::from(*requested) * words).sum()
    }

    /// Whether rgb8, rgb, opacity, depth, and owners are requested, and the words that each
    /// takes of a tile.
    fn parts(self) -> [(bool, usize); 5] {
        [
            // Three bytes of a pixel, in words of four.
            (self.rgb8, 3 * self.plane() / 4),
            (self.rgb, 3 * self.plane()),
            (self.opacity, self.plane()),
            (self.depth, self.plane()),
            (self.owners, self.plane()),
        ]
    }

    /// First word of rgb8, rgb, opacity, depth, and owners in a tile; `None` if it is not
    /// requested.
    fn starts(self) -> [Option<usize>; 5] {
        let mut next = 0;
        self.parts().map(|(requested, words)| {
            requested.then(|| {
                next += words;
                next - words
            })
        })
    }
}

/// The tiles of one image.
struct TileGrid {
    size_px: [usize; 2],
    /// Tiles of a row.
    columns: u32,
    /// Index of the first tile among those of all views.
    first_tile: u32,
    /// Edge of a tile, in pixels of the image.
    edge: usize,
}

/// All pixels of a frame in the device's order.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pixels<'a> {
    /// Pages of `tiles_per_page` tiles each; the last one may have fewer.
    pub(super) pages: &'a [&'a [u32]],
    /// Tiles of a page.
    pub(super) tiles_per_page: u32,
    /// The planes of each tile.
    pub(super) planes: Planes,
}

impl Pixels<'_> {
    /// Copies the pixels of one view to its target. Its tiles may have samples.
    pub(super) fn copy_to(&self, view: &FrameView, is_sampled: bool, target: &mut Target<'_>) {
        let samples = if is_sampled { SAMPLES } else { 1 };
        let view = &TileGrid {
            size_px: view.size_px.map(|px| (px / samples) as usize),
            columns: view.columns,
            first_tile: view.first_tile,
            edge: (TILE_PX / samples) as usize,
        };
        let row_pixels = view.size_px[0] * view.edge;
        let plane_words = self.planes.plane();
        let [rgb8, rgb, opacity, depth, owners] = self.planes.starts();
        if let (Some(to), Some(plane)) = (&mut target.rgb8, rgb8) {
            self.for_each_row(view, to.par_chunks_mut(3 * row_pixels), |to, at, tile, from| {
                // The words have the bytes in the order of the pixels on every device: Vulkan is
                // little-endian, and so are the machines that it runs on.
                let first = 4 * plane + 3 * from.start;
                let bytes: &[u8] = bytemuck::cast_slice(tile);
                to[3 * at..][..3 * from.len()].copy_from_slice(&bytes[first..][..3 * from.len()]);
            });
        }
        if let (Some(to), Some(rgb), Some(opacity)) = (&mut target.rgba, rgb, opacity) {
            self.for_each_row(view, to.par_chunks_mut(4 * row_pixels), |to, at, tile, from| {
                let planes = [rgb, rgb + plane_words, rgb + 2 * plane_words, opacity];
                for (channel, plane) in planes.into_iter().enumerate() {
                    let to = to[4 * at..].chunks_exact_mut(4);
                    for (to, word) in to.zip(row(tile, plane, &from)) {
                        to[channel] = f32::from_bits(*word);
                    }
                }
            });
        }
        if let (Some(to), Some(plane)) = (&mut target.instances, owners) {
            self.for_each_row(view, to.par_chunks_mut(row_pixels), |to, at, tile, from| {
                for (to, word) in to[at..].iter_mut().zip(row(tile, plane, &from)) {
                    // The low half; the high half is the class, if there are classes.
                    *to = *word as u16;
                }
            });
        }
        if let (Some(to), Some(plane)) = (&mut target.semantics, owners) {
            self.for_each_row(view, to.par_chunks_mut(row_pixels), |to, at, tile, from| {
                for (to, word) in to[at..].iter_mut().zip(row(tile, plane, &from)) {
                    *to = (*word >> 16) as u8;
                }
            });
        }
        for (to, plane) in [(&mut target.opacity, opacity), (&mut target.depth_m, depth)] {
            if let (Some(to), Some(plane)) = (to, plane) {
                self.for_each_row(view, to.par_chunks_mut(row_pixels), |to, at, tile, from| {
                    for (to, word) in to[at..].iter_mut().zip(row(tile, plane, &from)) {
                        *to = f32::from_bits(*word);
                    }
                });
            }
        }
    }

    /// Calls `copy` for every row of every tile, with the band of the target that the tile's row of
    /// tiles covers, the index of the first pixel in it, the tile's words, and the row's range of a
    /// plane.
    fn for_each_row<'t, T: Send + 't>(
        &self,
        view: &TileGrid,
        bands: impl IndexedParallelIterator<Item = &'t mut [T]>,
        copy: impl Fn(&mut [T], usize, &[u32], Range<usize>) + Sync,
    ) {
        let TileGrid { size_px: [width, height], edge, .. } = *view;
        // Pixels of a row of a tile's planes.
        let stride = self.planes.plane().isqrt();
        bands.enumerate().for_each(|(tile_row, band)| {
            for column in 0..view.columns {
                let tile = view.first_tile + tile_row as u32 * view.columns + column;
                let words = self.tile(tile);
                let left = column as usize * edge;
                let columns = edge.min(width - left);
                // Tiles at the lower edge reach beyond the image.
                for y in 0..edge.min(height - tile_row * edge) {
                    copy(band, y * width + left, words, y * stride..y * stride + columns);
                }
            }
        });
    }

    /// The words of one tile.
    fn tile(&self, tile: u32) -> &[u32] {
        let page = self.pages[(tile / self.tiles_per_page) as usize];
        let words = self.planes.tile_bytes() as usize / 4;
        let first = (tile % self.tiles_per_page) as usize * words;
        &page[first..first + words]
    }
}

/// One row of a plane of a tile that starts at this word.
fn row<'a>(tile: &'a [u32], plane: usize, range: &Range<usize>) -> &'a [u32] {
    &tile[plane + range.start..plane + range.end]
}
