//! The Gaussians that a beam of a sector may meet.
//!
//! A Gaussian ends where its alpha falls below the cut: an ellipsoid. Its box in the sector's axes
//! contains it, and the tangents of the azimuths and elevations of a box are quotients of its
//! coordinates. No angle has to be computed, and no bound is linearised.

use fearless_simd::{Level, dispatch, f32x16, prelude::*};
use glam::{Mat3, Quat, Vec3};

use super::sector::{BodySector, Sector};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::project::axes::rotation_columns;
use crate::lidar::{Body, THINNEST_M, alpha_cut, luminance, reach2};
use wildcity_scene::chunk::{CLUSTER, Cluster, LANES, Lanes, column};
use wildcity_scene::{Chunk, RenderProfile};

/// A Gaussian that beams of a sector may meet, in the axes of its body.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    /// Its centre relative to the LiDAR's middle position in the sector, in metres.
    pub(super) mean_m: [f32; 3],
    /// Rows of the matrix that takes vectors in metres to standard deviations.
    pub(super) whiten: [[f32; 3]; 3],
    pub(super) log2_opacity: f32,
    /// Squared standard deviations from its centre at which alpha falls below the cut.
    pub(super) reach2: f32,
    /// No beam meets it nearer than this, in metres.
    pub(super) nearest_m: f32,
    pub(super) luminance: f32,
    /// The global id: the chunk, then the index.
    pub(super) id: u64,
    pub(super) instance: u16,
    /// The rows that may meet it.
    pub(super) rows: [u16; 2],
    /// Smallest and largest tangent of the azimuths that may meet it.
    azimuths: [f32; 2],
}

/// Candidates of one body in a sector that have not been compared with beams yet.
#[derive(Default)]
pub(super) struct Candidates {
    pub(super) list: Vec<Candidate>,
}

/// Candidates after which they are compared with beams: they, and their places in the lists of
/// tiles, are in memory at once, 4 MB.
pub(super) const BATCH: usize = 1 << 15;

/// A cluster, and whose it is.
#[derive(Clone, Copy)]
struct ClusterOfChunk<'a> {
    body: &'a Body<'a>,
    chunk: &'a Chunk,
    /// Number of the chunk in the scene.
    number: usize,
    /// Number of the cluster in the chunk.
    cluster: usize,
}

/// What the tests of one chunk in one sector share.
struct ChunkTest {
    /// Rows of `sector_from_body`, in f32.
    axes: [[f32; 3]; 3],
    /// The LiDAR's middle position relative to the chunk's origin, in the body's axes, in metres.
    middle_m: [f32; 3],
    moved_m: f32,
    turned_rad: f32,
    /// Tangents of the azimuths of all beams: smallest, largest.
    azimuths: [f32; 2],
    /// Tangents of the elevations of all beams: smallest, largest.
    elevations: [f32; 2],
    max_range_m: f32,
    alpha_cut_log2: f32,
    /// Standard deviations at which an opaque Gaussian ends.
    sigmas: f32,
}

/// What a beam may see of 16 Gaussians.
struct Bounds {
    /// The lanes that a beam may meet.
    lanes: u64,
    azimuth_low: [f32; LANES],
    azimuth_high: [f32; LANES],
    elevation_low: [f32; LANES],
    elevation_high: [f32; LANES],
    nearest_m: [f32; LANES],
}

impl Candidates {
    /// Adds the Gaussians of a cluster that beams of the sector may meet.
    fn add(
        &mut self,
        level: Level,
        sector: &Sector,
        part: &ClusterOfChunk<'_>,
        test: &ChunkTest,
        profile: &RenderProfile,
    ) {
        let ClusterOfChunk { body, chunk, number, cluster } = *part;
        let first = cluster * CLUSTER / LANES;
        let groups = chunk.len().div_ceil(LANES);
        for group in first..(first + CLUSTER / LANES).min(groups) {
            let columns = chunk.lane_group(group);
            let Some(found) = dispatch!(level, simd => block_bounds(simd, columns, test)) else {
                continue;
            };
            let mut lanes = found.lanes;
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % LANES;
                lanes &= lanes - 1;
                let rows =
                    sector.rows_between(found.elevation_low[lane], found.elevation_high[lane]);
                // It lies between two rows, and no beam meets it.
                if rows.is_empty() {
                    continue;
                }
                let log2_opacity = columns[column::LOG2_OPACITY].0[lane];
                self.list.push(Candidate {
                    mean_m: mean_m(columns, lane, test),
                    whiten: whiten(columns, lane),
                    log2_opacity,
                    reach2: reach2(log2_opacity.into(), profile) as f32,
                    nearest_m: found.nearest_m[lane],
                    luminance: luminance(body, |column| columns[column].0[lane]),
                    id: (number as u64) << 32 | (group * LANES + lane) as u64,
                    instance: body.instance,
                    rows: [rows.start as u16, rows.end as u16],
                    azimuths: [found.azimuth_low[lane], found.azimuth_high[lane]],
                });
            }
        }
    }

    /// Finds the Gaussians of a chunk that beams of the sector may meet, and calls `compare` with
    /// them whenever there are many.
    pub(super) fn find(
        &mut self,
        level: Level,
        seen: &BodySector<'_>,
        (number, chunk): (usize, &Chunk),
        profile: &RenderProfile,
        mut compare: impl FnMut(&mut Self),
    ) {
        let test = ChunkTest::new(seen, chunk, profile);
        for (cluster, bounds) in chunk.clusters().iter().enumerate() {
            if test.may_meet(bounds) {
                let part = ClusterOfChunk { body: &seen.body, chunk, number, cluster };
                self.add(level, seen.sector, &part, &test, profile);
                if self.list.len() >= BATCH {
                    compare(self);
                }
            }
        }
    }

    /// The candidates of each tile of `rows` rows, the nearest first: tile after tile of the first
    /// 16 rows, then those of the next.
    pub(super) fn by_tile(&self, level: Level, sector: &Sector, rows: usize) -> Vec<Vec<u32>> {
        let tiles = sector.tile_tangents.len();
        // Sorted as one integer: positive f32 have the order of their bits.
        let mut keys = vec![Vec::new(); tiles * rows.div_ceil(LANES)];
        for (at, candidate) in self.list.iter().enumerate() {
            let [first, end] = candidate.rows.map(usize::from);
            let key = u64::from(candidate.nearest_m.max(0.0).to_bits()) << 32 | at as u64;
            for (tile, columns) in sector.tile_tangents.iter().enumerate() {
                // Most Gaussians far away lie between two columns.
                let [low, high] = candidate.azimuths;
                let [least, most] = sector.tile_spans[tile];
                let is_near = least <= high && most >= low;
                if is_near && dispatch!(level, simd => sees(simd, columns, [low, high])) {
                    for row in first / LANES..end.div_ceil(LANES) {
                        keys[row * tiles + tile].push(key);
                    }
                }
            }
        }
        let list = |mut keys: Vec<u64>| {
            keys.sort_unstable();
            keys.into_iter().map(|key| key as u32).collect()
        };
        keys.into_iter().map(list).collect()
    }
}

/// Whether a column of a tile sees azimuths with these tangents.
#[inline(always)]
fn sees<S: Simd>(simd: S, columns: &[[f32; LANES]; 2], [low, high]: [f32; 2]) -> bool {
    let [least, most] = columns;
    let sees = f32x16::load_array_ref(simd, least).simd_le(f32x16::splat(simd, high))
        & f32x16::load_array_ref(simd, most).simd_ge(f32x16::splat(simd, low));
    !sees.all_false()
}

/// Three columns of a Gaussian from `first`.
fn vector(columns: &[Lanes], lane: usize, first: usize) -> Vec3 {
    Vec3::from_array([first, first + 1, first + 2].map(|column| columns[column].0[lane]))
}

fn mean_m(columns: &[Lanes], lane: usize, test: &ChunkTest) -> [f32; 3] {
    (vector(columns, lane, column::MEAN) - Vec3::from_array(test.middle_m)).to_array()
}

/// Rows of the matrix that takes vectors in metres to standard deviations of a Gaussian.
fn whiten(columns: &[Lanes], lane: usize) -> [[f32; 3]; 3] {
    let w = columns[column::QUAT].0[lane];
    let axes = Mat3::from_quat(Quat::from_vec4(vector(columns, lane, column::QUAT + 1).extend(w)));
    let per_m = vector(columns, lane, column::SCALE).max(Vec3::splat(THINNEST_M as f32)).recip();
    // Rows of the transpose are the columns of the rotation: the Gaussian's own axes.
    [axes.x_axis * per_m.x, axes.y_axis * per_m.y, axes.z_axis * per_m.z].map(|row| row.to_array())
}

impl ChunkTest {
    fn new(seen: &BodySector<'_>, chunk: &Chunk, profile: &RenderProfile) -> Self {
        let sector = seen.sector;
        let rows = seen.sector_from_body.transpose().to_cols_array_2d();
        let spans = &sector.tile_spans;
        let low = spans.iter().map(|span| span[0]).fold(f32::INFINITY, f32::min);
        let high = spans.iter().map(|span| span[1]).fold(f32::NEG_INFINITY, f32::max);
        Self {
            axes: rows.map(|row| row.map(|value| value as f32)),
            middle_m: (-seen.relative_to_middle(chunk.origin_m())).as_vec3().to_array(),
            // A millimetre covers the rounding of f32 at a kilometre.
            moved_m: seen.moved_m as f32 + 1e-3,
            turned_rad: seen.turned_rad as f32 + 1e-6,
            azimuths: [low, high],
            elevations: sector.elevation_tangents(),
            max_range_m: seen.sector.max_range_m,
            alpha_cut_log2: alpha_cut(profile).log2() as f32,
            sigmas: reach2(0.0, profile).max(0.0).sqrt() as f32,
        }
    }

    /// Whether a beam may meet a Gaussian of a cluster; `true` when in doubt.
    fn may_meet(&self, cluster: &Cluster) -> bool {
        let center = 0.5 * (cluster.min_m + cluster.max_m) - Vec3::from_array(self.middle_m);
        let half = 0.5 * (cluster.max_m - cluster.min_m);
        let range_m = center.length() + half.length();
        let reach_m = self.sigmas * cluster.sigma_m * (1.0 + 1e-4);
        let margin_m = reach_m + self.moved_m + self.turned_rad * (range_m + reach_m);
        let along = |axis: usize| {
            let row = Vec3::from_array(self.axes[axis]);
            [row.dot(center), row.abs().dot(half) + margin_m]
        };
        let [x, half_x] = along(0);
        let [y, half_y] = along(1);
        let [z, half_z] = along(2);
        let far_x = x + half_x;
        let nearest_m = center.length() - half.length() - margin_m;
        if far_x < 0.0 || nearest_m > self.max_range_m {
            return false;
        }
        // Beside the sector: a tangent times x is largest in size at the far side.
        let right = self.azimuths[0];
        let left = self.azimuths[1];
        let near_x = (x - half_x).max(0.0);
        let most = |tangent: f32| if tangent > 0.0 { tangent * far_x } else { tangent * near_x };
        let least = |tangent: f32| if tangent > 0.0 { tangent * near_x } else { tangent * far_x };
        if y - half_y > most(left) || y + half_y < least(right) {
            return false;
        }
        // Above or below: by the horizontal distance.
        let far_m = far_x.hypot(y.abs() + half_y);
        let near_m = near_x.hypot((y.abs() - half_y).max(0.0));
        let [low, high] = self.elevations;
        let highest = if high > 0.0 { high * far_m } else { high * near_m };
        let lowest = if low > 0.0 { low * near_m } else { low * far_m };
        z - half_z <= highest && z + half_z >= lowest
    }
}

/// Bounds of 16 Gaussians; `None` if a beam meets none of them.
#[inline(always)]
fn block_bounds<S: Simd>(simd: S, columns: &[Lanes], test: &ChunkTest) -> Option<Bounds> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let zero = splat(0.0);
    let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
    let visible = log2_opacity.simd_ge(splat(test.alpha_cut_log2));
    if visible.all_false() {
        return None;
    }
    // The half-size of the ellipsoid's box along each axis of the sector, as in the definition of
    // the reach.
    let ln4 = 2.0 * std::f32::consts::LN_2;
    // Never farther than an opacity of 1 reaches, as for splats.
    let above_cut = log2_opacity.min(zero) - splat(test.alpha_cut_log2);
    let reach = (above_cut * splat(ln4)).max(zero).sqrt() * splat(1.0 + 1e-4);
    let mean =
        Vec3x16::load(simd, columns, column::MEAN).minus(Vec3x16::splat(simd, test.middle_m));
    let range_m = mean.dot(mean).sqrt();
    let scale = Vec3x16::load(simd, columns, column::SCALE);
    let own = rotation_columns(simd, columns);
    // A point of the ellipsoid moves by the turn times its own distance.
    let largest = scale.x.max(scale.y).max(scale.z);
    let farthest_m = largest.mul_add(reach, range_m);
    let margin_m = farthest_m.mul_add(splat(test.turned_rad), splat(test.moved_m));
    let [x, half_x] = along(simd, test.axes[0], mean, own, scale, reach, margin_m);
    let [y, half_y] = along(simd, test.axes[1], mean, own, scale, reach, margin_m);
    let [z, half_z] = along(simd, test.axes[2], mean, own, scale, reach, margin_m);
    // The nearer of two bounds that contain the ellipsoid, a sphere and the box. A road's Gaussians
    // are so flat that the sphere is up to their length too near.
    let sphere_m = range_m - largest * reach - margin_m;
    let outside = Vec3x16 { x: x.abs() - half_x, y: y.abs() - half_y, z: z.abs() - half_z };
    let outside = outside.max(zero);
    let nearest_m = sphere_m.max(outside.dot(outside).sqrt() * splat(1.0 - 1e-6));
    let far_x = x + half_x;
    let near_x = x - half_x;
    // Quotients of a box that reaches behind the LiDAR have no bound.
    let unbounded = near_x.simd_le(splat(1e-3));
    let divisor = near_x.max(splat(1e-3));
    let huge = splat(f32::MAX);
    let azimuth_low = unbounded.select(-huge, quotient(simd, y - half_y, far_x, divisor));
    let azimuth_high = unbounded.select(huge, quotient(simd, y + half_y, divisor, far_x));
    // Horizontal distances of the box. Behind the LiDAR nothing is seen, so that 0 is the nearest.
    let beside = (y.abs() - half_y).max(zero);
    let beyond = y.abs() + half_y;
    let ahead = near_x.max(zero);
    let near = ahead.mul_add(ahead, beside * beside).sqrt().max(splat(1e-9));
    let far = far_x.mul_add(far_x, beyond * beyond).sqrt().max(splat(1e-9));
    let elevation_low = quotient(simd, z - half_z, far, near);
    let elevation_high = quotient(simd, z + half_z, near, far);
    let meets = visible
        & far_x.simd_gt(zero)
        & nearest_m.simd_le(splat(test.max_range_m))
        & azimuth_low.simd_le(splat(test.azimuths[1]))
        & azimuth_high.simd_ge(splat(test.azimuths[0]))
        & elevation_low.simd_le(splat(test.elevations[1]))
        & elevation_high.simd_ge(splat(test.elevations[0]));
    let lanes = meets.to_bitmask();
    if lanes == 0 {
        return None;
    }
    Some(Bounds {
        lanes,
        azimuth_low: azimuth_low.to_array(),
        azimuth_high: azimuth_high.to_array(),
        elevation_low: elevation_low.to_array(),
        elevation_high: elevation_high.to_array(),
        nearest_m: nearest_m.to_array(),
    })
}

/// The middle and the half-size of ellipsoids along an axis, in metres.
#[inline(always)]
fn along<S: Simd>(
    simd: S,
    axis: [f32; 3],
    mean: Vec3x16<S>,
    own: [Vec3x16<S>; 3],
    scale: Vec3x16<S>,
    reach: f32x16<S>,
    margin_m: f32x16<S>,
) -> [f32x16<S>; 2] {
    let row = Vec3x16::splat(simd, axis);
    let along_own = Vec3x16 { x: row.dot(own[0]), y: row.dot(own[1]), z: row.dot(own[2]) };
    let root = along_own.times(scale);
    [row.dot(mean), root.dot(root).sqrt().mul_add(reach, margin_m)]
}

/// An edge of a box divided by one distance if it is positive, and by another if not.
#[inline(always)]
fn quotient<S: Simd>(
    simd: S,
    edge: f32x16<S>,
    positive: f32x16<S>,
    negative: f32x16<S>,
) -> f32x16<S> {
    edge / edge.simd_gt(f32x16::splat(simd, 0.0)).select(positive, negative)
}
