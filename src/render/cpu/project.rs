//! Stage project: 3D Gaussians become splats on the screens of all views, 16 at a time.
//!
//! Work is cut into units of (view, 16 clusters of one chunk), whose results keep the order
//! (view, global id) wherever they were computed.

use fearless_simd::{Level, dispatch, f32x16, mask32x16, prelude::*};
use rayon::prelude::*;

use crate::render::constants::{DEPTH_BITS, EXTENT_SLACK_PX, MAX_SIGMA_PX};
use crate::render::layout::{ChunkView, Cutoffs, Frustum, Splat};
use crate::render::{Frame, View};
use crate::scene::chunk::{CLUSTER, LANES, Lanes, column};
use crate::scene::{Chunk, RenderProfile, sh};

/// Clusters of a unit: 4096 Gaussians, so that 12 bits name a splat within its unit.
const UNIT_CLUSTERS: usize = 16;
const UNIT_BITS: u32 = (UNIT_CLUSTERS * CLUSTER).ilog2();

/// All splats of a frame.
#[derive(Debug, Default)]
pub(super) struct Projected {
    units: Vec<Unit>,
    used: usize,
}

/// The splats of one view and 4096 Gaussians.
#[derive(Debug, Default)]
pub(super) struct Unit {
    /// In order of global ids.
    splats: Vec<Splat>,
    /// Sort keys of the splats.
    pub(super) keys: Vec<u64>,
}

struct Job<'a> {
    view: usize,
    chunk: &'a Chunk,
    clusters: std::ops::Range<usize>,
    chunk_view: ChunkView,
    frustum: Frustum,
}

impl Projected {
    /// Projects every Gaussian of the scene into every view.
    pub(super) fn project(&mut self, level: Level, frame: &Frame<'_>, cutoffs: &Cutoffs) {
        let jobs: Vec<Job<'_>> = jobs(frame);
        if self.units.len() < jobs.len() {
            self.units.resize_with(jobs.len(), Unit::default);
        }
        self.used = jobs.len();
        let units = self.units[..self.used].par_iter_mut().zip(&jobs).enumerate();
        units.for_each(|(place, (unit, job))| {
            unit.splats.clear();
            unit.keys.clear();
            let base = (job.view as u64) << (DEPTH_BITS + 32) | (place as u64) << UNIT_BITS;
            dispatch!(level, simd => project_unit(simd, job, cutoffs, base, unit));
        });
    }

    /// The units in order of (view, global id).
    pub(super) fn units(&self) -> &[Unit] {
        &self.units[..self.used]
    }

    /// The splat of a sort key.
    pub(super) fn splat(&self, key: u64) -> &Splat {
        let place = key as u32;
        &self.units[(place >> UNIT_BITS) as usize].splats[(place & ((1 << UNIT_BITS) - 1)) as usize]
    }
}

/// The units of a frame: chunks that a view cannot see cost one test.
fn jobs<'a>(frame: &Frame<'a>) -> Vec<Job<'a>> {
    let mut jobs = Vec::new();
    for (index, view) in frame.views.iter().enumerate() {
        for chunk in &frame.scene.chunks {
            jobs_of(index, view, chunk, frame.profile, &mut jobs);
        }
    }
    jobs
}

fn jobs_of<'a>(
    index: usize,
    view: &View,
    chunk: &'a Chunk,
    profile: &RenderProfile,
    jobs: &mut Vec<Job<'a>>,
) {
    let frustum = Frustum::new(view, chunk, profile);
    let visible = |clusters: &std::ops::Range<usize>| {
        let mut clusters = chunk.clusters()[clusters.clone()].iter();
        clusters.any(|cluster| frustum.may_see(cluster.min_m, cluster.max_m, cluster.sigma_m))
    };
    let chunk_view = ChunkView::new(view, chunk);
    let count = chunk.clusters().len();
    let ranges = (0..count).step_by(UNIT_CLUSTERS).map(|k| k..(k + UNIT_CLUSTERS).min(count));
    jobs.extend(ranges.filter(visible).map(|clusters| Job {
        view: index,
        chunk,
        clusters,
        chunk_view,
        frustum,
    }));
}

#[inline(always)]
fn project_unit<S: Simd>(simd: S, job: &Job<'_>, cutoffs: &Cutoffs, base: u64, unit: &mut Unit) {
    let blocks = job.chunk.len().div_ceil(LANES);
    for (k, cluster) in (job.clusters.clone()).zip(&job.chunk.clusters()[job.clusters.clone()]) {
        if !job.frustum.may_see(cluster.min_m, cluster.max_m, cluster.sigma_m) {
            continue;
        }
        let first = k * CLUSTER / LANES;
        for block in first..(first + CLUSTER / LANES).min(blocks) {
            let columns = job.chunk.block(block);
            let degree = job.chunk.sh_degree();
            if let Some(splats) = project_block(simd, columns, degree, &job.chunk_view, cutoffs) {
                splats.append(cutoffs.near_m, base, unit);
            }
        }
    }
}

/// Sixteen splats as columns, and which of them are visible.
struct SplatLanes {
    visible: u64,
    columns: [[f32; LANES]; 12],
}

impl SplatLanes {
    #[inline(always)]
    fn append(&self, near_m: f32, base: u64, unit: &mut Unit) {
        let mut visible = self.visible;
        while visible != 0 {
            let lane = visible.trailing_zeros() as usize;
            visible &= visible - 1;
            let c = |column: usize| self.columns[column][lane];
            let depth = c(9).to_bits() - near_m.to_bits();
            let depth = u64::from(depth.min((1 << DEPTH_BITS) - 1));
            unit.keys.push(base | depth << 32 | unit.splats.len() as u64);
            unit.splats.push(Splat {
                mean_px: [c(0), c(1)],
                factor: [c(2), c(3), c(4)],
                log2_opacity: c(5),
                rgb: [c(6), c(7), c(8)],
                depth_m: c(9),
                extent_px: [c(10), c(11)],
            });
        }
    }
}

/// Projects one block, or returns `None` if nothing of it can be seen.
///
/// `Σ′ = J W Σ Wᵀ Jᵀ + blur I` (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5) through its square
/// root `V = J W R S` (2x3). With the minors `m_ij` of `V`, `det Σ′ = Σ m_ij² + blur |V|² + blur²`
/// is a sum of positives: exact to rounding for needles whose `ac - b²` cancels to nothing.
#[inline(always)]
fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    view: &ChunkView,
    cutoffs: &Cutoffs,
) -> Option<SplatLanes> {
    let load = |column: usize| f32x16::load_array_ref(simd, &columns[column].0);
    let splat = |value: f32| f32x16::splat(simd, value);
    let mean = [load(column::MEAN), load(column::MEAN + 1), load(column::MEAN + 2)];

    // Camera space: in range?
    let [x, y, z] = [0, 1, 2].map(|i| {
        let [rx, ry, rz] = view.rotation[i].map(splat);
        rx.mul_add(mean[0], ry.mul_add(mean[1], rz.mul_add(mean[2], splat(view.translation_m[i]))))
    });
    let mut log2_opacity = load(column::LOG2_OPACITY);
    let in_range = z.simd_ge(splat(cutoffs.near_m))
        & z.simd_le(splat(cutoffs.far_m))
        & log2_opacity.simd_ge(splat(cutoffs.log2_alpha_cut));
    if in_range.all_false() {
        return None;
    }

    // Rows of J W at the clamped slope.
    let inverse_z = splat(1.0) / z;
    let slope = [x * inverse_z, y * inverse_z];
    let mean_px =
        [0, 1].map(|i| slope[i].mul_add(splat(view.focal_px[i]), splat(view.center_px[i])));
    let jw = [0, 1].map(|i| {
        let clamped = slope[i].max(splat(view.slope_min[i])).min(splat(view.slope_max[i]));
        let scale = inverse_z * splat(view.focal_px[i]);
        [0, 1, 2].map(|k| {
            scale * (-clamped).mul_add(splat(view.rotation[2][k]), splat(view.rotation[i][k]))
        })
    });

    // V = J W R S, no wider than f32 can square twice.
    let rotation = rotation_matrix([0, 1, 2, 3].map(|i| load(column::QUAT + i)), splat(1.0));
    let scale = [0, 1, 2].map(|i| load(column::SCALE + i));
    let v = [0, 1].map(|i| {
        [0, 1, 2].map(|k| scale[k] * dot(jw[i], [rotation[0][k], rotation[1][k], rotation[2][k]]))
    });
    let widest = v.iter().flatten().fold(splat(0.0), |widest, entry| widest.max(entry.abs()));
    let shrink = (splat(MAX_SIGMA_PX) / widest.max(splat(1e-30))).min(splat(1.0));
    let v = v.map(|row| row.map(|entry| entry * shrink));

    // The covariance, its determinant, and the factor of its inverse.
    let blur = splat(cutoffs.blur_px2);
    let minors = [(0, 1), (0, 2), (1, 2)].map(|(i, j)| v[0][i] * v[1][j] - v[0][j] * v[1][i]);
    let (xx, yy, b) = (dot(v[0], v[0]), dot(v[1], v[1]), dot(v[0], v[1]));
    let det_before = dot(minors, minors);
    let det = blur.mul_add(xx + yy + blur, det_before);
    let (a, c) = (xx + blur, yy + blur);
    if cutoffs.antialiased {
        // Yu et al. 2024 (Mip-Splatting): sqrt(det_before / det), with gsplat's floor 0.005.
        let ratio = (det_before / det).max(splat(0.005 * 0.005));
        log2_opacity = splat(0.5).mul_add(log2(simd, ratio), log2_opacity);
    }
    // q(dx, dy) = (c dx - b dy)²/(c det) + dy²/c; times log2(e)/2 it is a power of two.
    let unit = splat((0.5 * std::f64::consts::LOG2_E).sqrt() as f32);
    let root_c = c.sqrt();
    let l2 = unit / root_c;
    let root_det = det.sqrt();
    let l0 = unit * root_c / root_det;
    let l1 = -(b * l2) / root_det;

    // The box where alpha reaches the cut, against the image's pixel centres.
    let power = log2_opacity - splat(cutoffs.log2_alpha_cut);
    let reach = power.max(splat(0.0)).sqrt() / unit;
    let slack = splat(EXTENT_SLACK_PX);
    let extent = [reach.mul_add(a.sqrt(), slack), reach.mul_add(root_c, slack)];
    let on_image = |i: usize| {
        (mean_px[i] + extent[i]).simd_ge(splat(0.5))
            & (mean_px[i] - extent[i]).simd_le(splat(view.size_px[i] - 0.5))
    };
    let visible = in_range & power.simd_ge(splat(0.0)) & on_image(0) & on_image(1);
    if visible.all_false() {
        return None;
    }

    let toward = [0, 1, 2].map(|i| mean[i] - splat(view.camera_m[i]));
    let rgb = color(simd, columns, sh_degree, toward);
    let columns = [
        mean_px[0],
        mean_px[1],
        l0,
        l1,
        l2,
        log2_opacity,
        rgb[0],
        rgb[1],
        rgb[2],
        z,
        extent[0],
        extent[1],
    ];
    Some(SplatLanes { visible: bits(visible), columns: columns.map(|column| column.to_array()) })
}

#[inline(always)]
fn bits<S: Simd>(mask: mask32x16<S>) -> u64 {
    mask.to_bitmask()
}

#[inline(always)]
fn dot<S: Simd>(a: [f32x16<S>; 3], b: [f32x16<S>; 3]) -> f32x16<S> {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// Rows of the rotation matrix of unit quaternions (w, x, y, z).
#[inline(always)]
fn rotation_matrix<S: Simd>(q: [f32x16<S>; 4], one: f32x16<S>) -> [[f32x16<S>; 3]; 3] {
    let [w, x, y, z] = q;
    let (x2, y2, z2) = (x + x, y + y, z + z);
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    [
        [one - yy - zz, xy - wz, xz + wy],
        [xy + wz, one - xx - zz, yz - wx],
        [xz - wy, yz + wx, one - xx - yy],
    ]
}

/// `max(0, SH(direction) + 0.5)` along `toward`, which need not be unit.
#[inline(always)]
fn color<S: Simd>(
    simd: S,
    columns: &[Lanes],
    degree: u8,
    toward: [f32x16<S>; 3],
) -> [f32x16<S>; 3] {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let coefficient = |k: usize, channel: usize| {
        f32x16::load_array_ref(simd, &columns[column::SH + 3 * k + channel].0)
    };
    let mut rgb = [0, 1, 2].map(|c| splat(sh::C0).mul_add(coefficient(0, c), splat(0.5)));
    let mut add = |k: usize, basis: f32x16<S>| {
        for (c, channel) in rgb.iter_mut().enumerate() {
            *channel = basis.mul_add(coefficient(k, c), *channel);
        }
    };
    if degree > 0 {
        let inverse_length = splat(1.0) / dot(toward, toward).max(splat(1e-30)).sqrt();
        let [x, y, z] = toward.map(|t| t * inverse_length);
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
    rgb.map(|channel| channel.max(splat(0.0)))
}

/// Base-2 logarithm of positive normal numbers, within 2e-7: the exponent, and the series of
/// `2 atanh(t) log2(e)` for the mantissa in [√½, √2), where `|t| <= 0.172`.
#[inline(always)]
fn log2<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let bits: fearless_simd::i32x16<S> = x.bitcast();
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
