//! Chunks: Gaussians that share an origin, activated and laid out for the renderer.
//!
//! A chunk of a twin is one *section*: one level of detail of one block of 16 m x 16 m within a
//! cell of 64 m x 64 m ([`crate::lod`]). It is read, decoded and drawn as a unit, so the renderer
//! does not deal with levels of detail. A chunk of a scene file is a whole cell. A sparse cell,
//! such as one of a skyline, is a single block: as 3,000 blocks of three Gaussians each, the demo
//! street's skyline took 9 ms of every frame.
//!
//! A chunk stores Gaussians in *lane groups* of 16: one column of 16 floats per parameter. A vector
//! instruction processes 16 Gaussians at once, and Gaussians that are culled by their position cost
//! only three columns of reads. 256 Gaussians in Morton order form a *cluster* with a bounding box,
//! which is culled as a unit.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3, Vec3};
use rayon::prelude::*;

use super::actor::PlacedChunk;
use super::geometry::Pose;
use super::pages::{LanePages, Page};
use super::validate::{LN_SCALE, MAX_SH};
use super::{Gaussians, Selection, SemanticClass, Sky, ViewSet, sh};

pub use super::pages::{CLUSTER, LANES, Lanes};

/// Edge of a cell, in metres.
pub const CELL_M: f64 = 64.0;
/// Edge of a block, in metres. A block is drawn at one level of detail at a time.
pub const BLOCK_M: f64 = 16.0;
/// Number of blocks along the edge of a cell.
pub const BLOCKS: usize = (CELL_M / BLOCK_M) as usize;
/// A cell with fewer Gaussians than this is a single block. Split into 16 blocks it would not even
/// fill one cluster per block, and every chunk costs each frame some work. Cells of a skyline or a
/// sky have only a few Gaussians each.
pub const SPARSE_CELL: usize = BLOCKS * BLOCKS * CLUSTER;

/// Indices of the columns of a lane group. The SH coefficients come last: coefficient-major, then
/// red, green, blue.
pub mod column {
    /// Mean relative to the chunk's origin, in metres: three columns x, y, z.
    pub const MEAN: usize = 0;
    /// Standard deviation along each principal axis, in metres: three columns.
    pub const SCALE: usize = 3;
    /// Unit quaternion (w, x, y, z) that takes principal axes to world axes: four columns.
    pub const QUAT: usize = 6;
    /// Base-2 logarithm of the peak opacity; minus infinity in empty lanes. Only merged Gaussians
    /// have a positive one, where several overlapped. The renderer adds this value to its exponent.
    pub const LOG2_OPACITY: usize = 10;
    /// First SH coefficient of the colour.
    pub const SH: usize = 11;
}

/// Number of columns at an SH degree: 11, and 3 per SH coefficient. 23 columns, 92 B per Gaussian,
/// at degree 1.
pub const fn columns(sh_degree: u8) -> usize {
    column::SH + 3 * sh::coefficients(sh_degree)
}

/// One Gaussian as a trainer wrote it, before activation, relative to its chunk's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawGaussian<'a> {
    /// Mean relative to the chunk's origin, in metres.
    pub mean_m: [f32; 3],
    /// Rotation (w, x, y, z), of any length except zero.
    pub quat_wxyz: [f32; 4],
    /// Natural logarithm of the standard deviations, of metres.
    pub ln_scale: [f32; 3],
    /// Opacity before the sigmoid.
    pub logit_opacity: f32,
    /// `[(sh_degree + 1)², 3]`.
    pub sh: &'a [f32],
}

/// One Gaussian as the renderer reads it, relative to its chunk's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActivatedGaussian<'a> {
    /// Mean relative to the chunk's origin, in metres.
    pub mean_m: [f32; 3],
    /// Standard deviation along each principal axis, in metres.
    pub scale_m: [f32; 3],
    /// Unit quaternion (w, x, y, z).
    pub quat_wxyz: [f32; 4],
    /// Base-2 logarithm of the peak opacity.
    pub log2_opacity: f32,
    /// `[(sh_degree + 1)², 3]`.
    pub sh: &'a [f32],
}

/// Bounds of the Gaussians of a cluster.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cluster {
    /// Smallest mean per axis, relative to the chunk's origin, in metres.
    pub min_m: Vec3,
    /// Largest mean per axis, relative to the chunk's origin, in metres.
    pub max_m: Vec3,
    /// Largest standard deviation along any axis, in metres.
    pub sigma_m: f32,
}

impl Cluster {
    /// Contains nothing; always culled.
    const EMPTY: Self = Self { min_m: Vec3::INFINITY, max_m: Vec3::NEG_INFINITY, sigma_m: 0.0 };

    fn add(&mut self, mean_m: [f32; 3], scale_m: [f32; 3]) {
        let mean_m = Vec3::from_array(mean_m);
        self.min_m = self.min_m.min(mean_m);
        self.max_m = self.max_m.max(mean_m);
        // The largest of three axes, whatever the rotation: a sphere of that sigma contains the
        // ellipsoid, and no rotation needs to be evaluated.
        self.sigma_m = self.sigma_m.max(Vec3::from_array(scale_m).max_element());
    }
}

/// The Gaussians of one section of a twin, or of one cell of a scene file, ready to be rendered.
///
/// ```
/// use glam::DVec3;
/// use wildcity_scene::Chunk;
/// use wildcity_scene::chunk::{RawGaussian, column};
///
/// let mut chunk = Chunk::new([0, 0], DVec3::ZERO, 0, 1);
/// chunk.push(&RawGaussian {
///     mean_m: [1.0, 2.0, 0.5],
///     quat_wxyz: [1.0, 0.0, 0.0, 0.0],
///     ln_scale: [0.0; 3],
///     logit_opacity: 0.0,
///     sh: &[0.5; 3],
/// });
/// assert_eq!(chunk.len(), 1);
/// assert_eq!(chunk.value(0, column::SCALE), 1.0);
/// assert_eq!(chunk.value(0, column::LOG2_OPACITY), -1.0); // sigmoid(0) is one half
/// ```
#[derive(Clone, Debug)]
pub struct Chunk {
    cell: [i32; 2],
    origin_m: DVec3,
    sh_degree: u8,
    count: usize,
    lanes: LanePages,
    clusters: Vec<Cluster>,
    /// One per Gaussian, if the section has classes.
    classes: Option<Box<[SemanticClass]>>,
}

impl Chunk {
    /// An empty chunk with capacity for `capacity` Gaussians, to be filled with [`Chunk::push`].
    /// `origin_m` is in world axes.
    pub fn new(cell: [i32; 2], origin_m: DVec3, sh_degree: u8, capacity: usize) -> Self {
        let mut lanes = LanePages::new(columns(sh_degree), None);
        lanes.expect(capacity.div_ceil(LANES));
        let clusters = Vec::with_capacity(capacity.div_ceil(CLUSTER));
        Self { cell, origin_m, sh_degree, count: 0, lanes, clusters, classes: None }
    }

    /// A chunk from columns that are already laid out.
    ///
    /// Lanes after `count` are emptied, and so are Gaussians that cannot be drawn, as by
    /// [`Chunk::push_activated`].
    ///
    /// # Panics
    /// If `lanes` does not have exactly the lane groups that `count` Gaussians of this degree need.
    pub fn from_lanes(
        cell: [i32; 2],
        origin_m: DVec3,
        sh_degree: u8,
        count: usize,
        mut lanes: LanePages,
    ) -> Self {
        let width = columns(sh_degree);
        assert_eq!(lanes.width(), width, "lanes of another degree");
        assert_eq!(lanes.len(), count.div_ceil(LANES), "lanes of another count");
        let mut clusters = Vec::with_capacity(count.div_ceil(CLUSTER));
        for (index, lanes) in lanes.clusters_mut().iter_mut().enumerate() {
            clusters.push(bounded(lanes, width, count - CLUSTER * index));
        }
        Self { cell, origin_m, sh_degree, count, lanes, clusters, classes: None }
    }

    /// The chunk with a class for each of its Gaussians, or without classes.
    ///
    /// # Panics
    /// If there is not one class for each Gaussian.
    pub fn with_classes(mut self, classes: Option<Vec<SemanticClass>>) -> Self {
        let is_whole = classes.as_ref().is_none_or(|classes| classes.len() == self.count);
        assert!(is_whole, "classes of another number of Gaussians");
        self.classes = classes.map(Vec::into_boxed_slice);
        self
    }

    /// Writes Gaussians anew in place, as a trainer does after each step: cluster by cluster, in
    /// parallel. `write` gets the lane groups of a cluster and its own of `states`, and returns
    /// whether it has changed any; the bounds of a cluster follow. Gaussians that cannot be drawn
    /// are emptied, as by [`Chunk::push_activated`].
    ///
    /// # Panics
    /// If there is not one state for each cluster.
    pub fn rewrite<T: Send>(
        &mut self,
        states: Vec<T>,
        write: impl Fn(T, &mut [Lanes]) -> bool + Sync,
    ) {
        assert_eq!(states.len(), self.clusters.len(), "states of another number of clusters");
        let width = columns(self.sh_degree);
        let count = self.count;
        let pages = self.lanes.clusters_mut().par_iter_mut();
        let clusters = pages.zip(&mut self.clusters).zip(states).enumerate();
        clusters.for_each(|(index, ((lanes, cluster), state))| {
            if write(state, lanes) {
                *cluster = bounded(lanes, width, count - CLUSTER * index);
            }
        });
    }

    /// Activates one Gaussian and appends it.
    ///
    /// Import accepts only finite values. A Gaussian that is invalid nevertheless becomes an empty
    /// lane: it keeps its index and is never drawn, and its neighbours are not affected.
    ///
    /// # Panics
    /// If the number of SH coefficients is not that of the chunk's degree.
    pub fn push(&mut self, record: &RawGaussian<'_>) {
        // In f64: squares of an f32 near its limits overflow or vanish in f32.
        let length = record.quat_wxyz.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>().sqrt();
        self.push_activated(&ActivatedGaussian {
            mean_m: record.mean_m,
            scale_m: record.ln_scale.map(|ln| f64::from(ln).exp() as f32),
            quat_wxyz: record.quat_wxyz.map(|q| (f64::from(q) / length) as f32),
            log2_opacity: log2_sigmoid(record.logit_opacity),
            sh: record.sh,
        });
    }

    /// Appends one activated Gaussian. One with a value that is not finite, or with an SH
    /// coefficient far out of range, becomes an empty lane.
    ///
    /// # Panics
    /// If the number of SH coefficients is not that of the chunk's degree.
    pub fn push_activated(&mut self, record: &ActivatedGaussian<'_>) {
        let width = columns(self.sh_degree);
        assert_eq!(record.sh.len(), width - column::SH, "colour of another degree");
        let group = self.count / LANES;
        let lane = self.count % LANES;
        if lane == 0 {
            self.lanes.push_zeros();
            self.lanes.group_mut(group)[column::LOG2_OPACITY] = Lanes([f32::NEG_INFINITY; LANES]);
        }
        if self.count.is_multiple_of(CLUSTER) {
            self.clusters.push(Cluster::EMPTY);
        }
        // Counted before the check: an invalid Gaussian keeps its index.
        self.count += 1;

        // The order of this chain is that of the columns, from which `is_drawable` takes the
        // bounds.
        let ActivatedGaussian { mean_m, scale_m, quat_wxyz, log2_opacity, sh } = record;
        let geometry = mean_m.iter().chain(scale_m).chain(quat_wxyz);
        if !is_drawable(geometry.chain([log2_opacity]).chain(*sh).copied()) {
            return;
        }
        let group = self.lanes.group_mut(group);
        let mut set = |first: usize, values: &[f32]| {
            for (column, &value) in group[first..].iter_mut().zip(values) {
                column.0[lane] = value;
            }
        };
        set(column::MEAN, mean_m);
        set(column::SCALE, scale_m);
        set(column::QUAT, quat_wxyz);
        set(column::LOG2_OPACITY, &[*log2_opacity]);
        set(column::SH, sh);
        if let Some(cluster) = self.clusters.last_mut() {
            cluster.add(*mean_m, *scale_m);
        }
    }

    /// Grid cell (x, y).
    pub fn cell(&self) -> [i32; 2] {
        self.cell
    }

    /// The chunk's origin in the world, in metres. Means are relative to it.
    pub fn origin_m(&self) -> DVec3 {
        self.origin_m
    }

    /// Spherical-harmonic degree of the colours.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Number of Gaussians, without the empty lanes of the last group.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The class of each Gaussian; `None` without classes.
    pub fn classes(&self) -> Option<&[SemanticClass]> {
        self.classes.as_deref()
    }

    /// The clusters, in order; cluster `k` holds Gaussians `256 k` to `256 k + 255`.
    pub fn clusters(&self) -> &[Cluster] {
        &self.clusters
    }

    /// The columns of lane group `group`, which holds Gaussians `16 group` to `16 group + 15`.
    #[inline]
    pub fn lane_group(&self, group: usize) -> &[Lanes] {
        self.lanes.group(group)
    }

    /// Half-size of the axis-aligned box around the 3-sigma ellipsoid of one Gaussian, in metres
    /// along world axes.
    ///
    /// Per axis it is `3 sqrt(cov_ii)` with `cov = R S Sᵀ Rᵀ`, so `cov_ii` is the squared length of
    /// row i of `R S`.
    pub fn half_extent_m(&self, index: usize) -> DVec3 {
        let value = |column| f64::from(self.value(index, column));
        let [w, x, y, z] = [0, 1, 2, 3].map(|i| value(column::QUAT + i));
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let scale_m = DVec3::from_array([0, 1, 2].map(|axis| value(column::SCALE + axis)));
        let rows = (rotation * DMat3::from_diagonal(scale_m)).transpose();
        3.0 * DVec3::new(rows.x_axis.length(), rows.y_axis.length(), rows.z_axis.length())
    }

    /// One parameter of one Gaussian; `column` is an index as in [`mod@column`].
    pub fn value(&self, index: usize, column: usize) -> f32 {
        self.lane_group(index / LANES)[column].0[index % LANES]
    }

    /// The Gaussians before activation, in the order of the chunk and in its origin's axes.
    /// Opacities of 1, which no logit has, become 1 - 1e-13; empty lanes become invisible
    /// Gaussians. All are within the bounds of [`validate`](super::validate), which rounding in a
    /// record could exceed.
    pub fn to_gaussians(&self) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(self.sh_degree, self.count);
        for index in 0..self.count {
            let value = |column| self.value(index, column);
            let three = |column| [0, 1, 2].map(|axis| value(column + axis));
            let mean_m = DVec3::from_array(three(column::MEAN).map(f64::from)) + self.origin_m;
            // Rounding in a record can push a mean at the very edge beyond the bound of import.
            let most_m = Pose::MAX_COORDINATE_M;
            gaussians.means_m.push(mean_m.to_array().map(|m| m.clamp(-most_m, most_m)));
            let quat = [0, 1, 2, 3].map(|k| value(column::QUAT + k));
            // A zero quaternion marks an empty lane: a Gaussian that is drawn has a unit one.
            let is_empty = quat == [0.0; 4];
            gaussians.quats_wxyz.push(if is_empty { [1.0, 0.0, 0.0, 0.0] } else { quat });
            // A file may have scales of 0, and records round small ones to 0: they are the smallest
            // that is allowed.
            let ln =
                |scale_m: f32| (f64::from(scale_m).ln() as f32).clamp(LN_SCALE[0], LN_SCALE[1]);
            gaussians.ln_scales.push(three(column::SCALE).map(ln));
            gaussians.logit_opacities.push(logit_from_log2(value(column::LOG2_OPACITY)));
            let count = columns(self.sh_degree) - column::SH;
            let coefficients = (0..count).map(|k| value(column::SH + k));
            gaussians.sh.extend(coefficients.map(|c| c.clamp(-MAX_SH, MAX_SH)));
        }
        gaussians.classes = self.classes().map(<[_]>::to_vec);
        gaussians
    }

    /// Memory that a chunk of `count` Gaussians of an SH degree needs, in bytes, without classes:
    /// these take a byte each in addition.
    pub fn needed_bytes(sh_degree: u8, count: u64) -> u64 {
        let lanes = count.div_ceil(LANES as u64) * columns(sh_degree) as u64;
        let clusters = count.div_ceil(CLUSTER as u64);
        let of_cluster = size_of::<Cluster>() + size_of::<Page>();
        lanes.saturating_mul(size_of::<Lanes>() as u64) + clusters * of_cluster as u64
    }

    /// Memory that this chunk has allocated, in bytes.
    pub fn bytes(&self) -> usize {
        let classes = self.classes.as_ref().map_or(0, |classes| size_of_val(&**classes));
        self.lanes.bytes() + self.clusters.capacity() * size_of::<Cluster>() + classes
    }
}

/// The bounds of the first `count` Gaussians of a cluster, of which those that cannot be drawn are
/// emptied, as are the lanes after them.
fn bounded(lanes: &mut [Lanes], width: usize, count: usize) -> Cluster {
    let mut bounds = LaneBounds::EMPTY;
    for (group, lanes) in lanes.chunks_exact_mut(width).enumerate() {
        let mut drawable = drawable_lanes(lanes);
        let filled = count.saturating_sub(group * LANES);
        drawable.iter_mut().skip(filled).for_each(|drawable| *drawable = false);
        bounds.add(lanes, &drawable);
        for lane in (0..LANES).filter(|&lane| !drawable[lane]) {
            lanes.iter_mut().for_each(|lanes| lanes.0[lane] = 0.0);
            // Zeros are finite, so that vector code may compute with this lane; an opacity of minus
            // infinity makes its contribution exactly 0.
            lanes[column::LOG2_OPACITY].0[lane] = f32::NEG_INFINITY;
        }
    }
    bounds.cluster()
}

/// Bounds of every sixteenth Gaussian of a cluster: lane by lane, so that the compiler makes vector
/// instructions of it.
struct LaneBounds {
    min_m: [[f32; LANES]; 3],
    max_m: [[f32; LANES]; 3],
    sigma_m: [f32; LANES],
}

impl LaneBounds {
    const EMPTY: Self = Self {
        min_m: [[f32::INFINITY; LANES]; 3],
        max_m: [[f32::NEG_INFINITY; LANES]; 3],
        sigma_m: [0.0; LANES],
    };

    /// Adds the drawable Gaussians of a lane group.
    fn add(&mut self, group: &[Lanes], drawable: &[bool; LANES]) {
        // Comparisons in the form of a select, without branches and without `f32::min`, whose rules
        // for NaN cost instructions.
        for axis in 0..3 {
            let mean_m = &group[column::MEAN + axis].0;
            let scale_m = &group[column::SCALE + axis].0;
            for lane in 0..LANES {
                let low_m = if drawable[lane] { mean_m[lane] } else { f32::INFINITY };
                let high_m = if drawable[lane] { mean_m[lane] } else { f32::NEG_INFINITY };
                let size_m = if drawable[lane] { scale_m[lane] } else { 0.0 };
                let min_m = &mut self.min_m[axis][lane];
                let max_m = &mut self.max_m[axis][lane];
                *min_m = if low_m < *min_m { low_m } else { *min_m };
                *max_m = if high_m > *max_m { high_m } else { *max_m };
                let sigma_m = &mut self.sigma_m[lane];
                *sigma_m = if size_m > *sigma_m { size_m } else { *sigma_m };
            }
        }
    }

    fn cluster(&self) -> Cluster {
        let mut cluster = Cluster::EMPTY;
        for lane in 0..LANES {
            let corner_m =
                |of: &[[f32; LANES]; 3]| Vec3::new(of[0][lane], of[1][lane], of[2][lane]);
            cluster.min_m = cluster.min_m.min(corner_m(&self.min_m));
            cluster.max_m = cluster.max_m.max(corner_m(&self.max_m));
            cluster.sigma_m = cluster.sigma_m.max(self.sigma_m[lane]);
        }
        cluster
    }
}

/// [`is_drawable`] of each Gaussian of a lane group.
fn drawable_lanes(group: &[Lanes]) -> [bool; LANES] {
    let mut drawable = [true; LANES];
    for (column, Lanes(values)) in group.iter().enumerate() {
        let accepted = accepted(column);
        for (drawable, value) in drawable.iter_mut().zip(values) {
            *drawable &= accepted.contains(value);
        }
    }
    drawable
}

/// Whether the renderer can draw a Gaussian with these columns, given in order.
fn is_drawable(columns: impl Iterator<Item = f32>) -> bool {
    columns.enumerate().all(|(column, value)| accepted(column).contains(&value))
}

/// The values of a column that the renderer can draw. A NaN is in no range.
fn accepted(column: usize) -> RangeInclusive<f32> {
    match column {
        // Minus infinity is opacity 0: valid, never drawn.
        column::LOG2_OPACITY => f32::NEG_INFINITY..=f32::MAX,
        // Twice the bound of import, since a record format may round beyond that bound. The gpu
        // backend shares one colour scale among 256 Gaussians: a larger value would coarsen its
        // neighbours.
        column::SH.. => -2.0 * sh::MAX_COEFFICIENT..=2.0 * sh::MAX_COEFFICIENT,
        _ => f32::MIN..=f32::MAX,
    }
}

/// `log2(1 / (1 + exp(-x)))` without overflow or cancellation, for every x that is not NaN.
fn log2_sigmoid(logit: f32) -> f32 {
    let x = f64::from(logit);
    // ln sigmoid(x) = min(x, 0) - ln(1 + e^-|x|): the exponent is never positive, so that nothing
    // overflows, and ln_1p keeps the digits of a tiny e^-|x|.
    ((x.min(0.0) - (-x.abs()).exp().ln_1p()) * std::f64::consts::LOG2_E) as f32
}

/// The inverse of [`log2_sigmoid`], within -100 to 30: `-ln(1/opacity - 1)`.
fn logit_from_log2(log2_opacity: f32) -> f32 {
    // 1/opacity - 1 = 2^-log2 - 1 by exp_m1, which does not cancel for opacities near 1. Merged
    // Gaussians have opacities above 1: there it is negative, becomes 0, and the logit is clamped
    // to 30.
    let inverse_less_one = (-f64::from(log2_opacity) * std::f64::consts::LN_2).exp_m1();
    (-inverse_less_one.max(0.0).ln()).clamp(-100.0, 30.0) as f32
}

/// The Gaussians of a file, sorted by cell, then by 16 m block, then by Morton code.
#[derive(Clone, Debug, PartialEq)]
pub struct Partition {
    /// Cells in order of (y, x).
    pub cells: Vec<CellRun>,
    /// Indices of the Gaussians, cell after cell.
    pub order: Vec<u32>,
}

/// One cell of a [`Partition`].
#[derive(Clone, Debug, PartialEq)]
pub struct CellRun {
    /// Grid cell (x, y); its square is centred on (64 x, 64 y) m.
    pub cell: [i32; 2],
    /// The chunk's origin in the world, in metres: the cell's centre, at a height that is a
    /// multiple of 64 m. Subtracting it from an f32 mean near the world's origin is exact.
    pub origin_m: DVec3,
    /// The cell's range of [`Partition::order`].
    pub run: Range<usize>,
    /// The number of every block that is not empty, and its range of [`Partition::order`]. A sparse
    /// cell (below [`SPARSE_CELL`]) is one block, with the number of its first block that is not
    /// empty.
    pub blocks: Vec<(u8, Range<usize>)>,
}

impl Partition {
    /// Sorts means, in world metres, into cells and blocks. Ties keep the order of the file.
    pub fn new(means_m: &[[f64; 3]]) -> Self {
        let mut keys: Vec<([i32; 2], u8, u64, u32)> = means_m
            .par_iter()
            .enumerate()
            .map(|(index, mean)| {
                // (y, x), so that the sort gives the order of cells that `Partition::cells`
                // promises.
                let cell = [cell_index(mean[1]), cell_index(mean[0])];
                (cell, block_index(mean, cell), morton(mean), index as u32)
            })
            .collect();
        // Unstable is enough: the index is the last part of the key, so that no two keys are equal
        // and the order is deterministic.
        keys.par_sort_unstable();
        let mut cells = Vec::new();
        let mut start = 0;
        for run in keys.chunk_by(|a, b| a.0 == b.0) {
            let [y, x] = run[0].0;
            let heights = run.iter().map(|&(.., index)| means_m[index as usize][2]);
            let (low, high) =
                heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), z| (l.min(z), h.max(z)));
            // The origin's height is the multiple of 64 m nearest to the middle of the cell's
            // heights. A multiple of a power of two subtracts without rounding.
            let level = (0.5 * (low + high) / CELL_M).round();
            let origin_m = CELL_M * DVec3::new(f64::from(x), f64::from(y), level);
            let mut blocks = Vec::new();
            let mut end = start;
            // One predicate for both cases: in a sparse cell it is always true, so that the whole
            // run is one block.
            for block in run.chunk_by(|a, b| run.len() < SPARSE_CELL || a.1 == b.1) {
                blocks.push((block[0].1, end..end + block.len()));
                end += block.len();
            }
            cells.push(CellRun { cell: [x, y], origin_m, run: start..end, blocks });
            start = end;
        }
        Self { cells, order: keys.into_iter().map(|(.., index)| index).collect() }
    }
}

impl CellRun {
    /// One Gaussian of the file, relative to this cell's origin.
    pub fn record<'a>(&self, gaussians: &'a Gaussians, index: usize) -> RawGaussian<'a> {
        let mean = DVec3::from_array(gaussians.means_m[index]) - self.origin_m;
        RawGaussian {
            // Subtracted in f64, then rounded: relative to the origin the f32 has an error of
            // micrometres, which absolute coordinates of 4.5e6 m would not.
            mean_m: mean.as_vec3().to_array(),
            quat_wxyz: gaussians.quats_wxyz[index],
            ln_scale: gaussians.ln_scales[index],
            logit_opacity: gaussians.logit_opacities[index],
            sh: gaussians.sh_at(index),
        }
    }
}

/// The grid cell (x, y) of a mean in world metres.
pub fn cell_at(mean_m: &[f64; 3]) -> [i32; 2] {
    [cell_index(mean_m[0]), cell_index(mean_m[1])]
}

/// The cell index along one axis. Import accepts coordinates up to 1e8 m, so the index fits an i32.
fn cell_index(coordinate_m: f64) -> i32 {
    // 1e8 / 64 is 1.6e6, far below 2^31.
    (coordinate_m / CELL_M).round() as i32
}

/// The number of a mean's block within its cell (y, x): 4 y + x, counted from the south-west
/// corner.
fn block_index(mean_m: &[f64; 3], [y, x]: [i32; 2]) -> u8 {
    let step = |m: f64, cell: i32| {
        let from_edge_m = m - CELL_M * (f64::from(cell) - 0.5);
        // A mean at the cell's edge may round to either side of it; the clamp keeps it in a block
        // of its cell.
        (from_edge_m / BLOCK_M).floor().clamp(0.0, BLOCKS as f64 - 1.0) as u8
    };
    BLOCKS as u8 * step(mean_m[1], y) + step(mean_m[0], x)
}

/// Morton code of a position: interleaves the bits of x, y, z in steps of 1/1024 of a cell, modulo
/// 128 km.
pub fn morton(mean_m: &[f64; 3]) -> u64 {
    mean_m.iter().enumerate().fold(0, |code, (axis, &m)| {
        // Through i64, because a cast of a negative float to u64 gives 0. The mask takes the low 21
        // bits: positions repeat after 128 km, and negative ones come after positive ones.
        let steps = (m * (1024.0 / CELL_M)).floor() as i64 as u64 & 0x1F_FFFF;
        code | spread(steps) << axis
    })
}

/// Moves bit `i` of a 21-bit number to bit `3 i`, by the usual halving masks for Morton codes.
fn spread(x: u64) -> u64 {
    let x = (x | x << 32) & 0x001F_0000_0000_FFFF;
    let x = (x | x << 16) & 0x001F_0000_FF00_00FF;
    let x = (x | x << 8) & 0x100F_00F0_0F00_F00F;
    let x = (x | x << 4) & 0x10C3_0C30_C30C_30C3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// The chunks that a frame draws, and the sky behind them. The global id of a Gaussian is its index
/// when counting through all chunks in order, and then through the actors' in order.
///
/// ```
/// use wildcity_scene::{Gaussians, Scene};
///
/// let gaussians = Gaussians {
///     sh_degree: 0,
///     means_m: vec![[1.0, 0.0, 0.5], [70.0, 0.0, 0.5]],
///     quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; 2],
///     ln_scales: vec![[-3.0; 3]; 2],
///     logit_opacities: vec![2.0; 2],
///     sh: vec![0.5; 6],
///     ..Gaussians::default()
/// };
/// let scene = Scene::from_gaussians(&gaussians);
/// assert_eq!(scene.gaussians(), 2);
/// assert_eq!(scene.chunks[1].cell(), [1, 0]); // cells are 64 m wide
/// ```
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// Chunks of one SH degree, in order of (cell y, cell x).
    pub chunks: Vec<Arc<Chunk>>,
    /// Which views of a frame draw which of these chunks; without it, all views draw all of them.
    pub selection: Option<Selection>,
    /// Actors. Among Gaussians with equal depths, those of the twin are in front, then those of
    /// actors in the order of this list. A view has at most [`PlacedChunk::MAX_ACTORS`] of them.
    pub placed: Vec<PlacedChunk>,
    /// The sky; without one, the background colour of the render profile is drawn (black by
    /// default).
    pub sky: Option<Arc<Sky>>,
}

impl Scene {
    /// Sorts all Gaussians into cells and activates them. The result has no sky.
    pub fn from_gaussians(gaussians: &Gaussians) -> Self {
        let partition = Partition::new(&gaussians.means_m);
        let chunk = |cell: &CellRun| {
            let count = cell.run.len();
            let mut chunk = Chunk::new(cell.cell, cell.origin_m, gaussians.sh_degree, count);
            for &index in &partition.order[cell.run.clone()] {
                chunk.push(&cell.record(gaussians, index as usize));
            }
            let order = partition.order[cell.run.clone()].iter();
            Arc::new(chunk.with_classes(gaussians.select_classes(order.map(|&i| i as usize))))
        };
        Self { chunks: partition.cells.par_iter().map(chunk).collect(), ..Self::default() }
    }

    /// All Gaussians in one chunk with its origin at that of their axes, in Morton order: for
    /// assets of actors. Means in f32 are exact to 4 µm within 64 m.
    pub fn single_chunk(gaussians: &Gaussians) -> Chunk {
        let mut order: Vec<(u64, usize)> =
            gaussians.means_m.iter().map(morton).zip(0..gaussians.len()).collect();
        order.par_sort_unstable();
        let mut chunk = Chunk::new([0, 0], DVec3::ZERO, gaussians.sh_degree, gaussians.len());
        let classes = gaussians.select_classes(order.iter().map(|&(_, index)| index));
        for (_, index) in order {
            chunk.push(&RawGaussian {
                mean_m: gaussians.means_m[index].map(|m| m as f32),
                quat_wxyz: gaussians.quats_wxyz[index],
                ln_scale: gaussians.ln_scales[index],
                logit_opacity: gaussians.logit_opacities[index],
                sh: gaussians.sh_at(index),
            });
        }
        chunk.with_classes(classes)
    }

    /// Whether a view of the frame draws a chunk of the twin, by their indices.
    #[inline]
    pub fn draws(&self, chunk: usize, view: usize) -> bool {
        self.selection.as_ref().is_none_or(|selection| selection.by_chunk[chunk].contains(view))
    }

    /// The scene that one view of the frame draws.
    pub fn for_view(&self, view: usize) -> Cow<'_, Self> {
        if self.selection.is_none() && self.placed.iter().all(|placed| placed.views.contains(view))
        {
            return Cow::Borrowed(self);
        }
        let chunks = self.chunks.iter().enumerate().filter(|(chunk, _)| self.draws(*chunk, view));
        let seen = self.placed.iter().filter(|placed| placed.views.contains(view));
        // Drawn by every view of a frame, whatever their number there.
        let placed = seen.map(|placed| PlacedChunk { views: ViewSet::ALL, ..placed.clone() });
        Cow::Owned(Self {
            chunks: chunks.map(|(_, chunk)| chunk.clone()).collect(),
            selection: None,
            placed: placed.collect(),
            sky: self.sky.clone(),
        })
    }

    /// Number of Gaussians in all chunks, with those of each actor.
    pub fn gaussians(&self) -> usize {
        let placed = self.placed.iter().map(|placed| &placed.chunk);
        self.chunks.iter().chain(placed).map(|chunk| chunk.len()).sum()
    }

    /// Spherical-harmonic degree of the twin; 0 if it is empty.
    pub fn sh_degree(&self) -> u8 {
        self.chunks.first().map_or(0, |chunk| chunk.sh_degree())
    }

    /// Every chunk once, in order: those of the twin, then those of actors. Actors may share
    /// chunks.
    pub fn distinct_chunks(&self) -> impl Iterator<Item = &Arc<Chunk>> {
        let mut shared = BTreeSet::new();
        let placed = self.placed.iter().map(|placed| &placed.chunk);
        // By address: two actors share a chunk if they share the allocation. Comparing contents
        // would cost a pass over all Gaussians.
        let own = placed.filter(move |chunk| shared.insert(Arc::as_ptr(chunk)));
        self.chunks.iter().chain(own)
    }

    /// Memory that the chunks have allocated, in bytes. Memory that several actors share is counted
    /// once.
    pub fn bytes(&self) -> usize {
        self.distinct_chunks().map(|chunk| chunk.bytes()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three() -> Gaussians {
        Gaussians {
            sh_degree: 0,
            means_m: vec![[40.0, 0.0, 100.0], [0.25, -1.0, 130.0], [0.5, 40.0, 4.5]],
            quats_wxyz: vec![[2.0, 0.0, 0.0, 0.0]; 3],
            ln_scales: vec![[0.0, -1.0, 1.0]; 3],
            logit_opacities: vec![0.0, 100.0, -100.0],
            sh: vec![0.5; 9],
            classes: Some(vec![SemanticClass::Car, SemanticClass::Road, SemanticClass::Sky]),
        }
    }

    #[test]
    fn gaussians_are_sorted_into_the_cell_around_them() {
        let scene = Scene::from_gaussians(&three());
        let cells: Vec<_> = scene.chunks.iter().map(|chunk| chunk.cell()).collect();
        assert_eq!(cells, [[0, 0], [1, 0], [0, 1]]);
        let first = &scene.chunks[0];
        assert_eq!(first.origin_m(), DVec3::new(0.0, 0.0, 128.0));
        assert_eq!([0, 1, 2].map(|c| first.value(0, c)), [0.25, -1.0, 2.0]);
        assert_eq!(scene.gaussians(), 3);
    }

    #[test]
    fn activation_is_exp_sigmoid_and_normalise() {
        let scene = Scene::from_gaussians(&three());
        let value = |chunk: usize, column| scene.chunks[chunk].value(0, column);
        assert_eq!(value(0, column::SCALE + 2), std::f32::consts::E);
        assert_eq!(value(0, column::QUAT), 1.0);
        assert_eq!(value(1, column::LOG2_OPACITY), -1.0, "opacity one half");
        let full = value(0, column::LOG2_OPACITY);
        assert!((-1e-40..=0.0).contains(&full), "sigmoid(100) is 1 - exp(-100), not {full:e}");
        // sigmoid(-100) = exp(-100) to 43 digits.
        assert!((value(2, column::LOG2_OPACITY) + 100.0 * std::f32::consts::LOG2_E).abs() < 1e-5);
        let unused = &scene.chunks[0].lane_group(0)[column::LOG2_OPACITY].0[1..];
        assert_eq!(unused, [f32::NEG_INFINITY; LANES - 1]);
    }

    /// `push_activated` and `from_lanes` both empty the lane of an invalid Gaussian and keep its
    /// neighbour.
    #[test]
    fn both_constructors_empty_the_lanes_of_invalid_gaussians() {
        let mut cell = Chunk::new([0, 0], DVec3::ZERO, 0, 2);
        for _ in 0..2 {
            cell.push(&RawGaussian {
                mean_m: [1.0; 3],
                quat_wxyz: [1.0, 0.0, 0.0, 0.0],
                ln_scale: [0.0; 3],
                logit_opacity: 0.0,
                sh: &[0.5; 3],
            });
        }
        let opacities = |chunk: &Chunk| [0, 1].map(|i| chunk.value(i, column::LOG2_OPACITY));
        assert_eq!(opacities(&cell), [-1.0; 2]);
        for (column, value) in [
            (column::MEAN, f32::NAN),
            (column::SCALE, f32::INFINITY),
            (column::LOG2_OPACITY, f32::INFINITY),
            (column::SH, 1e6),
            (column::SH + 2, f32::NEG_INFINITY),
        ] {
            let mut lanes = cell.lane_group(0).to_vec();
            lanes[column].0[0] = value;
            let mut pages = LanePages::new(columns(0), None);
            pages.extend_from_slice(&lanes);
            let laid = Chunk::from_lanes([0, 0], DVec3::ZERO, 0, 2, pages);
            let one = |i: usize, column: usize| lanes[column].0[i];
            let mut pushed = Chunk::new([0, 0], DVec3::ZERO, 0, 2);
            for i in 0..2 {
                pushed.push_activated(&ActivatedGaussian {
                    mean_m: [0, 1, 2].map(|k| one(i, column::MEAN + k)),
                    scale_m: [0, 1, 2].map(|k| one(i, column::SCALE + k)),
                    quat_wxyz: [0, 1, 2, 3].map(|k| one(i, column::QUAT + k)),
                    log2_opacity: one(i, column::LOG2_OPACITY),
                    sh: &[0, 1, 2].map(|k| one(i, column::SH + k)),
                });
            }
            for chunk in [laid, pushed] {
                assert_eq!(opacities(&chunk), [f32::NEG_INFINITY, -1.0], "{column} is {value}");
            }
        }
    }

    /// Three clusters, of which the last is partly filled, with an invalid Gaussian in the second.
    #[test]
    fn clusters_of_lanes_are_those_of_pushed_gaussians() {
        let count = 2 * CLUSTER + 21;
        let mut pushed = Chunk::new([0, 0], DVec3::ZERO, 0, count);
        for i in 0..count {
            // Multiples modulo the prime 1009: a cheap, repeatable scatter from -0.5 to 0.5.
            let share = |k: usize| (i * k % 1_009) as f32 / 1_009.0 - 0.5;
            let x_m = if i == CLUSTER + 7 { f32::NAN } else { 30.0 * share(37) };
            pushed.push_activated(&ActivatedGaussian {
                mean_m: [x_m, 30.0 * share(101), -4.0 * share(467)],
                scale_m: [0.6 + share(911), 0.6 + share(13), 0.6 + share(211)],
                quat_wxyz: [1.0, 0.0, 0.0, 0.0],
                log2_opacity: -1.0,
                sh: &[0.5; 3],
            });
        }
        let groups = (0..count.div_ceil(LANES)).flat_map(|k| pushed.lane_group(k).iter().copied());
        let mut lanes: Vec<Lanes> = groups.collect();
        lanes[(CLUSTER + 7) / LANES * columns(0)].0[7] = f32::NAN;
        // Values in lanes after the last Gaussian do not count.
        lanes.last_mut().unwrap().0[LANES - 1] = 1e30;
        let mut pages = LanePages::new(columns(0), None);
        pages.extend_from_slice(&lanes);
        let laid = Chunk::from_lanes([0, 0], DVec3::ZERO, 0, count, pages);
        assert_eq!(laid.clusters().len(), 3);
        assert_eq!(laid.clusters(), pushed.clusters());
        for index in [0, CLUSTER + 7, count - 1] {
            for column in 0..columns(0) {
                assert_eq!(laid.value(index, column), pushed.value(index, column), "{index}");
            }
        }
    }

    #[test]
    fn raw_values_are_restored() {
        let raw = three();
        let scene = Scene::from_gaussians(&raw);
        let mut again = Gaussians::default();
        scene.chunks.iter().for_each(|chunk| again.append(&chunk.to_gaussians()));
        // In order of cells.
        let order = [1, 0, 2];
        for (index, from) in order.into_iter().enumerate() {
            assert_eq!(again.means_m[index], raw.means_m[from]);
            assert_eq!(again.quats_wxyz[index], [1.0, 0.0, 0.0, 0.0]);
            assert_eq!(again.sh_at(index), raw.sh_at(from));
            let class = |of: &Gaussians, i: usize| of.classes.as_ref().map(|all| all[i]);
            assert_eq!(class(&again, index), class(&raw, from));
            for axis in 0..3 {
                let off = again.ln_scales[index][axis] - raw.ln_scales[from][axis];
                assert!(off.abs() < 1e-6, "{off}");
            }
            let was = raw.logit_opacities[from];
            let is = again.logit_opacities[index];
            // A logit of 100 comes back as 30, where the inverse is clamped.
            assert!((was.clamp(-100.0, 30.0) - is).abs() < 1e-4, "{was} became {is}");
        }
    }

    #[test]
    fn neighbours_in_morton_order_are_near_each_other() {
        let means: Vec<_> = (0..4096)
            .map(|i: i32| [i % 16, i / 16 % 16, i / 256].map(|x| 2.0 * f64::from(x) - 15.0))
            .collect();
        let order = Partition::new(&means).order;
        // 256 consecutive points of a 16 x 16 x 16 grid fill a box of 8 x 8 x 4 points.
        for cluster in order.chunks(CLUSTER) {
            let mut bounds = crate::geometry::Bounds::EMPTY;
            for &i in cluster {
                bounds.add(DVec3::from_array(means[i as usize]), DVec3::ZERO);
            }
            // 8 points 2 m apart span 14 m; the bound leaves one step of tolerance.
            assert!(bounds.size_m().max_element() <= 16.0, "{bounds:?}");
        }
    }
}
