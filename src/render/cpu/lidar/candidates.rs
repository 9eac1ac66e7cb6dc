//! The Gaussians that a beam of a sector may meet.
//!
//! A Gaussian ends where its alpha falls below the cut: an ellipsoid. Its box in the sector's axes
//! contains it, and the tangents of the azimuths and elevations of a box are quotients of its
//! coordinates. No angle has to be computed, and no bound is linearised.
//!
//! Clusters are searched from the nearest, and beams are compared with what was found whenever it
//! is a batch. So on the cpu, beams have returned from the fronts of houses before what is behind
//! them is searched: most of it is never read. A device compares after the search, and beams are
//! followed to the LiDAR's range meanwhile.

use fearless_simd::{Level, dispatch, f32x16, prelude::*};
use glam::{Vec2, Vec3};

use super::sector::{BodySector, Sector, TileColumns};
use crate::cpu::lanes::Vec3x16;
use crate::cpu::project::axes::rotation_columns;
use crate::lidar::{ChunksOfBody, LUMINANCE, THINNEST_M, Task, alpha_cut, reach2};
use wildcity_scene::chunk::{CLUSTER, Cluster, LANES, Lanes, column};
use wildcity_scene::{Chunk, RenderProfile, sh};

/// A Gaussian that beams of a sector may meet, in the axes of its body.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Candidate {
    /// Its centre relative to the LiDAR's middle position in the sector, in metres.
    pub(crate) mean_m: [f32; 3],
    /// The matrix that takes vectors in metres to standard deviations, row by row.
    pub(crate) whiten: [f32; 9],
    pub(crate) log2_opacity: f32,
    /// Squared standard deviations from its centre at which alpha falls below the cut.
    pub(crate) reach2: f32,
    pub(crate) luminance: f32,
    /// Its place among all Gaussians of the scene.
    pub(crate) key: u32,
}

/// The beams that may meet something.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Reach {
    /// None meets it nearer than this, in metres.
    pub(crate) nearest_m: f32,
    /// Their first row, and the one after the last.
    pub(crate) rows: [u16; 2],
    /// A bit for each tile along a row.
    tiles: u16,
    /// The bucket of the distance to its middle.
    bucket: u16,
}

/// Candidates of one body in a sector that have not been compared with beams yet.
#[derive(Default)]
pub(crate) struct Candidates {
    pub(crate) list: Vec<Candidate>,
    /// The beams that may meet each.
    pub(crate) reaches: Vec<Reach>,
    /// Places in the list of the candidates of each tile, almost from the nearest. Tile after tile
    /// of the first 16 rows, then those of the next.
    pub(crate) lists: Vec<Vec<u32>>,
    /// How far the beams of each tile are followed, in metres: what is beyond is no candidate of
    /// it. It becomes less where beams return.
    pub(crate) ends_m: Vec<f32>,
    clusters: Vec<SeenCluster>,
    /// Memory to sort them.
    buckets: Vec<u32>,
    places: Vec<u32>,
}

/// What is searched for candidates.
#[derive(Clone, Copy)]
pub(super) struct Search<'a> {
    pub(super) level: Level,
    pub(super) seen: &'a BodySector<'a>,
    pub(super) chunks: &'a ChunksOfBody<'a>,
    pub(super) task: &'a Task<'a>,
    /// Candidates after which beams are compared with them.
    pub(super) batch: usize,
}

/// Most clusters that are sorted at once, which bounds their memory.
pub(super) const MOST_CLUSTERS: usize = 1 << 15;

/// A cluster of which beams may meet a Gaussian.
#[derive(Clone, Copy)]
pub(super) struct SeenCluster {
    reach: Reach,
    /// Its chunk's place among those of the body.
    chunk: u32,
    /// Its number in the chunk.
    cluster: u32,
}

/// A cluster of a chunk.
#[derive(Clone, Copy)]
struct ClusterOfChunk<'a> {
    chunk: &'a Chunk,
    /// Key of the chunk's first Gaussian.
    first_key: u32,
    /// Number of the cluster in the chunk.
    cluster: usize,
}

/// Where beams may meet something: it is within these bounds, in the axes of a sector.
#[derive(Clone, Copy)]
struct Span {
    /// Smallest and largest tangent of the azimuths.
    azimuths: [f32; 2],
    /// Smallest and largest tangent of the elevations.
    elevations: [f32; 2],
    nearest_m: f32,
    middle_m: f32,
}

/// What the tests of one chunk in one sector share.
struct ChunkTest<'a> {
    body: &'a BodyTest,
    /// The LiDAR's middle position relative to the chunk's origin, in the body's axes, in metres.
    middle_m: [f32; 3],
}

/// What the tests of all chunks of a body in one sector share.
struct BodyTest {
    /// Rows of `sector_from_body`, in f32.
    axes: [[f32; 3]; 3],
    /// The most that the LiDAR moves along each axis of the sector, in metres.
    moved_m: [f32; 3],
    turned_rad: f32,
    /// Tangents of the azimuths of all beams: smallest, largest.
    azimuths: [f32; 2],
    /// Directions that are horizontal in the sector's axes and at right angles to its sides, away
    /// from it: x and y, of length 1 at most.
    beside: [[f32; 2]; 2],
    /// Tangents of the elevations of all beams: smallest, largest.
    elevations: [f32; 2],
    max_range_m: f32,
    alpha_cut_log2: f32,
    /// Standard deviations at which an opaque Gaussian ends.
    sigmas: f32,
    /// Factors of the body's colours.
    tint: [f32; 3],
}

/// Where beams may meet 16 Gaussians.
struct Bounds<S: Simd> {
    /// The lanes that a beam may meet.
    lanes: u64,
    /// Their centres relative to the LiDAR's middle position in the sector, in metres.
    mean: Vec3x16<S>,
    /// Unit vectors along their principal axes, in the axes of their body.
    own: [Vec3x16<S>; 3],
    scale: Vec3x16<S>,
    azimuths: [[f32; LANES]; 2],
    elevations: [[f32; LANES]; 2],
    nearest_m: [f32; LANES],
    middle_m: [f32; LANES],
}

/// What beams are compared with. Fields of one lane are those of a [`Candidate`].
struct Shapes {
    mean_m: [[f32; LANES]; 3],
    whiten: [[f32; LANES]; 9],
    reach2: [f32; LANES],
    luminance: [f32; LANES],
}

impl Candidates {
    /// Forgets what beams were compared with, and follows all of them to the LiDAR's range.
    pub(super) fn begin(&mut self, sector: &Sector, rows: usize) {
        let tiles = sector.tiles.len() * rows.div_ceil(LANES);
        self.ends_m.clear();
        self.ends_m.resize(tiles, sector.max_range_m);
        self.lists.resize(tiles, Vec::new());
    }

    /// Finds the Gaussians of a body that beams of the sector may meet, and calls `compare` with
    /// them whenever there are as many as a batch.
    pub(super) fn find(&mut self, search: &Search<'_>, mut compare: impl FnMut(&mut Self)) {
        let Search { seen, task, .. } = *search;
        let body = BodyTest::new(seen, task.profile);
        let mut clusters = std::mem::take(&mut self.clusters);
        for (place, (_, _, chunk)) in search.chunks.iter().enumerate() {
            let test = body.chunk(seen, chunk);
            for (cluster, bounds) in chunk.clusters().iter().enumerate() {
                let Some(span) = test.span(bounds) else { continue };
                let overlaps = |columns: &TileColumns| columns.overlap(span.azimuths);
                let Some(reach) = self.reach(seen.sector, &span, overlaps) else { continue };
                // A body has fewer than 2^32 Gaussians.
                clusters.push(SeenCluster { reach, chunk: place as u32, cluster: cluster as u32 });
                if clusters.len() == MOST_CLUSTERS {
                    self.add_clusters(search, &body, &mut clusters, &mut compare);
                }
            }
        }
        self.add_clusters(search, &body, &mut clusters, &mut compare);
        self.compare(seen.sector, &mut compare);
        self.clusters = clusters;
    }

    /// Adds the Gaussians of clusters that beams of the sector may meet, from the nearest cluster.
    fn add_clusters(
        &mut self,
        search: &Search<'_>,
        body: &BodyTest,
        clusters: &mut Vec<SeenCluster>,
        compare: &mut impl FnMut(&mut Self),
    ) {
        let sector = search.seen.sector;
        // Equally near clusters go by their places, so that an unstable sort has one result.
        clusters.sort_unstable_by(|a, b| {
            let by_place = || (a.chunk, a.cluster).cmp(&(b.chunk, b.cluster));
            a.reach.nearest_m.total_cmp(&b.reach.nearest_m).then_with(by_place)
        });
        for SeenCluster { reach, chunk, cluster } in clusters.drain(..) {
            // Beams may have returned nearer since the cluster was found.
            if !self.is_followed(&reach, sector.tiles.len()) {
                continue;
            }
            let (number, _, chunk) = search.chunks[chunk as usize];
            let test = body.chunk(search.seen, chunk);
            let first_key = search.task.keys.first(number);
            let part = ClusterOfChunk { chunk, first_key, cluster: cluster as usize };
            dispatch!(search.level, simd => self.add(simd, sector, &part, &test));
            if self.list.len() >= search.batch {
                self.compare(sector, compare);
            }
        }
    }

    /// Compares beams with what was found, and forgets it.
    fn compare(&mut self, sector: &Sector, compare: &mut impl FnMut(&mut Self)) {
        if self.list.is_empty() {
            return;
        }
        self.list_by_tile(sector.tiles.len());
        compare(self);
        self.list.clear();
        self.reaches.clear();
    }

    /// Adds the Gaussians of a cluster that beams of the sector may meet.
    #[inline(always)]
    fn add<S: Simd>(
        &mut self,
        simd: S,
        sector: &Sector,
        part: &ClusterOfChunk<'_>,
        test: &ChunkTest<'_>,
    ) {
        let ClusterOfChunk { chunk, first_key, cluster } = *part;
        let first = cluster * CLUSTER / LANES;
        let groups = chunk.len().div_ceil(LANES);
        for group in first..(first + CLUSTER / LANES).min(groups) {
            let columns = chunk.lane_group(group);
            let Some(bounds) = Bounds::new(simd, columns, test) else { continue };
            let mut found = [(0, Reach::default()); LANES];
            let mut count = 0;
            let mut lanes = bounds.lanes;
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % LANES;
                lanes &= lanes - 1;
                let span = bounds.span(lane);
                let see = |columns: &TileColumns| columns.see(simd, span.azimuths);
                if let Some(reach) = self.reach(sector, &span, see) {
                    found[count] = (lane, reach);
                    count += 1;
                }
            }
            if count == 0 {
                continue;
            }
            let shapes = Shapes::new(simd, columns, &bounds, test.body);
            for (lane, reach) in &found[..count] {
                let lane = *lane;
                self.list.push(Candidate {
                    mean_m: shapes.mean_m.each_ref().map(|values| values[lane]),
                    whiten: shapes.whiten.each_ref().map(|values| values[lane]),
                    log2_opacity: columns[column::LOG2_OPACITY].0[lane],
                    reach2: shapes.reach2[lane],
                    luminance: shapes.luminance[lane],
                    key: first_key + (group * LANES + lane) as u32,
                });
                self.reaches.push(*reach);
            }
        }
    }

    /// The beams that may meet what is within bounds, in the tiles along a row that `see` it;
    /// `None` if there is none.
    #[inline(always)]
    fn reach(
        &self,
        sector: &Sector,
        span: &Span,
        see: impl Fn(&TileColumns) -> bool,
    ) -> Option<Reach> {
        let [low, high] = span.elevations;
        let rows = sector.rows.between(low, high);
        // It lies between two rows, and no beam meets it.
        if rows.is_empty() {
            return None;
        }
        let mut reach = Reach {
            nearest_m: span.nearest_m,
            // A LiDAR has at most 256 rows.
            rows: [rows.start as u16, rows.end as u16],
            tiles: 0,
            bucket: bucket(span.middle_m),
        };
        for (tile, columns) in sector.tiles.iter().enumerate() {
            if see(columns) {
                reach.tiles |= 1 << tile;
            }
        }
        self.is_followed(&reach, sector.tiles.len()).then_some(reach)
    }

    /// Whether a beam is followed far enough to meet it; a row has so many tiles.
    #[inline(always)]
    fn is_followed(&self, reach: &Reach, tiles: usize) -> bool {
        let mut lists = reach.lists(tiles);
        lists.any(|list| self.ends_m[list] >= reach.nearest_m)
    }

    /// Lists the candidates of each tile, from the nearest middle: hits are then found almost in
    /// order.
    fn list_by_tile(&mut self, tiles: usize) {
        // A counting sort by their buckets.
        self.buckets.clear();
        self.buckets.resize(BUCKETS + 1, 0);
        for reach in &self.reaches {
            // Counted one place further, so that the sums are the places at which buckets begin.
            self.buckets[usize::from(reach.bucket) + 1] += 1;
        }
        let mut sum = 0;
        for count in &mut self.buckets {
            sum += *count;
            *count = sum;
        }
        self.places.clear();
        self.places.resize(self.reaches.len(), 0);
        for (at, reach) in self.reaches.iter().enumerate() {
            let next = &mut self.buckets[usize::from(reach.bucket)];
            self.places[*next as usize] = at as u32;
            *next += 1;
        }
        self.lists.iter_mut().for_each(Vec::clear);
        for at in &self.places {
            let reach = &self.reaches[*at as usize];
            for list in reach.lists(tiles) {
                if self.ends_m[list] >= reach.nearest_m {
                    self.lists[list].push(*at);
                }
            }
        }
    }
}

impl Reach {
    /// The lists of its tiles, of which a row has `count`.
    #[inline(always)]
    fn lists(&self, count: usize) -> impl Iterator<Item = usize> {
        let [first, end] = self.rows.map(usize::from);
        let tiles = self.tiles;
        let seen = (0..count).filter(move |tile| tiles >> tile & 1 == 1);
        seen.flat_map(move |tile| {
            (first / LANES..end.div_ceil(LANES)).map(move |row| row * count + tile)
        })
    }
}

/// Buckets of distances: 64 for each doubling from [`FIRST_BUCKET`], and one for what is nearer.
const BUCKETS: usize = 1024;
/// Bits of an f32 that differ within a bucket.
const BUCKET_BITS: u32 = 17;
/// The other bits of the least distance of the second bucket, 0.25 m.
const FIRST_BUCKET: u32 = 0.25_f32.to_bits() >> BUCKET_BITS;

/// The bucket of a distance. Positive f32 have the order of their bits.
fn bucket(distance_m: f32) -> u16 {
    let bits = distance_m.to_bits() >> BUCKET_BITS;
    bits.saturating_sub(FIRST_BUCKET - 1).min(BUCKETS as u32 - 1) as u16
}

impl BodyTest {
    fn new(seen: &BodySector<'_>, profile: &RenderProfile) -> Self {
        let sector = seen.sector;
        let rows = seen.sector_from_body.transpose().to_cols_array_2d();
        let spans = sector.tiles.iter().map(|tile| tile.span);
        let low = spans.clone().map(|span| span[0]).fold(f32::INFINITY, f32::min);
        let high = spans.map(|span| span[1]).fold(f32::NEG_INFINITY, f32::max);
        Self {
            axes: rows.map(|row| row.map(|value| value as f32)),
            // A millimetre covers the rounding of f32 at a kilometre.
            moved_m: (seen.moved_m.as_vec3() + 1e-3).to_array(),
            turned_rad: seen.turned_rad as f32 + 1e-6,
            azimuths: [low, high],
            // Shorter than 1 by more than rounding.
            beside: [[low, -1.0], [-high, 1.0]]
                .map(|side| (Vec2::from(side).normalize() * (1.0 - 1e-5)).to_array()),
            elevations: sector.rows.span(),
            max_range_m: seen.sector.max_range_m,
            alpha_cut_log2: alpha_cut(profile).log2() as f32,
            sigmas: reach2(0.0, profile).max(0.0).sqrt() as f32,
            tint: seen.body.tint(),
        }
    }

    fn chunk(&self, seen: &BodySector<'_>, chunk: &Chunk) -> ChunkTest<'_> {
        let middle_m = -seen.relative_to_middle(chunk.origin_m());
        ChunkTest { body: self, middle_m: middle_m.as_vec3().to_array() }
    }

    /// The squared standard deviations at which 16 Gaussians end, as [`crate::lidar::reach2`]
    /// defines it.
    #[inline(always)]
    fn reach2<S: Simd>(&self, simd: S, log2_opacity: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let above_cut = log2_opacity.min(splat(0.0)) - splat(self.alpha_cut_log2);
        above_cut * splat(2.0 * std::f32::consts::LN_2)
    }
}

impl ChunkTest<'_> {
    /// Where beams may meet the Gaussians of a cluster; `None` if none meets any.
    fn span(&self, cluster: &Cluster) -> Option<Span> {
        let center = 0.5 * (cluster.min_m + cluster.max_m) - Vec3::from_array(self.middle_m);
        let half = 0.5 * (cluster.max_m - cluster.min_m);
        let range_m = center.length() + half.length();
        let reach_m = self.body.sigmas * cluster.sigma_m * (1.0 + 1e-4);
        let moved_m = Vec3::from_array(self.body.moved_m).length();
        let margin_m = reach_m + self.body.turned_rad * (range_m + reach_m + moved_m);
        let along = |axis: usize| {
            let row = Vec3::from_array(self.body.axes[axis]);
            [row.dot(center), row.abs().dot(half) + margin_m + self.body.moved_m[axis]]
        };
        let [x, half_x] = along(0);
        let [y, half_y] = along(1);
        let [z, half_z] = along(2);
        let far_x = x + half_x;
        let near_x = x - half_x;
        let nearest_m = center.length() - half.length() - margin_m - moved_m;
        if far_x < 0.0 || nearest_m > self.body.max_range_m {
            return None;
        }
        let quotient = |edge: f32, positive: f32, negative: f32| {
            edge / if edge > 0.0 { positive } else { negative }
        };
        // As for single Gaussians: see `Bounds::new`.
        let azimuths = if near_x > 1e-3 {
            [quotient(y - half_y, far_x, near_x), quotient(y + half_y, near_x, far_x)]
        } else {
            [-f32::MAX, f32::MAX]
        };
        let near_m = near_x.max(0.0).hypot((y.abs() - half_y).max(0.0)).max(1e-9);
        let far_m = far_x.hypot(y.abs() + half_y).max(1e-9);
        let elevations = [quotient(z - half_z, far_m, near_m), quotient(z + half_z, near_m, far_m)];
        Some(Span { azimuths, elevations, nearest_m, middle_m: center.length() })
    }
}

impl<S: Simd> Bounds<S> {
    /// The bounds of a lane group; `None` if a beam meets none of its Gaussians.
    #[inline(always)]
    fn new(simd: S, columns: &[Lanes], test: &ChunkTest<'_>) -> Option<Self> {
        let body = test.body;
        let splat = |value: f32| f32x16::splat(simd, value);
        let zero = splat(0.0);
        let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
        let visible = log2_opacity.simd_ge(splat(body.alpha_cut_log2));
        if visible.all_false() {
            return None;
        }
        // The half-size of the ellipsoid's box along each axis of the sector, as in the definition
        // of the reach.
        let reach = body.reach2(simd, log2_opacity).max(zero).sqrt() * splat(1.0 + 1e-4);
        let mean =
            Vec3x16::load(simd, columns, column::MEAN).minus(Vec3x16::splat(simd, test.middle_m));
        let range_m = mean.dot(mean).sqrt();
        let scale = Vec3x16::load(simd, columns, column::SCALE);
        // A point of the ellipsoid moves by the turn times its own distance.
        let largest = scale.x.max(scale.y).max(scale.z);
        let most_moved_m = splat(Vec3::from_array(body.moved_m).length());
        let farthest_m = largest.mul_add(reach, range_m) + most_moved_m;
        let turned_m = farthest_m * splat(body.turned_rad);
        // Most lie beside the sector, even as spheres: those need no axes of their own.
        let sphere_m = largest.mul_add(reach, turned_m + most_moved_m);
        let is_beside = |[x, y]: [f32; 2]| {
            let normal = Vec3::from_array(body.axes[0]) * x + Vec3::from_array(body.axes[1]) * y;
            Vec3x16::splat(simd, normal.to_array()).dot(mean).simd_gt(sphere_m)
        };
        let visible = visible & !(is_beside(body.beside[0]) | is_beside(body.beside[1]));
        if visible.all_false() {
            return None;
        }
        let own = rotation_columns(simd, columns);
        let [x, half_x] = along(simd, body, 0, mean, own, scale, reach, turned_m);
        let [y, half_y] = along(simd, body, 1, mean, own, scale, reach, turned_m);
        let [z, half_z] = along(simd, body, 2, mean, own, scale, reach, turned_m);
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
        // The least tangent: a positive edge over the far side, a negative one over the near side.
        // The largest is the other way round.
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
            & nearest_m.simd_le(splat(body.max_range_m))
            & azimuth_low.simd_le(splat(body.azimuths[1]))
            & azimuth_high.simd_ge(splat(body.azimuths[0]))
            & elevation_low.simd_le(splat(body.elevations[1]))
            & elevation_high.simd_ge(splat(body.elevations[0]));
        let lanes = meets.to_bitmask();
        if lanes == 0 {
            return None;
        }
        Some(Self {
            lanes,
            mean,
            own,
            scale,
            azimuths: [azimuth_low.to_array(), azimuth_high.to_array()],
            elevations: [elevation_low.to_array(), elevation_high.to_array()],
            nearest_m: nearest_m.to_array(),
            middle_m: range_m.to_array(),
        })
    }
}

impl<S: Simd> Bounds<S> {
    #[inline(always)]
    fn span(&self, lane: usize) -> Span {
        Span {
            azimuths: self.azimuths.each_ref().map(|tangents| tangents[lane]),
            elevations: self.elevations.each_ref().map(|tangents| tangents[lane]),
            nearest_m: self.nearest_m[lane],
            middle_m: self.middle_m[lane],
        }
    }
}

impl Shapes {
    #[inline(always)]
    fn new<S: Simd>(simd: S, columns: &[Lanes], bounds: &Bounds<S>, body: &BodyTest) -> Self {
        let Bounds { mean, own, scale, .. } = bounds;
        // Rows of the transposed rotation are its columns: the Gaussian's own axes.
        let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
        let one = f32x16::splat(simd, 1.0);
        let per_m = |scale: f32x16<S>| one / scale.max(f32x16::splat(simd, THINNEST_M as f32));
        let a = own[0].scale(per_m(scale.x));
        let b = own[1].scale(per_m(scale.y));
        let c = own[2].scale(per_m(scale.z));
        let whiten = [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z];
        Self {
            mean_m: [mean.x.to_array(), mean.y.to_array(), mean.z.to_array()],
            whiten: whiten.map(|values| values.to_array()),
            reach2: body.reach2(simd, log2_opacity).to_array(),
            luminance: luminance(simd, columns, body.tint).to_array(),
        }
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
    body: &BodyTest,
    axis: usize,
    mean: Vec3x16<S>,
    own: [Vec3x16<S>; 3],
    scale: Vec3x16<S>,
    reach: f32x16<S>,
    turned_m: f32x16<S>,
) -> [f32x16<S>; 2] {
    let row = Vec3x16::splat(simd, body.axes[axis]);
    let margin_m = turned_m + f32x16::splat(simd, body.moved_m[axis]);
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

#[cfg(test)]
mod tests {
    use super::*;

    fn reach(nearest_m: f32, rows: [u16; 2], tiles: u16, middle_m: f32) -> Reach {
        Reach { nearest_m, rows, tiles, bucket: bucket(middle_m) }
    }

    #[test]
    fn tiles_list_what_begins_before_their_ends() {
        // Two tiles along a row, and two rows of tiles.
        let reaches = vec![
            reach(9.9, [0, 16], 0b11, 12.0),
            reach(10.0, [0, 17], 0b01, 11.0),
            reach(10.001, [0, 32], 0b11, 10.5),
            reach(1.0, [16, 32], 0b10, 5.0),
        ];
        let found = Candidates {
            reaches,
            lists: vec![Vec::new(); 4],
            ends_m: vec![10.0, 10.0, 20.0, 0.5],
            ..Candidates::default()
        };
        let follows: Vec<bool> =
            found.reaches.iter().map(|reach| found.is_followed(reach, 2)).collect();
        assert_eq!(follows, [true, true, true, false]);
        let mut listed = found;
        listed.list_by_tile(2);
        assert_eq!(listed.lists, [vec![1, 0], vec![0], vec![2, 1], vec![]]);
    }

    #[test]
    fn buckets_rise_with_distances() {
        let distances = [0.0, 1e-9, 0.2, 0.26, 1.0, 1.02, 7.0, 100.0, 3e3, f32::MAX];
        let found = distances.map(bucket);
        assert!(found.is_sorted(), "{found:?}");
        assert_eq!(found[..3], [0; 3]);
        assert!(found[3] < found[4] && found[4] < found[5] && found[7] < found[8]);
        assert!(usize::from(found[9]) < BUCKETS);
    }
}
