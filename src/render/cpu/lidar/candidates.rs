//! The Gaussians that a beam of a sector may meet.
//!
//! A Gaussian ends where its alpha falls below the cut: an ellipsoid. Its box in the sector's axes
//! contains it, and the tangents of the azimuths and elevations of a box are quotients of its
//! coordinates. No angle has to be computed, and no bound is linearised.

use fearless_simd::{Level, dispatch, f32x16, prelude::*};
use glam::Vec3;

use super::sector::{BodySector, Sector};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::project::axes::rotation_columns;
use crate::lidar::{LUMINANCE, THINNEST_M, alpha_cut, reach2};
use wildcity_scene::chunk::{CLUSTER, Cluster, LANES, Lanes, column};
use wildcity_scene::{Chunk, RenderProfile, sh};

/// A Gaussian that beams of a sector may meet, in the axes of its body.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate {
    /// Its centre relative to the LiDAR's middle position in the sector, in metres.
    pub(crate) mean_m: [f32; 3],
    /// The matrix that takes vectors in metres to standard deviations, row by row.
    pub(crate) whiten: [f32; 9],
    pub(crate) log2_opacity: f32,
    /// Squared standard deviations from its centre at which alpha falls below the cut.
    pub(crate) reach2: f32,
    /// No beam meets it nearer than this, in metres.
    pub(crate) nearest_m: f32,
    pub(crate) luminance: f32,
    /// Its place among all Gaussians of the scene.
    pub(crate) key: u32,
    /// The rows that may meet it.
    pub(crate) rows: [u16; 2],
    /// Smallest and largest tangent of the azimuths that may meet it.
    azimuths: [f32; 2],
}

/// Candidates of one body in a sector that have not been compared with beams yet.
#[derive(Default)]
pub(crate) struct Candidates {
    pub(crate) list: Vec<Candidate>,
    /// Places in the list of the candidates of each tile, from the nearest.
    pub(crate) lists: Vec<Vec<u32>>,
    /// Memory to sort them.
    keys: Vec<u64>,
    sorted: Vec<Candidate>,
}

/// Candidates after which they are compared with beams: they, and their places in the lists of
/// tiles, are in memory at once, 6 to 15 MB.
const BATCH: usize = 1 << 15;

/// Most candidates at once: a batch is full after a cluster.
pub(super) const MOST_CANDIDATES: usize = BATCH + CLUSTER;

/// A cluster of a chunk.
#[derive(Clone, Copy)]
struct ClusterOfChunk<'a> {
    chunk: &'a Chunk,
    /// Key of the chunk's first Gaussian.
    first_key: u32,
    /// Number of the cluster in the chunk.
    cluster: usize,
}

/// What the tests of one chunk in one sector share.
struct ChunkTest {
    /// Rows of `sector_from_body`, in f32.
    axes: [[f32; 3]; 3],
    /// The LiDAR's middle position relative to the chunk's origin, in the body's axes, in metres.
    middle_m: [f32; 3],
    /// The most that the LiDAR moves along each axis of the sector, in metres.
    moved_m: [f32; 3],
    turned_rad: f32,
    /// Tangents of the azimuths of all beams: smallest, largest.
    azimuths: [f32; 2],
    /// Tangents of the elevations of all beams: smallest, largest.
    elevations: [f32; 2],
    max_range_m: f32,
    alpha_cut_log2: f32,
    /// Standard deviations at which an opaque Gaussian ends.
    sigmas: f32,
    /// Factors of the body's colours.
    tint: [f32; 3],
}

/// What a beam may see of 16 Gaussians. Fields of one lane are those of a [`Candidate`].
struct Block {
    /// The lanes that a beam may meet.
    lanes: u64,
    azimuths: [[f32; LANES]; 2],
    elevations: [[f32; LANES]; 2],
    nearest_m: [f32; LANES],
    mean_m: [[f32; LANES]; 3],
    whiten: [[f32; LANES]; 9],
    luminance: [f32; LANES],
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
        let ClusterOfChunk { chunk, first_key, cluster } = *part;
        let first = cluster * CLUSTER / LANES;
        let groups = chunk.len().div_ceil(LANES);
        for group in first..(first + CLUSTER / LANES).min(groups) {
            let columns = chunk.lane_group(group);
            let Some(block) = dispatch!(level, simd => Block::new(simd, columns, test)) else {
                continue;
            };
            let mut lanes = block.lanes;
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % LANES;
                lanes &= lanes - 1;
                let [low, high] = block.elevations.each_ref().map(|tangents| tangents[lane]);
                let rows = sector.rows.between(low, high);
                // It lies between two rows, and no beam meets it.
                if rows.is_empty() {
                    continue;
                }
                let log2_opacity = columns[column::LOG2_OPACITY].0[lane];
                self.list.push(Candidate {
                    mean_m: block.mean_m.each_ref().map(|values| values[lane]),
                    whiten: block.whiten.each_ref().map(|values| values[lane]),
                    log2_opacity,
                    reach2: reach2(log2_opacity.into(), profile) as f32,
                    nearest_m: block.nearest_m[lane],
                    luminance: block.luminance[lane],
                    key: first_key + (group * LANES + lane) as u32,
                    rows: [rows.start as u16, rows.end as u16],
                    azimuths: block.azimuths.each_ref().map(|tangents| tangents[lane]),
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
        (first_key, chunk): (u32, &Chunk),
        profile: &RenderProfile,
        mut compare: impl FnMut(&mut Self),
    ) {
        let test = ChunkTest::new(seen, chunk, profile);
        for (cluster, bounds) in chunk.clusters().iter().enumerate() {
            if test.may_meet(bounds) {
                let part = ClusterOfChunk { chunk, first_key, cluster };
                self.add(level, seen.sector, &part, &test, profile);
                if self.list.len() >= BATCH {
                    compare(self);
                }
            }
        }
    }

    /// Sorts the candidates, the nearest first, and lists those of each tile of `rows` rows: tile
    /// after tile of the first 16 rows, then those of the next.
    pub(super) fn sort_to_tiles(&mut self, level: Level, sector: &Sector, rows: usize) {
        self.sort();
        let tiles = sector.tiles.len();
        self.lists.resize(tiles * rows.div_ceil(LANES), Vec::new());
        self.lists.iter_mut().for_each(Vec::clear);
        for (at, candidate) in self.list.iter().enumerate() {
            let [first, end] = candidate.rows.map(usize::from);
            let [low, high] = candidate.azimuths;
            for (tile, columns) in sector.tiles.iter().enumerate() {
                let [least, most] = columns.span;
                if least > high || most < low {
                    continue;
                }
                // Many Gaussians far away lie between two columns.
                let is_wide = high - low > columns.widest_gap;
                let tangents = &columns.tangents;
                if is_wide || dispatch!(level, simd => sees(simd, tangents, [low, high])) {
                    for row in first / LANES..end.div_ceil(LANES) {
                        self.lists[row * tiles + tile].push(at as u32);
                    }
                }
            }
        }
    }

    /// Sorts the candidates themselves, and not their places in the lists of tiles: a tile then
    /// reads them in the order of memory.
    fn sort(&mut self) {
        // As one integer: positive f32 have the order of their bits.
        let key = |(at, candidate): (usize, &Candidate)| {
            u64::from(candidate.nearest_m.max(0.0).to_bits()) << 32 | at as u64
        };
        self.keys.clear();
        self.keys.extend(self.list.iter().enumerate().map(key));
        self.keys.sort_unstable();
        self.sorted.clear();
        self.sorted.extend(self.keys.iter().map(|key| self.list[*key as u32 as usize]));
        std::mem::swap(&mut self.list, &mut self.sorted);
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

impl ChunkTest {
    fn new(seen: &BodySector<'_>, chunk: &Chunk, profile: &RenderProfile) -> Self {
        let sector = seen.sector;
        let rows = seen.sector_from_body.transpose().to_cols_array_2d();
        let spans = sector.tiles.iter().map(|tile| tile.span);
        let low = spans.clone().map(|span| span[0]).fold(f32::INFINITY, f32::min);
        let high = spans.map(|span| span[1]).fold(f32::NEG_INFINITY, f32::max);
        Self {
            axes: rows.map(|row| row.map(|value| value as f32)),
            middle_m: (-seen.relative_to_middle(chunk.origin_m())).as_vec3().to_array(),
            // A millimetre covers the rounding of f32 at a kilometre.
            moved_m: (seen.moved_m.as_vec3() + 1e-3).to_array(),
            turned_rad: seen.turned_rad as f32 + 1e-6,
            azimuths: [low, high],
            elevations: sector.rows.span(),
            max_range_m: seen.sector.max_range_m,
            alpha_cut_log2: alpha_cut(profile).log2() as f32,
            sigmas: reach2(0.0, profile).max(0.0).sqrt() as f32,
            tint: seen.body.tint(),
        }
    }

    /// Whether a beam may meet a Gaussian of a cluster; `true` when in doubt.
    fn may_meet(&self, cluster: &Cluster) -> bool {
        let center = 0.5 * (cluster.min_m + cluster.max_m) - Vec3::from_array(self.middle_m);
        let half = 0.5 * (cluster.max_m - cluster.min_m);
        let range_m = center.length() + half.length();
        let reach_m = self.sigmas * cluster.sigma_m * (1.0 + 1e-4);
        let moved_m = Vec3::from_array(self.moved_m).length();
        let margin_m = reach_m + self.turned_rad * (range_m + reach_m + moved_m);
        let along = |axis: usize| {
            let row = Vec3::from_array(self.axes[axis]);
            [row.dot(center), row.abs().dot(half) + margin_m + self.moved_m[axis]]
        };
        let [x, half_x] = along(0);
        let [y, half_y] = along(1);
        let [z, half_z] = along(2);
        let far_x = x + half_x;
        let nearest_m = center.length() - half.length() - margin_m - moved_m;
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

impl Block {
    /// The block of a lane group; `None` if a beam meets none of its Gaussians.
    #[inline(always)]
    fn new<S: Simd>(simd: S, columns: &[Lanes], test: &ChunkTest) -> Option<Self> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let zero = splat(0.0);
        let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
        let visible = log2_opacity.simd_ge(splat(test.alpha_cut_log2));
        if visible.all_false() {
            return None;
        }
        // The half-size of the ellipsoid's box along each axis of the sector, as in the definition
        // of the reach.
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
        let most_moved_m = splat(Vec3::from_array(test.moved_m).length());
        let farthest_m = largest.mul_add(reach, range_m) + most_moved_m;
        let turned_m = farthest_m * splat(test.turned_rad);
        let [x, half_x] = along(simd, test, 0, mean, own, scale, reach, turned_m);
        let [y, half_y] = along(simd, test, 1, mean, own, scale, reach, turned_m);
        let [z, half_z] = along(simd, test, 2, mean, own, scale, reach, turned_m);
        // The farther of two lower bounds of its distance, from a sphere and from the box that
        // contain it. A road's Gaussians are so flat that the sphere is up to their length too
        // near.
        let sphere_m = range_m - largest * reach - most_moved_m;
        let beyond_box = Vec3x16 { x: x.abs() - half_x, y: y.abs() - half_y, z: z.abs() - half_z };
        let outside = beyond_box.max(zero);
        let nearest_m = sphere_m.max(outside.dot(outside).sqrt() * splat(1.0 - 1e-6));
        let far_x = x + half_x;
        let near_x = x - half_x;
        // Quotients of a box that reaches behind the LiDAR have no bound.
        let unbounded = near_x.simd_le(splat(1e-3));
        let divisor = near_x.max(splat(1e-3));
        let huge = splat(f32::MAX);
        let azimuth_low = unbounded.select(-huge, quotient(simd, y - half_y, far_x, divisor));
        let azimuth_high = unbounded.select(huge, quotient(simd, y + half_y, divisor, far_x));
        // Horizontal distances of the box. Behind the LiDAR nothing is seen, so that 0 is the
        // nearest.
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
        // Rows of the transposed rotation are its columns: the Gaussian's own axes.
        let per_m = |scale: f32x16<S>| splat(1.0) / scale.max(splat(THINNEST_M as f32));
        let a = own[0].scale(per_m(scale.x));
        let b = own[1].scale(per_m(scale.y));
        let c = own[2].scale(per_m(scale.z));
        let whiten = [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z];
        Some(Self {
            lanes,
            azimuths: [azimuth_low.to_array(), azimuth_high.to_array()],
            elevations: [elevation_low.to_array(), elevation_high.to_array()],
            nearest_m: nearest_m.to_array(),
            mean_m: [mean.x.to_array(), mean.y.to_array(), mean.z.to_array()],
            whiten: whiten.map(|values| values.to_array()),
            luminance: luminance(simd, columns, test.tint).to_array(),
        })
    }
}

/// The luminance of 16 Gaussians, as [`crate::lidar::luminance`] defines it.
#[inline(always)]
fn luminance<S: Simd>(simd: S, columns: &[Lanes], tint: [f32; 3]) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let mut sum = splat(0.0);
    for (channel, share) in LUMINANCE.into_iter().enumerate() {
        let sh = f32x16::load_array_ref(simd, &columns[column::SH + channel].0);
        let value = sh.mul_add(splat(sh::C0 as f32), splat(0.5)).max(splat(0.0));
        sum = value.mul_add(splat(share * tint[channel]), sum);
    }
    sum
}

/// The middle and the half-size of ellipsoids along an axis of the sector, in metres, with room for
/// the motion of the LiDAR.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "vectors in registers")]
fn along<S: Simd>(
    simd: S,
    test: &ChunkTest,
    axis: usize,
    mean: Vec3x16<S>,
    own: [Vec3x16<S>; 3],
    scale: Vec3x16<S>,
    reach: f32x16<S>,
    turned_m: f32x16<S>,
) -> [f32x16<S>; 2] {
    let row = Vec3x16::splat(simd, test.axes[axis]);
    let margin_m = turned_m + f32x16::splat(simd, test.moved_m[axis]);
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
