//! Stage project: 3D Gaussians become splats on the screens of all views, 16 at a time.
//!
//! Work is cut into units of (view, 16 clusters of one chunk), whose results keep the order
//! (view, global id) wherever they were computed.

use std::sync::{Mutex, PoisonError};

use fearless_simd::{Level, dispatch, f32x16, f64x8, i32x16, mask32x16, prelude::*};
use rayon::prelude::*;

use super::bent::{self, BentView};
use super::lanes::Vec3x16;
use super::optics::Optics;
use crate::Frame;
use crate::constants::{EXTENT_SLACK_PX, MAX_SIGMA_PX};
use crate::layout::{ChunkView, Cutoffs, Frustum, Splat};
use crate::unscented::UnscentedView;
use wildcity_scene::chunk::{CLUSTER, Cluster, LANES, Lanes, column};
use wildcity_scene::{Chunk, sh};

/// Clusters of a unit: 4096 Gaussians take some 100 µs, long enough to be worth handing out.
const UNIT_CLUSTERS: usize = 16;

/// Splats of a page.
const PAGE: usize = 1 << PAGE_BITS;
const PAGE_BITS: u32 = 8;

/// 12 KiB of splats. Units come and go as the ego moves; pages are handed from one to another, so
/// that memory follows the largest frame and not the largest of each unit.
type Page = Box<[Splat; PAGE]>;

/// All splats of a frame.
#[derive(Debug, Default)]
pub(super) struct Projected {
    /// Pages in order of (view, global id); the last of each unit may have room.
    pages: Vec<Page>,
    units: Vec<Unit>,
    free: Mutex<Vec<Page>>,
}

/// The splats of one view and 4096 Gaussians.
#[derive(Debug)]
pub(super) struct Unit {
    /// Whose screen.
    pub(super) view: usize,
    /// How many splats.
    pub(super) len: usize,
    /// The first of its pages.
    first_page: usize,
}

struct Job<'a> {
    view: usize,
    chunk: &'a Chunk,
    clusters: std::ops::Range<usize>,
    sight: Sight<'a>,
}

/// How a view sees a chunk.
#[derive(Clone, Copy)]
#[allow(clippy::large_enum_variant, reason = "nearly all are the large one")]
enum Sight<'a> {
    /// A pinhole at rest.
    Straight { chunk_view: ChunkView, frustum: Frustum },
    /// A lens, or a rolling shutter.
    Bent(BentView<'a>),
}

impl Projected {
    /// Projects every Gaussian of the scene into every view.
    pub(super) fn project(&mut self, level: Level, frame: &Frame<'_>, cutoffs: &Cutoffs) {
        let Self { pages, units, free } = self;
        let all_free = free.get_mut().unwrap_or_else(PoisonError::into_inner);
        all_free.append(pages);
        let bent: Vec<Option<(UnscentedView<'_>, Option<Optics>)>> = frame
            .views
            .iter()
            .map(|view| Some((UnscentedView::new(view, frame.profile)?, Optics::of(view))))
            .collect();
        let jobs: Vec<Job<'_>> = jobs(frame, &bent);
        let filled: Vec<(usize, Vec<Page>)> = jobs
            .par_iter()
            .map_init(Vec::new, |splats, job| {
                splats.clear();
                dispatch!(level, simd => project_unit(simd, job, cutoffs, splats));
                (splats.len(), into_pages(splats, free))
            })
            .collect();
        units.clear();
        for (job, (len, mut filled)) in jobs.iter().zip(filled) {
            units.push(Unit { view: job.view, len, first_page: pages.len() });
            pages.append(&mut filled);
        }
    }

    /// How many splats.
    pub(super) fn len(&self) -> usize {
        self.units.iter().map(|unit| unit.len).sum()
    }

    /// Places, of which the last ones of a unit may be empty.
    pub(super) fn places(&self) -> usize {
        self.pages.len() * PAGE
    }

    /// The units in order of (view, global id).
    pub(super) fn units(&self) -> &[Unit] {
        &self.units
    }

    /// Places and splats of one unit, in order of global ids.
    pub(super) fn unit(&self, unit: &Unit) -> impl Iterator<Item = (u32, &Splat)> {
        let first = (unit.first_page << PAGE_BITS) as u32;
        let pages = &self.pages[unit.first_page..];
        (first..).zip(pages.iter().flat_map(|page| page.iter()).take(unit.len))
    }

    /// The splat at a place.
    #[inline(always)]
    pub(super) fn splat(&self, place: u32) -> &Splat {
        &self.pages[(place >> PAGE_BITS) as usize][place as usize % PAGE]
    }
}

/// Copies splats to free pages, or new ones where there are none left.
fn into_pages(splats: &[Splat], free: &Mutex<Vec<Page>>) -> Vec<Page> {
    let wanted = splats.len().div_ceil(PAGE);
    let mut pages = {
        let mut free = free.lock().unwrap_or_else(PoisonError::into_inner);
        let kept = free.len().saturating_sub(wanted);
        free.split_off(kept)
    };
    pages.resize_with(wanted, || Box::new([Splat::default(); PAGE]));
    for (page, splats) in pages.iter_mut().zip(splats.chunks(PAGE)) {
        page[..splats.len()].copy_from_slice(splats);
    }
    pages
}

/// The units of a frame: chunks that a view cannot see cost one test.
fn jobs<'a>(
    frame: &Frame<'a>,
    bent: &'a [Option<(UnscentedView<'a>, Option<Optics>)>],
) -> Vec<Job<'a>> {
    let mut jobs = Vec::new();
    for (index, (view, bent)) in frame.views.iter().zip(bent).enumerate() {
        for chunk in &frame.scene.chunks {
            let sight = match bent {
                Some((bent, optics)) => {
                    Sight::Bent(BentView::new(view, chunk, bent, optics.as_ref()))
                }
                None => Sight::Straight {
                    chunk_view: ChunkView::new(view, chunk),
                    frustum: Frustum::new(view, chunk, frame.profile),
                },
            };
            jobs_of(index, sight, chunk, &mut jobs);
        }
    }
    jobs
}

impl Sight<'_> {
    #[inline(always)]
    fn may_see(&self, chunk: &Chunk, cluster: &Cluster) -> bool {
        let Cluster { min_m, max_m, sigma_m, .. } = *cluster;
        match self {
            Self::Straight { frustum, .. } => frustum.may_see(min_m, max_m, sigma_m),
            Self::Bent(view) => view.bent.may_see(chunk.origin_m(), min_m, max_m, sigma_m),
        }
    }
}

fn jobs_of<'a>(view: usize, sight: Sight<'a>, chunk: &'a Chunk, jobs: &mut Vec<Job<'a>>) {
    let visible = |clusters: &std::ops::Range<usize>| {
        let mut clusters = chunk.clusters()[clusters.clone()].iter();
        clusters.any(|cluster| sight.may_see(chunk, cluster))
    };
    let count = chunk.clusters().len();
    let ranges = (0..count).step_by(UNIT_CLUSTERS).map(|k| k..(k + UNIT_CLUSTERS).min(count));
    jobs.extend(ranges.filter(visible).map(|clusters| Job { view, chunk, clusters, sight }));
}

#[inline(always)]
fn project_unit<S: Simd>(simd: S, job: &Job<'_>, cutoffs: &Cutoffs, splats: &mut Vec<Splat>) {
    let blocks = job.chunk.len().div_ceil(LANES);
    for (k, cluster) in (job.clusters.clone()).zip(&job.chunk.clusters()[job.clusters.clone()]) {
        if !job.sight.may_see(job.chunk, cluster) {
            continue;
        }
        let first = k * CLUSTER / LANES;
        for block in first..(first + CLUSTER / LANES).min(blocks) {
            let columns = job.chunk.lane_group(block);
            let degree = job.chunk.sh_degree();
            let lanes = match &job.sight {
                Sight::Straight { chunk_view, .. } => {
                    project_block(simd, columns, degree, chunk_view, cutoffs)
                }
                Sight::Bent(view) => bent::project_block(simd, columns, degree, view, cutoffs),
            };
            if let Some(lanes) = lanes {
                lanes.append(splats);
            }
        }
    }
}

/// Sixteen splats as columns, and which of them are visible.
#[derive(Default)]
pub(super) struct SplatLanes {
    pub(super) visible: u64,
    pub(super) mean_x: [f32; LANES],
    pub(super) mean_y: [f32; LANES],
    pub(super) l0: [f32; LANES],
    pub(super) l1: [f32; LANES],
    pub(super) l2: [f32; LANES],
    pub(super) log2_opacity: [f32; LANES],
    pub(super) red: [f32; LANES],
    pub(super) green: [f32; LANES],
    pub(super) blue: [f32; LANES],
    pub(super) depth_m: [f32; LANES],
    pub(super) extent_x: [f32; LANES],
    pub(super) extent_y: [f32; LANES],
}

impl SplatLanes {
    /// Gives them their colours.
    #[inline(always)]
    pub(super) fn paint<S: Simd>(&mut self, rgb: Vec3x16<S>) {
        rgb.x.store_array(&mut self.red);
        rgb.y.store_array(&mut self.green);
        rgb.z.store_array(&mut self.blue);
    }

    #[inline(always)]
    fn append(&self, splats: &mut Vec<Splat>) {
        let mut visible = self.visible;
        while visible != 0 {
            let i = visible.trailing_zeros() as usize % LANES;
            visible &= visible - 1;
            splats.push(Splat {
                mean_px: [self.mean_x[i], self.mean_y[i]],
                factor: [self.l0[i], self.l1[i], self.l2[i]],
                log2_opacity: self.log2_opacity[i],
                rgb: [self.red[i], self.green[i], self.blue[i]],
                depth_m: self.depth_m[i],
                extent_px: [self.extent_x[i], self.extent_y[i]],
            });
        }
    }
}

/// Projects one block, or returns `None` if nothing of it can be seen.
#[inline(always)]
fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    view: &ChunkView,
    cutoffs: &Cutoffs,
) -> Option<SplatLanes> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let mean = Vec3x16::load(simd, columns, column::MEAN);
    let z = depth(simd, view, mean);
    let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
    let in_range = z.simd_ge(splat(cutoffs.near_m))
        & z.simd_le(splat(cutoffs.far_m))
        & log2_opacity.simd_ge(splat(cutoffs.log2_alpha_cut));
    if in_range.all_false() {
        return None;
    }

    let inverse_z = splat(1.0) / z;
    let slope_x = to_camera(simd, view, mean, 0) * inverse_z;
    let slope_y = to_camera(simd, view, mean, 1) * inverse_z;
    let mean_x = slope_x.mul_add(splat(view.focal_px[0]), splat(view.center_px[0]));
    let mean_y = slope_y.mul_add(splat(view.focal_px[1]), splat(view.center_px[1]));

    let own = rotation_columns(simd, columns);
    let scale = Vec3x16::load(simd, columns, column::SCALE);
    let v0 = root_row(simd, view, 0, slope_x, inverse_z, own).times(scale);
    let v1 = root_row(simd, view, 1, slope_y, inverse_z, own).times(scale);
    let ellipse = Ellipse::new(simd, v0, v1, cutoffs.blur_px2);
    let mut lanes =
        shown(simd, (mean_x, mean_y, z), log2_opacity, &ellipse, in_range, view.size_px, cutoffs);
    if lanes.visible == 0 {
        return None;
    }
    let toward = mean.minus(Vec3x16::splat(simd, view.camera_m));
    lanes.paint(color(simd, columns, sh_degree, toward));
    Some(lanes)
}

/// What an image shows of 16 splats, but for their colours.
#[inline(always)]
pub(super) fn shown<S: Simd>(
    simd: S,
    (mean_x, mean_y, depth_m): (f32x16<S>, f32x16<S>, f32x16<S>),
    mut log2_opacity: f32x16<S>,
    ellipse: &Ellipse<S>,
    in_range: mask32x16<S>,
    size_px: [f32; 2],
    cutoffs: &Cutoffs,
) -> SplatLanes {
    let splat = |value: f32| f32x16::splat(simd, value);
    if cutoffs.antialiased {
        // Yu et al. 2024 (Mip-Splatting): sqrt(det before / det), with gsplat's floor 0.005.
        let ratio = ellipse.det_share.max(splat(0.005 * 0.005));
        log2_opacity = splat(0.5).mul_add(log2(simd, ratio), log2_opacity);
    }
    // The box where alpha reaches the cut, against the image's pixel centres.
    let power = log2_opacity - splat(cutoffs.log2_alpha_cut);
    let reach = power.max(splat(0.0)).sqrt() / splat(LOG2_UNIT);
    let extent_x = reach.mul_add(ellipse.sigma_x, splat(EXTENT_SLACK_PX));
    let extent_y = reach.mul_add(ellipse.sigma_y, splat(EXTENT_SLACK_PX));
    let on_image = |mean: f32x16<S>, extent: f32x16<S>, size_px: f32| {
        (mean + extent).simd_ge(splat(0.5)) & (mean - extent).simd_le(splat(size_px - 0.5))
    };
    let visible = in_range
        & power.simd_ge(splat(0.0))
        & on_image(mean_x, extent_x, size_px[0])
        & on_image(mean_y, extent_y, size_px[1]);
    if visible.all_false() {
        return SplatLanes::default();
    }
    SplatLanes {
        visible: visible.to_bitmask(),
        mean_x: mean_x.to_array(),
        mean_y: mean_y.to_array(),
        l0: ellipse.l0.to_array(),
        l1: ellipse.l1.to_array(),
        l2: ellipse.l2.to_array(),
        log2_opacity: log2_opacity.to_array(),
        depth_m: depth_m.to_array(),
        extent_x: extent_x.to_array(),
        extent_y: extent_y.to_array(),
        ..SplatLanes::default()
    }
}

/// Camera-space z of centres, in metres: computed in f64 and rounded to f32 once.
///
/// Splats are blended in order of this number. Were it a sum of f32, thousands of surfels of one
/// facade would be blended in the order of their rounding errors.
#[inline(always)]
fn depth<S: Simd>(simd: S, view: &ChunkView, mean: Vec3x16<S>) -> f32x16<S> {
    let (low, high) = along(simd, mean, view.forward);
    low.narrow(high)
}

/// A row's product with (x, y, z, 1) in f64: one coordinate of centres in another frame, in metres, of the
/// first eight and of the others.
#[inline(always)]
pub(super) fn along<S: Simd>(simd: S, mean: Vec3x16<S>, row: [f64; 4]) -> (f64x8<S>, f64x8<S>) {
    let [rx, ry, rz, moved_m] = row.map(|value| f64x8::splat(simd, value));
    let (x, y, z) = (mean.x.widen(), mean.y.widen(), mean.z.widen());
    let low = x.0.mul_add(rx, y.0.mul_add(ry, z.0.mul_add(rz, moved_m)));
    let high = x.1.mul_add(rx, y.1.mul_add(ry, z.1.mul_add(rz, moved_m)));
    (low, high)
}

/// The camera-space x or y of centres, in metres.
#[inline(always)]
fn to_camera<S: Simd>(simd: S, view: &ChunkView, mean: Vec3x16<S>, axis: usize) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let [rx, ry, rz] = view.rotation[axis];
    let z = splat(rz).mul_add(mean.z, splat(view.translation_m[axis]));
    splat(rx).mul_add(mean.x, splat(ry).mul_add(mean.y, z))
}

/// A row of `J W R`, in px/m: how a pixel coordinate moves along each own axis, linearised at the
/// clamped slope.
#[inline(always)]
fn root_row<S: Simd>(
    simd: S,
    view: &ChunkView,
    axis: usize,
    slope: f32x16<S>,
    inverse_z: f32x16<S>,
    own: [Vec3x16<S>; 3],
) -> Vec3x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let clamped = slope.max(splat(view.slope_min[axis])).min(splat(view.slope_max[axis]));
    let forward = Vec3x16::splat(simd, view.rotation[2]);
    let jw = forward
        .mul_add(-clamped, Vec3x16::splat(simd, view.rotation[axis]))
        .scale(inverse_z * splat(view.focal_px[axis]));
    Vec3x16 { x: jw.dot(own[0]), y: jw.dot(own[1]), z: jw.dot(own[2]) }
}

/// `√(log2(e)/2)`: what turns standard deviations into the unit of [`Splat::factor`].
pub(super) const LOG2_UNIT: f32 = 0.849_321_8;

/// Screen ellipses, by their factor.
pub(super) struct Ellipse<S: Simd> {
    l0: f32x16<S>,
    l1: f32x16<S>,
    l2: f32x16<S>,
    /// Standard deviation along x, in pixels.
    sigma_x: f32x16<S>,
    /// Standard deviation along y, in pixels.
    sigma_y: f32x16<S>,
    /// Determinant before the blur as a share of the one after.
    det_share: f32x16<S>,
}

impl<S: Simd> Ellipse<S> {
    /// From the rows of `V = J W R S`, a square root of the screen covariance before the blur.
    ///
    /// `Σ′ = V Vᵀ + blur I` (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5). With the minors `m` of
    /// `V`, `det Σ′ = |m|² + blur |V|² + blur²` is a sum of positives: exact to rounding for needles
    /// whose `ac - b²` cancels to nothing. It is of fourth order, so whatever is wider than
    /// [`MAX_SIGMA_PX`] is computed in a larger unit than the pixel.
    #[inline(always)]
    fn new(simd: S, v0: Vec3x16<S>, v1: Vec3x16<S>, blur_px2: f32) -> Self {
        let splat = |value: f32| f32x16::splat(simd, value);
        let widest = v0.max_abs().max(v1.max_abs()).max(splat(1e-30));
        let per_px = (splat(MAX_SIGMA_PX) / widest).min(splat(1.0));
        let px = splat(1.0) / per_px;
        let (v0, v1) = (v0.scale(per_px), v1.scale(per_px));
        let blur = splat(blur_px2) * per_px * per_px;

        let minors = v0.cross(v1);
        let moments = [v0.dot(v0), v1.dot(v1), v0.dot(v1)];
        let unit = splat(LOG2_UNIT) * per_px;
        let ellipse = Self::of_moments(moments, minors.dot(minors), blur, unit);
        Self { sigma_x: ellipse.sigma_x * px, sigma_y: ellipse.sigma_y * px, ..ellipse }
    }

    /// From the covariance before the blur, `[xx, yy, xy]`, and its determinant.
    #[inline(always)]
    pub(super) fn of_moments(
        [xx, yy, b]: [f32x16<S>; 3],
        det_before: f32x16<S>,
        blur: f32x16<S>,
        unit: f32x16<S>,
    ) -> Self {
        let det = blur.mul_add(xx + yy + blur, det_before);
        // q(dx, dy) = (c dx - b dy)²/(c det) + dy²/c; times log2(e)/2 it is a power of two.
        let (sigma_x, sigma_y) = ((xx + blur).sqrt(), (yy + blur).sqrt());
        let l2 = unit / sigma_y;
        let root_det = det.sqrt();
        Self {
            l0: unit * sigma_y / root_det,
            l1: -(b * l2) / root_det,
            l2,
            sigma_x,
            sigma_y,
            det_share: det_before / det,
        }
    }
}

/// Columns of the rotation matrices of a block's unit quaternions: the own axes in the world.
#[inline(always)]
pub(super) fn rotation_columns<S: Simd>(simd: S, columns: &[Lanes]) -> [Vec3x16<S>; 3] {
    let one = f32x16::splat(simd, 1.0);
    let w = f32x16::load_array_ref(simd, &columns[column::QUAT].0);
    let Vec3x16 { x, y, z } = Vec3x16::load(simd, columns, column::QUAT + 1);
    let (x2, y2, z2) = (x + x, y + y, z + z);
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    [
        Vec3x16 { x: one - yy - zz, y: xy + wz, z: xz - wy },
        Vec3x16 { x: xy - wz, y: one - xx - zz, z: yz + wx },
        Vec3x16 { x: xz + wy, y: yz - wx, z: one - xx - yy },
    ]
}

/// `max(0, SH(direction) + 0.5)` along `toward`, which need not be unit.
#[inline(always)]
pub(super) fn color<S: Simd>(
    simd: S,
    columns: &[Lanes],
    degree: u8,
    toward: Vec3x16<S>,
) -> Vec3x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let half = Vec3x16 { x: splat(0.5), y: splat(0.5), z: splat(0.5) };
    let mut rgb = Vec3x16::load(simd, columns, column::SH).mul_add(splat(sh::C0), half);
    let mut add = |k: usize, basis: f32x16<S>| {
        rgb = Vec3x16::load(simd, columns, column::SH + 3 * k).mul_add(basis, rgb);
    };
    if degree > 0 {
        let length = toward.dot(toward).max(splat(1e-30)).sqrt();
        let Vec3x16 { x, y, z } = toward.scale(splat(1.0) / length);
        add(1, splat(-sh::C1) * y);
        add(2, splat(sh::C1) * z);
        add(3, splat(-sh::C1) * x);
        if degree > 1 {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            let (xy, yz, xz) = (x * y, y * z, x * z);
            add(4, splat(sh::C2[0]) * xy);
            add(5, splat(sh::C2[1]) * yz);
            add(6, splat(sh::C2[2]) * (zz + zz - xx - yy));
            add(7, splat(sh::C2[3]) * xz);
            add(8, splat(sh::C2[4]) * (xx - yy));
            if degree > 2 {
                let (three, four) = (splat(3.0), splat(4.0));
                add(9, splat(sh::C3[0]) * y * (three * xx - yy));
                add(10, splat(sh::C3[1]) * xy * z);
                add(11, splat(sh::C3[2]) * y * (four * zz - xx - yy));
                add(12, splat(sh::C3[3]) * z * (zz + zz - three * (xx + yy)));
                add(13, splat(sh::C3[4]) * x * (four * zz - xx - yy));
                add(14, splat(sh::C3[5]) * z * (xx - yy));
                add(15, splat(sh::C3[6]) * x * (xx - three * yy));
            }
        }
    }
    rgb.max(splat(0.0))
}

/// Base-2 logarithm of positive normal numbers, within 2e-7: the exponent, and the series of
/// `2 atanh(t) log2(e)` for the mantissa in [√½, √2), where `|t| <= 0.172`.
#[inline(always)]
fn log2<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let bits: i32x16<S> = x.bitcast();
    // The bits of √½, so that the exponent rounds at √2.
    let shifted = bits - 0x3F35_04F3_i32;
    let exponent = shifted >> 23;
    let mantissa: f32x16<S> = (bits - (exponent << 23)).bitcast();
    let t = (mantissa - splat(1.0)) / (mantissa + splat(1.0));
    let tt = t * t;
    let series = tt
        .mul_add(splat(2.0 / 9.0), splat(2.0 / 7.0))
        .mul_add(tt, splat(2.0 / 5.0))
        .mul_add(tt, splat(2.0 / 3.0))
        .mul_add(tt, splat(2.0));
    let exponent: f32x16<S> = exponent.to_float();
    (t * series).mul_add(splat(std::f64::consts::LOG2_E), exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log2_is_within_two_units_of_f32() {
        for i in 0..2_000 {
            // From 2.5e-5, the square of the antialiasing floor, to 1; and around the seam at √½.
            for x in [0.99_f32.powi(i).max(2.5e-5), 0.707 + 1e-7 * i as f32] {
                let log = dispatch!(Level::new(), simd => {
                    log2(simd, f32x16::splat(simd, x)).to_array()[0]
                });
                let error = f64::from(log) - f64::from(x).log2();
                assert!(error.abs() < 2e-7 * f64::from(log).abs().max(1.0), "log2({x}) is {log}");
            }
        }
    }
}
