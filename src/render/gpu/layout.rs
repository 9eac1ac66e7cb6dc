//! Layouts of GPU buffers, and the constants that Rust and the shaders share. WGSL copy:
//! `shaders/shared/{constants,layout}.wgsl`; `tests/gpu/twins.rs` checks that both are equal.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::partition::{Region, TileRows};
use crate::layout::{
    ChunkShadow as CpuChunkShadow, ChunkView as CpuChunkView, Cutoffs, PixelFilter,
};
use crate::{MAX_VIEWS, View, constants};
use wildcity_scene::{RenderProfile, SemanticClass};

/// Threads of a workgroup. wgpu's default limits guarantee 256 on every device; Vulkan itself
/// guarantees only 128.
pub const WORKGROUP: u32 = 256;
/// Elements per workgroup of the prefix sum.
pub const SCAN_BLOCK: u32 = 2048;
/// Keys per workgroup of the radix sort. The 256 counters of a workgroup take 1 KiB of memory, next
/// to 32 KiB of keys and values, or 48 KiB with masks.
pub const SORT_BLOCK: u32 = 4096;
/// Number of values of a digit of the radix sort.
pub const DIGITS: u32 = 256;
/// Most workgroups in one dimension of a dispatch that every device supports.
pub const MAX_GROUPS: u32 = 65_535;
/// Columns of tiles of a macro tile.
pub const MACRO_COLUMNS: u32 = 8;
/// Rows of tiles of a macro tile: 8 x 4 tiles are one bit each of a 32-bit word.
pub const MACRO_ROWS: u32 = 4;
/// A splat that touches more macro tiles than this is emitted by a whole workgroup. A single thread
/// writes at most 16 macro tiles of 4 rows of tiles, 64 row masks, while the 255 other threads
/// wait; beyond that, all 256 threads share the work.
pub const LARGE_SPLAT_MACRO_TILES: u32 = 16;
/// Touches of a macro tile that one workgroup distributes to its tiles: 8 KiB of workgroup memory.
pub const EXPAND_BATCH: u32 = 1024;
/// Splats that a tile loads into workgroup memory and blends at a time.
pub const RASTER_BATCH: u32 = 128;
/// Most tiles with long lists that have a kernel of their own: 25 MiB of sums. 5 million visible
/// pairs of six full cameras have 600.
pub const LONG_TILES: u32 = 4096;
/// Words of such a tile's sums, as in `shaders/shared/tile_blocks.wgsl`.
pub const LONG_TILE_WORDS: u32 = 6 * constants::TILE_PX * constants::TILE_PX + 64;
/// Gaussians of a structure-of-arrays block of the mirror, and 32-bit words of one of its lines:
/// 128 B, which a warp reads in one transaction. A cluster's header is one line, of which three
/// words are used.
pub const SOA_BLOCK: u32 = 32;
/// Bits of [`ChunkView::view`] that are the view's index, in kernels for actors.
pub const VIEW_BITS: u32 = 4;
/// Words of a Gaussian without its colour: mean (3), scale (3), opacity (1), and quaternion (2).
pub const GEOMETRY_WORDS: u32 = 9;

/// The grid of tiles of one view, the rows of it that are drawn, and its pixel filter (48 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct FrameView {
    /// Image size, in pixels.
    pub size_px: [u32; 2],
    /// Tiles in a row, the last of which may reach beyond the image.
    pub columns: u32,
    /// Index of the first tile among those of all views.
    pub first_tile: u32,
    /// Macro tiles per row.
    pub macro_columns: u32,
    /// Index of the first macro tile among those of all views.
    pub first_macro_tile: u32,
    /// Rows of tiles that are drawn: first, and end (exclusive).
    pub rows: [u32; 2],
    /// [`PixelFilter::native_px2`] along x and y, in px².
    pub native_px2: [f32; 2],
    /// [`PixelFilter::total_px2`] along x and y, in px².
    pub total_px2: [f32; 2],
}

/// Parameters of a frame that all stages read (832 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Frame {
    /// Splats that the buffers can hold.
    pub splat_capacity: u32,
    /// (Splat, macro tile) pairs that the buffers can hold.
    pub touch_capacity: u32,
    /// Instances, which are (splat, tile) pairs, that the buffers can hold.
    pub instance_capacity: u32,
    /// Number of elements of `view` that are used.
    pub views: u32,
    /// Tiles of all views.
    pub tiles: u32,
    /// Macro tiles of all views.
    pub macro_tiles: u32,
    /// Nearest depth, in metres. This and the fields up to `stop` are those of [`Cutoffs`].
    pub near_m: f32,
    /// Farthest depth, in metres.
    pub far_m: f32,
    /// 1 if opacity is compensated for the blur, else 0.
    pub antialiased: u32,
    pub alpha_cap: f32,
    /// Base-2 logarithm of the smallest alpha.
    pub log2_alpha_cut: f32,
    /// Transmittance at which a pixel stops.
    pub stop: f32,
    /// Most batches of [`RASTER_BATCH`] splats that a tile may load.
    pub batch_limit: u32,
    /// Tiles with more splats than this have a kernel of their own.
    pub long_tile_splats: u32,
    pub long_tiles: u32,
    /// A bit for each view whose tiles are those of 2 x 2 samples a pixel.
    pub sampled: u32,
    /// The views, in order.
    pub view: [FrameView; MAX_VIEWS],
}

impl Frame {
    /// A frame of these views, drawn completely. The caller fills in the capacities.
    pub(super) fn new(views: &[View], profile: &RenderProfile) -> Self {
        let cutoffs = Cutoffs::new(profile);
        let mut frame = Self {
            views: views.len() as u32,
            near_m: cutoffs.near_m,
            far_m: cutoffs.far_m,
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
            let filter = PixelFilter::new(profile, &view.camera);
            *slot = FrameView {
                size_px,
                columns,
                first_tile: frame.tiles,
                macro_columns,
                first_macro_tile: frame.macro_tiles,
                rows: [0, rows],
                native_px2: filter.native_px2.as_vec2().to_array(),
                total_px2: filter.total_px2.as_vec2().to_array(),
            };
            // At most 16 views of 1024 x 1024 tiles, 2^24: this cannot overflow.
            frame.tiles += columns * rows;
            frame.macro_tiles += macro_columns * rows.div_ceil(MACRO_ROWS);
        }
        frame
    }

    /// Restricts the frame to a region. Returns the region's range of tiles.
    pub(super) fn restrict(&mut self, rows: &TileRows, region: &Region) -> Range<u32> {
        let views = rows.views(region);
        for (index, view) in self.view[..self.views as usize].iter_mut().enumerate() {
            let Range { start, end } = rows.for_view(index, region);
            // Empty for a view outside of the region.
            view.rows = [start, end];
        }
        let first = &self.view[views.start];
        let last = &self.view[views.end - 1];
        // Only the first and the last view of a region may lack rows, so its tiles are consecutive.
        let start = first.first_tile + first.rows[0] * first.columns;
        let end = last.first_tile + last.rows[1] * last.columns;
        start..end
    }
}

/// The background of all views (800 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Background {
    /// Cube map: width of a face, in texels.
    pub scale: f32,
    /// Cube map: position of the first texel, in texels.
    pub offset: f32,
    /// Cube map: number of texels along an edge.
    pub edge: u32,
    /// Network: outputs of a hidden layer.
    pub width: u32,
    /// Network: octaves of the frequency encoding.
    pub octaves: u32,
    /// Network: values of an encoded direction.
    pub encoded: u32,
    /// Network: 1 if the direction itself is among these values, else 0.
    pub identity: u32,
    /// Network: 1 if the second layer also reads these values (a skip connection), else 0.
    pub skip: u32,
    /// For each view, the rows of a matrix to a direction (of any length) in the sky's axes. It
    /// transforms `(x, y, 1)` in pixels or, for a lens or a rolling shutter, a direction in the
    /// camera's frame at the end of the exposure.
    pub sky_from_pixel: [[[f32; 4]; 3]; MAX_VIEWS],
}

/// Exposure and overlay of one camera (64 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct CameraAppearance {
    /// Rows of the exposure's colour matrix, each followed by its offset.
    pub exposure: [[f32; 4]; 3],
    /// Size of the overlay in pixels; 0 if there is none.
    pub overlay_px: [u32; 2],
    /// Index of the overlay's first pixel among those of all views.
    pub first_overlay: u32,
    /// 1 if there is an exposure.
    pub has_exposure: u32,
}

/// A view relative to one chunk (128 bytes): the content of [`crate::layout::ChunkView`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct ChunkView {
    /// Rows of the rigid transform from the chunk to the camera, translation last, in metres.
    pub camera_from_chunk: [[f32; 4]; 3],
    /// Terms of the depth, rounded to f32: the camera's forward axis in the chunk's frame and the
    /// chunk's origin along it. Where depth is distance: the camera's centre in the chunk's frame.
    pub depth_high: [f32; 4],
    /// The rounding errors of `depth_high`.
    pub depth_low: [f32; 4],
    /// The camera's centre relative to the chunk's origin, in world axes, in metres.
    pub camera_m: [f32; 3],
    /// Index of the view. In kernels for actors, the low [`VIEW_BITS`] bits are that index, and the
    /// others the index of the [`Lens`].
    pub view: u32,
    /// Focal lengths, in pixels.
    pub focal_px: [f32; 2],
    /// Principal point, in pixels.
    pub center_px: [f32; 2],
    /// Smallest slope at which the projection is linearised.
    pub slope_min: [f32; 2],
    pub slope_max: [f32; 2],
}

impl ChunkView {
    /// The view with index `view` relative to a chunk.
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

    /// This view with depth as distance from a centre in the chunk's frame, in metres.
    pub(super) fn with_distance_from(self, center_m: DVec3) -> Self {
        let exact = center_m.extend(0.0).to_array();
        Self { depth_high: exact.map(|high| high as f32), depth_low: exact.map(low), ..self }
    }
}

/// The changes to the colours of a chunk's Gaussians in a frame with actors (32 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct ChunkLight {
    /// Factor on red, green and blue.
    pub tint: [f32; 3],
    /// Index of the first contact shadow that falls on the chunk.
    pub first_shadow: u32,
    pub shadows: u32,
    pub pad0: u32,
    pub pad1: u32,
    pub pad2: u32,
}

/// A contact shadow relative to a chunk of the twin (64 bytes): the content of
/// [`crate::layout::ChunkShadow`].
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct ChunkShadow {
    /// Rows of the rigid transform from the chunk to the actor's axes, translation last, in metres.
    pub actor_from_chunk: [[f32; 4]; 3],
    /// Half the length and half the width of the actor's box, in metres.
    pub half_m: [f32; 2],
    pub pad: [f32; 2],
}

impl ChunkShadow {
    pub(super) fn new(shadow: &CpuChunkShadow) -> Self {
        let CpuChunkShadow { actor_from_chunk, half_m, .. } = *shadow;
        Self { actor_from_chunk, half_m, pad: [0.0; 2] }
    }
}

/// Rounding error of a number that is rounded to f32.
fn low(exact: f64) -> f32 {
    (exact - f64::from(exact as f32)) as f32
}

/// Lens, windshield, and rolling shutter of a view that is not a static pinhole (368 bytes). Read
/// by `shaders/lens.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Lens {
    /// Image of the optical axis, in pixels.
    pub center_px: [f32; 2],
    /// Lens model. 0: pinhole; 1: OpenCV; 2: a polynomial from the angle off the axis to the radius
    /// on the image; 3: a polynomial from the radius to the angle.
    pub model: u32,
    /// Windshield. 0: none; 1: polynomials from outside directions to inside ones; 2: the inverse.
    pub windshield: u32,
    /// Columns of the matrix from the lens' plane to pixels.
    pub linear: [f32; 4],
    /// Where the linear extrapolation of the model starts: a slope, an angle in radians, or a
    /// radius in pixels.
    pub end: f32,
    /// Value of the model's polynomial at `end`.
    pub end_value: f32,
    /// Derivative of the polynomial at `end`.
    pub end_slope: f32,
    /// Where `end` is a slope, its angle off the axis, in radians.
    pub end_rad: f32,
    /// Largest angle off the axis of a Gaussian's centre that is drawn, in radians.
    pub widest_rad: f32,
    /// 1 if depth is distance, 0 if it is z.
    pub by_distance: u32,
    /// 0 for a static pinhole, else 1.
    pub non_pinhole: u32,
    pub pad0: u32,
    /// OpenCV: k1 to k6, p1 and p2, s1 to s4. Otherwise the polynomial's coefficients from the
    /// first power on, for a variable that is a fraction of `end`.
    pub coefficients: [[f32; 4]; 3],
    /// Polynomials of the change of the angles by the windshield: 21 coefficients, horizontal and
    /// vertical.
    pub windshield_shift: [[f32; 2]; 22],
    /// The fraction of the exposure that remains when pixel (x, y) is exposed: the dot product of
    /// the first three values with (x, y, 1).
    pub remaining_exposure: [f32; 4],
    /// From the camera's first centre to its last, in the camera's last frame, in metres.
    pub moved_m: [f32; 3],
    pub pad1: u32,
    /// This translation in world axes.
    pub moved_world_m: [f32; 3],
    pub pad2: u32,
    /// The camera's rotation during the exposure: unit axis, and angle in radians.
    pub axis_angle: [f32; 4],
    /// The fields of [`ExpansionBound`](crate::expansion::ExpansionBound) in order, then zero; all
    /// zero for six points of every Gaussian.
    pub expansion: [f32; 4],
}

/// An instance, and in the high half a class: what `splat_owners.wgsl` writes for each splat.
pub fn packed_owner(instance: u16, class: SemanticClass) -> u32 {
    u32::from(instance) | u32::from(class.value()) << 16
}

/// The owner of the splats from a cluster view on (8 bytes). The first record of a list holds its
/// length as `instance`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Owner {
    /// Index of the cluster view.
    pub cluster_view: u32,
    /// The instance, as [`Target::instances`](crate::Target::instances) counts them.
    pub instance: u32,
}

/// One cluster in one view (8 bytes): the unit of work of stage project.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct ClusterView {
    /// First line of the cluster on its page of the mirror.
    pub line: u32,
    /// Index of its [`ChunkView`].
    pub chunk_view: u32,
}

/// A range (8 bytes): cluster views of a page for `project`, tiles of a page for `rasterize`, or
/// touches of a splat.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Span {
    /// Index of the first element.
    pub first: u32,
    pub count: u32,
}

/// Macro tiles whose gradients are summed at a time (40 bytes). Touches, instances and batches are
/// those of the frame in the order of their macro tiles.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct MacroRun {
    /// Index of the first macro tile among those of all views.
    pub first_macro_tile: u32,
    pub macro_tiles: u32,
    /// One bit for each tile of a macro tile that is summed.
    pub tiles: u32,
    /// 1 if the sums of the touches are those of another run, to be added to, else 0.
    pub continues: u32,
    /// Index of the first touch.
    pub first_touch: u32,
    pub touches: u32,
    /// Index of the first instance.
    pub first_instance: u32,
    /// Index of the first batch of [`EXPAND_BATCH`] touches.
    pub first_batch: u32,
    pub batches: u32,
    /// Index of the first tile of the page of derivatives by pixels.
    pub first_tile: u32,
}

/// Number of elements that a stage processes, and the workgroups of its indirect dispatch (16
/// bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Job {
    pub length: u32,
    /// Workgroups in x, y, z.
    pub groups: [u32; 3],
}

/// A job, padded to the alignment at which a binding may start (256 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct JobSlot {
    pub job: Job,
    pub pad: [[u32; 4]; 15],
}

/// Counters that the host reads after a frame (12 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct Counters {
    /// (Gaussian, view) pairs that survived culling, whether or not the buffers can hold them.
    pub splats: u32,
    /// (Splat, macro tile) pairs, likewise. 2^32 - 1 means 2^32 - 1 or more.
    pub touches: u32,
    /// (Splat, tile) pairs, likewise; 0 if the touches did not fit.
    pub instances: u32,
}

/// Counters of stage rasterize that the host reads after a frame (8 bytes). They have a buffer of
/// their own: the kernels that blend tiles would otherwise wait for each other.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct TileCounters {
    /// Pairs of a splat and a block of [`constants::BLOCK_PX`] that its box reaches, in all loaded
    /// batches. Blocks that have stopped count too.
    pub block_pairs: u32,
    /// Most batches of [`RASTER_BATCH`] splats that a tile loaded; [`Frame::batch_limit`] + 1 if a
    /// tile needed more.
    pub most_batches: u32,
}

impl TileCounters {
    /// Evaluations of a splat at a pixel: all pixels of the blocks that its box reaches. Pixels
    /// that have stopped count too.
    pub(super) fn evaluations(&self) -> u64 {
        u64::from(self.block_pairs) * u64::from(constants::BLOCK_PX * constants::BLOCK_PX)
    }
}

/// Shape of a splat (32 bytes): [`crate::layout::Splat`] without its colour.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct SplatShape {
    /// Centre, in pixels from the image's top-left corner.
    pub mean_px: [f32; 2],
    /// Half-size of the box in which alpha reaches alpha_cut, in pixels.
    pub extent_px: [f32; 2],
    /// Cholesky factor `(l0, l1, l2)` of the exponent, in 1/px.
    pub factor: [f32; 3],
    /// Base-2 logarithm of the peak opacity.
    pub log2_opacity: f32,
}

/// Colour and depth of a splat (16 bytes).
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct SplatColor {
    /// Linear colour in the direction of its view, at least 0.
    pub rgb: [f32; 3],
    /// Depth of the centre in metres: camera-space z, or distance for wide lenses.
    pub depth_m: f32,
}
