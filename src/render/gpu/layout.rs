//! What lies in GPU buffers. WGSL copy: `shaders/shared/{constants,layout}.wgsl`, held equal by
//! `tests/gpu/twins.rs`.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::parts::{Part, Rows};
use crate::layout::{ChunkView as CpuChunkView, Cutoffs};
use crate::{MAX_VIEWS, View, constants};

/// Threads of a workgroup: what wgpu by default asks of every device. Vulkan alone promises 128.
pub const WORKGROUP: u32 = 256;
/// Elements that one workgroup of the prefix sum adds up.
pub const SCAN_BLOCK: u32 = 2048;
/// Keys that one workgroup of the radix sort places: its 256 counters are 1 KiB beside 32 KiB
/// of keys and values, or 48 KiB with masks.
pub const SORT_BLOCK: u32 = 4096;
/// Values of a digit of the radix sort.
pub const DIGITS: u32 = 256;
/// Most groups of one dimension of a dispatch, on any device.
pub const MAX_GROUPS: u32 = 65_535;
/// Tiles side by side in a macro tile, ...
pub const MACRO_COLUMNS: u32 = 8;
/// ... and one above the other: a word has a bit for each.
pub const MACRO_ROWS: u32 = 4;
/// Splats over more macro tiles are emitted by a whole workgroup: a thread alone writes at most 16 macro
/// tiles of 4 rows of tiles each, 64 masks of a row, while 255 others wait; beyond, all 256 share.
pub const BIG_SPLAT_MACROS: u32 = 16;
/// Splats of a macro tile that are handed to its tiles at a time: 8 KiB of workgroup memory.
pub const EXPAND_BATCH: u32 = 1024;
/// Splats that a tile blends at a time.
pub const RASTER_BATCH: u32 = 128;
/// Gaussians side by side in the mirror, and words of one of its lines: 128 B, what a warp reads at
/// once. A cluster's header is a line, of which three words are used.
pub const STRIP: u32 = 32;
/// Words of a Gaussian without its colour: mean, scale, opacity, and a quaternion in two.
pub const GEOMETRY_WORDS: u32 = 9;

/// The grid of tiles of one view, and what is drawn of it (32 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct FrameView {
    /// Image size, in pixels.
    pub size_px: [u32; 2],
    /// Tiles per row.
    pub columns: u32,
    /// Index of the first tile among those of all views.
    pub first_tile: u32,
    /// Macro tiles per row.
    pub macro_columns: u32,
    /// Index of the first macro tile among those of all views.
    pub first_macro: u32,
    /// The first row of tiles that is drawn, and the one after the last.
    pub rows: [u32; 2],
}

/// What all stages know of a frame (576 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Frame {
    /// Splats that the buffers hold.
    pub splat_capacity: u32,
    /// (Splat, macro tile) pairs that the buffers hold.
    pub touch_capacity: u32,
    /// Instances that the buffers hold.
    pub instance_capacity: u32,
    /// How many of `view` are used.
    pub views: u32,
    /// Tiles of all views.
    pub tiles: u32,
    /// Macro tiles of all views.
    pub macros: u32,
    /// As in [`Cutoffs`], likewise the fields that follow.
    pub near_m: f32,
    /// In metres.
    pub far_m: f32,
    /// In px².
    pub blur_px2: f32,
    /// 1 or 0.
    pub antialiased: u32,
    /// Largest alpha.
    pub alpha_cap: f32,
    /// Base-2 logarithm of the smallest alpha.
    pub log2_alpha_cut: f32,
    /// Transmittance that ends a pixel.
    pub stop: f32,
    /// Zero.
    pub pad0: u32,
    /// Zero.
    pub pad1: u32,
    /// Zero.
    pub pad2: u32,
    /// The views, in order.
    pub view: [FrameView; MAX_VIEWS],
}

impl Frame {
    /// A frame of these views; the capacities are the caller's to fill in.
    pub(super) fn new(views: &[View], cutoffs: &Cutoffs) -> Self {
        let mut frame = Self {
            views: views.len() as u32,
            near_m: cutoffs.near_m,
            far_m: cutoffs.far_m,
            blur_px2: cutoffs.blur_px2,
            antialiased: cutoffs.antialiased.into(),
            alpha_cap: cutoffs.alpha_cap,
            log2_alpha_cut: cutoffs.log2_alpha_cut,
            stop: cutoffs.stop,
            ..Self::zeroed()
        };
        for (slot, view) in frame.view.iter_mut().zip(views) {
            let size_px = [view.camera.width_px, view.camera.height_px];
            let [columns, rows] = size_px.map(|size| size.div_ceil(constants::TILE_PX));
            let macro_columns = columns.div_ceil(MACRO_COLUMNS);
            *slot = FrameView {
                size_px,
                columns,
                first_tile: frame.tiles,
                macro_columns,
                first_macro: frame.macros,
                rows: [0, rows],
            };
            // At most 16 views of 1024 x 1024 tiles: 2^24.
            frame.tiles += columns * rows;
            frame.macros += macro_columns * rows.div_ceil(MACRO_ROWS);
        }
        frame
    }

    /// Draws these rows alone. Returns the tiles that they are.
    pub(super) fn restrict(&mut self, rows: &Rows, part: &Part) -> Range<u32> {
        let views = rows.views(part);
        for (index, view) in self.view[..self.views as usize].iter_mut().enumerate() {
            let Range { start, end } = rows.of_view(index, part);
            view.rows = [start, end];
        }
        let (first, last) = (&self.view[views.start], &self.view[views.end - 1]);
        let start = first.first_tile + first.rows[0] * first.columns;
        start..last.first_tile + last.rows[1] * last.columns
    }
}

/// What is behind the Gaussians of all views (800 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Behind {
    /// A face's width in values, ...
    pub scale: f32,
    /// ... where its first one lies, ...
    pub offset: f32,
    /// ... and values along an edge; of a map.
    pub edge: u32,
    /// Outputs of a hidden layer, ...
    pub width: u32,
    /// ... octaves of sines and cosines, ...
    pub octaves: u32,
    /// ... values of a direction and its octaves, ...
    pub encoded: u32,
    /// ... and whether the direction itself is one, 1 or 0, ...
    pub identity: u32,
    /// ... and the second layer reads them again; of a network.
    pub skip: u32,
    /// By view, rows that take `(x, y, 1)` in pixels to a direction of any length; of a lens or a rolling
    /// shutter, directions in the camera's frame at the exposure's end.
    pub sky_from_pixel: [[[f32; 4]; 3]; MAX_VIEWS],
}

/// What one camera makes of colours (64 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Seen {
    /// Rows of the exposure's matrix, each with its offset.
    pub exposure: [[f32; 4]; 3],
    /// Size of the overlay; 0 if there is none.
    pub overlay_px: [u32; 2],
    /// Its first pixel among those of all views.
    pub first_overlay: u32,
    /// 1 if there is an exposure.
    pub exposed: u32,
}

/// A view relative to one chunk (128 bytes): what `render::layout::ChunkView` holds.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct ChunkView {
    /// Rows of the rigid transform, translation last, in metres.
    pub camera_from_chunk: [[f32; 4]; 3],
    /// What depth is computed from, rounded to f32: the camera's forward axis in the chunk and the chunk's
    /// origin along it, or, where depth is distance, the camera's centre in the chunk, ...
    pub depth_high: [f32; 4],
    /// ... and what the rounding left over.
    pub depth_low: [f32; 4],
    /// The camera's centre relative to the chunk's origin, in world axes, in metres.
    pub camera_m: [f32; 3],
    /// Index of the view.
    pub view: u32,
    /// Focal lengths, in pixels.
    pub focal_px: [f32; 2],
    /// Principal point, in pixels.
    pub center_px: [f32; 2],
    /// Smallest slope at which the projection is linearised.
    pub slope_min: [f32; 2],
    /// Largest slope.
    pub slope_max: [f32; 2],
}

impl ChunkView {
    /// The same numbers in rows of four.
    pub(super) fn new(view: u32, from: &CpuChunkView) -> Self {
        let row = |i: usize| {
            let [x, y, z] = from.rotation[i];
            [x, y, z, from.translation_m[i]]
        };
        Self {
            camera_from_chunk: [row(0), row(1), row(2)],
            depth_high: from.forward.map(|high| high as f32),
            depth_low: from.forward.map(low),
            camera_m: from.camera_m,
            view,
            focal_px: from.focal_px,
            center_px: from.center_px,
            slope_min: from.slope_min,
            slope_max: from.slope_max,
        }
    }

    /// The same, with depth as the distance from a centre in the chunk, in metres.
    pub(super) fn by_distance(self, center_m: DVec3) -> Self {
        let exact = center_m.extend(0.0).to_array();
        Self { depth_high: exact.map(|high| high as f32), depth_low: exact.map(low), ..self }
    }
}

/// What is left of a number that is rounded to f32.
fn low(exact: f64) -> f32 {
    (exact - f64::from(exact as f32)) as f32
}

/// What a view has that a pinhole at rest has not (352 bytes). WGSL: `shaders/lens.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Lens {
    /// Where the axis lands, in pixels.
    pub center_px: [f32; 2],
    /// 0 a pinhole, 1 OpenCV's model, 2 a distance from the axis by the angle off it, 3 the other way.
    pub model: u32,
    /// Which way the windshield's polynomials go: 0 none, 1 inwards, 2 outwards.
    pub windshield: u32,
    /// Columns that take the lens' plane to pixels.
    pub linear: [f32; 4],
    /// Where the model begins to go on straight: a slope, an angle or a distance, ...
    pub end: f32,
    /// ... what its polynomial is there, ...
    pub end_value: f32,
    /// ... and its slope; and ...
    pub end_slope: f32,
    /// ... of a slope, its angle off the axis, in radians.
    pub end_rad: f32,
    /// How far off the axis a centre may be, in radians.
    pub widest_rad: f32,
    /// 1 if depth is distance, 0 if it is z.
    pub by_distance: u32,
    /// 0 for a pinhole at rest, 1 for all else.
    pub bent: u32,
    /// Zero.
    pub pad0: u32,
    /// k1 to k6, p1 and p2, s1 to s4; or a polynomial from its first power on, in shares of the end.
    pub c: [[f32; 4]; 3],
    /// By how much the windshield changes the angles: 21 coefficients, horizontal and vertical.
    pub bend: [[f32; 2]; 22],
    /// The share of the exposure that is still to come, as a sum of this times x, y and 1.
    pub rolls: [f32; 4],
    /// From the camera's first centre to its last, in the frame of the last, in metres.
    pub moved_m: [f32; 3],
    /// Zero.
    pub pad1: u32,
    /// The same along the world's axes.
    pub moved_world_m: [f32; 3],
    /// Zero.
    pub pad2: u32,
    /// The axis about which the camera turns meanwhile, and the angle in radians.
    pub turned: [f32; 4],
}

/// One cluster in one view (8 bytes): the unit of projection.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Item {
    /// First line of the cluster on its page of the mirror.
    pub line: u32,
    /// Which [`ChunkView`].
    pub chunk_view: u32,
}

/// A range (8 bytes): items of a page for `project`, tiles of a page for `rasterize`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Span {
    /// The first one.
    pub first: u32,
    /// How many.
    pub count: u32,
}

/// How many elements a stage treats, and the groups of its indirect dispatch (16 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Job {
    /// Elements.
    pub length: u32,
    /// Groups in x, y, z.
    pub groups: [u32; 3],
}

/// A job where a binding may start (256 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct JobSlot {
    /// The job.
    pub job: Job,
    /// Zero.
    pub pad: [[u32; 4]; 15],
}

/// What the host reads after a frame (24 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Counters {
    /// (Gaussian, view) pairs that survived culling, whether or not they fit.
    pub splats: u32,
    /// (Splat, macro tile) pairs, whether or not they fit; 2^32 - 1 stands for more.
    pub touches: u32,
    /// (Splat, tile) pairs, likewise; 0 if the touches did not fit.
    pub instances: u32,
    /// Batches of [`RASTER_BATCH`] splats that tiles blended.
    pub batches: u32,
    /// Those of the tile that blended the most.
    pub most_batches: u32,
    /// Splats that touch the macro tile that most do.
    pub most_touches: u32,
}

/// Where a Gaussian lies on the screen (32 bytes): `render::layout::Splat` without its colour.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct SplatShape {
    /// Centre, in pixels from the image's top-left corner.
    pub mean_px: [f32; 2],
    /// Half-size of the box that alpha_cut reaches, in pixels.
    pub extent_px: [f32; 2],
    /// Factor `(l0, l1, l2)`, in 1/px.
    pub factor: [f32; 3],
    /// Base-2 logarithm of the peak opacity.
    pub log2_opacity: f32,
}

/// What a splat adds where it is seen (16 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct SplatColor {
    /// Linear colour towards its view, at least 0.
    pub rgb: [f32; 3],
    /// Camera-space z of the centre, in metres.
    pub depth_m: f32,
}
