//! Projection by every camera that is not a static pinhole: six points of each Gaussian
//! ([`crate::unscented`] explains the method), or the camera's expansion around its centre where
//! the two differ by less than a bound ([`crate::expansion`]).
//!
//! Where [`LensProjection`] describes the camera, 16 Gaussians are projected at a time in f32.
//! Those with a point beyond the lens' field, or with a point for which the search found no row,
//! are projected one by one in f64 by [`UnscentedView`].

use fearless_simd::{f32x16, mask32x16, prelude::*};
use glam::{DMat3, DQuat, DVec2, DVec3, Vec3};

use super::angles::CenterAngles;
use super::axes::{F64x16, Quaternions, matrix_columns, transform_row};
use super::color::color;
use super::splat_block::{Ellipse, LOG2_UNIT, Moments, ProjectedBlock, SplatBlock};
use crate::View;
use crate::constants::EXTENT_SLACK_PX;
use crate::cpu::lanes::Vec3x16;
use crate::cpu::lens::{ExpandedAxes, ExposedPixels, LensProjection, Remainder};
use crate::expansion::ExpansionBound;
use crate::layout::{Cutoffs, Filtered, PixelFilter};
use crate::unscented::{CullBound, Footprint, UnscentedView};
use wildcity_scene::chunk::{LANES, Lanes, column};
use wildcity_scene::{Chunk, RenderProfile};

/// One chunk in a view that is not a static pinhole.
#[derive(Clone, Copy)]
pub(super) struct UnscentedChunkView<'a> {
    unscented: &'a UnscentedView<'a>,
    /// `None` where only the f64 path describes the camera.
    lens: Option<&'a LensProjection>,
    /// The chunk's origin in the world.
    origin_m: DVec3,
    /// Rows that take a point `(x, y, z, 1)` of the chunk to the camera's frame at the end of the
    /// exposure, in metres.
    camera_from_chunk: [[f64; 4]; 3],
    /// The rotation of these as a quaternion (x, y, z, w).
    camera_from_chunk_rotation: [f32; 4],
    /// The camera's centre relative to the chunk's origin, in world axes, in metres.
    camera_m: [f32; 3],
    size_px: [f32; 2],
    /// The variances that are added to screen covariances.
    filter: PixelFilter,
    /// Whether depth is the distance from the camera, and not z.
    depth_is_distance: bool,
}

impl<'a> UnscentedChunkView<'a> {
    /// Positions are subtracted in f64, so that a twin far from its origin loses no precision.
    pub(super) fn new(
        view: &View,
        chunk: &Chunk,
        profile: &RenderProfile,
        unscented: &'a UnscentedView<'a>,
        lens: Option<&'a LensProjection>,
    ) -> Self {
        let origin_m = chunk.origin_m();
        let camera_from_world = view.world_from_camera.inverse();
        let camera_m = view.world_from_camera.position_m - origin_m;
        // glam has columns: the columns of the transpose are the rows.
        let rows = camera_from_world.rotation_matrix().transpose();
        let translation_m = camera_from_world.rotation * -camera_m;
        let row = |axis: usize| rows.col(axis).extend(translation_m[axis]).to_array();
        Self {
            unscented,
            lens,
            origin_m,
            camera_from_chunk: [0, 1, 2].map(row),
            camera_from_chunk_rotation: camera_from_world.rotation.as_quat().to_array(),
            camera_m: camera_m.as_vec3().to_array(),
            size_px: view.camera.size_px().as_vec2().to_array(),
            filter: PixelFilter::new(profile, &view.camera),
            depth_is_distance: view.camera.depth_is_distance(),
        }
    }

    /// The view that it projects for.
    pub(super) fn view(&self) -> &View {
        self.unscented.view()
    }

    /// The chunk's origin in the world, in metres.
    pub(super) fn origin_m(&self) -> DVec3 {
        self.origin_m
    }

    /// The variances that are added to screen covariances.
    pub(super) fn filter(&self) -> &PixelFilter {
        &self.filter
    }

    /// The vector from the camera, when it sees it, to a point of the chunk, in world axes, in
    /// metres.
    pub(super) fn toward_m(&self, point_m: DVec3) -> DVec3 {
        let world_m = self.origin_m + point_m;
        let seen = self.view().project_extrapolated(world_m, 1.0);
        world_m - seen.world_from_camera.position_m
    }

    /// Whether a Gaussian with its centre in a box, relative to `origin_m`, can touch the image.
    #[inline(always)]
    pub(super) fn may_see(&self, origin_m: DVec3, min_m: Vec3, max_m: Vec3, sigma_m: f32) -> bool {
        self.unscented.may_see(origin_m, min_m, max_m, sigma_m)
    }

    /// A depth, and the largest difference of the depths of all centres in a ball from it while the
    /// camera moves, in metres. The ball is relative to the chunk's origin.
    pub(super) fn depth_m(&self, center_m: DVec3, radius_m: f64) -> [f64; 2] {
        let CullBound { translation_m, rotation_rad, .. } = *self.unscented.cull_bound();
        let at_end_m = self
            .camera_from_chunk
            .map(|[x, y, z, offset_m]| DVec3::new(x, y, z).dot(center_m) + offset_m);
        let distance_m = DVec3::from_array(at_end_m).length();
        // The camera moves while it exposes, so the depth at the end is off by that motion.
        let reach_m = radius_m + translation_m;
        if self.depth_is_distance {
            [distance_m, reach_m]
        } else {
            // A rotation moves a point by at most its angle times the distance.
            [at_end_m[2], reach_m + rotation_rad * (distance_m + reach_m)]
        }
    }
}

/// Projects one block of 16 Gaussians, or returns `None` if none of them can be seen.
#[inline(always)]
pub(super) fn project_block<S: Simd>(
    simd: S,
    columns: &[Lanes],
    sh_degree: u8,
    view: &UnscentedChunkView<'_>,
    cutoffs: &Cutoffs,
) -> Option<SplatBlock> {
    // Project the Gaussians that the lens describes, 16 at a time.
    let mut toward_m = [[0.0_f32; LANES]; 3];
    let (mut splats, remaining) = match view.lens {
        Some(lens) => project_lanes(simd, columns, view, lens, cutoffs, &mut toward_m),
        // All 16 lanes are left to the f64 path.
        None => (SplatBlock::default(), (1 << LANES) - 1),
    };
    // Project the rest one by one in f64.
    for lane in (0..LANES).filter(|lane| remaining >> lane & 1 == 1) {
        if let Some(from_camera_m) = project_one(columns, lane, view, cutoffs, &mut splats) {
            splats.visible |= 1 << lane;
            for (to, from) in toward_m.iter_mut().zip(from_camera_m.to_array()) {
                to[lane] = from as f32;
            }
        }
    }
    if splats.visible == 0 {
        return None;
    }
    // Colours of both paths at once, after the visible lanes are known.
    let toward = Vec3x16::from_arrays(simd, &toward_m);
    splats.set_colors(color(simd, columns, sh_degree, toward));
    Some(splats)
}

/// Projects those Gaussians of a block whose points are within the lens' field: by the expansion
/// around their centres where that suffices, and by six points elsewhere. Returns their splats, and
/// a bit for each other Gaussian that may be seen. `toward_m` receives the vectors from the camera
/// to the centres, in world axes.
#[inline(always)]
fn project_lanes<S: Simd>(
    simd: S,
    columns: &[Lanes],
    view: &UnscentedChunkView<'_>,
    lens: &LensProjection,
    cutoffs: &Cutoffs,
    toward_m: &mut [[f32; LANES]; 3],
) -> (SplatBlock, u64) {
    let splat = |value: f32| f32x16::splat(simd, value);

    // Centres in the camera's frame at the end of the exposure, in f64 for depth and in f32 for the
    // rest.
    let mean = Vec3x16::load(simd, columns, column::MEAN);
    let [right, down, forward] = view.camera_from_chunk;
    let x = transform_row(simd, mean, right);
    let y = transform_row(simd, mean, down);
    let z = transform_row(simd, mean, forward);
    let center = Vec3x16 { x: x.0.narrow(x.1), y: y.0.narrow(y.1), z: z.0.narrow(z.1) };
    let at_end_m = [x, y, z];

    // Before the lens is applied, cull Gaussians that are too faint or certainly miss the image.
    let log2_opacity = f32x16::load_array_ref(simd, &columns[column::LOG2_OPACITY].0);
    let scale = Vec3x16::load(simd, columns, column::SCALE);
    let bound = view.unscented.cull_bound();
    let sigma_m = scale.x.max(scale.y).max(scale.z);
    let angles = CenterAngles::new(simd, center, sigma_m, bound);
    let in_range =
        log2_opacity.simd_ge(splat(cutoffs.log2_alpha_cut)) & !angles.surely_unseen(simd, bound);
    if in_range.all_false() {
        return (SplatBlock::default(), 0);
    }

    // When each centre is exposed, and where the camera is then.
    let exposed = lens.project(simd, center, angles.distance_m, in_range);
    let ExposedPixels { pixels: center_px, moment } = exposed;
    let then_m = lens.at_exposure(simd, center, moment.remaining);
    let mut distance_m = angles.distance_m;
    let mut toward = mean.minus(Vec3x16::splat(simd, view.camera_m));
    if let Some(shutter) = lens.shutter() {
        distance_m = then_m.dot(then_m).sqrt();
        toward = toward.plus(shutter.translation_world(simd, moment.remaining));
    }
    *toward_m = [toward.x.to_array(), toward.y.to_array(), toward.z.to_array()];

    // Near and far. While the shutter rolls the depth is known only where the row was found; the
    // f64 path decides for the others.
    let depth_m = depth(simd, at_end_m, view, lens, distance_m, moment.remaining);
    let in_depth = depth_m.simd_ge(splat(cutoffs.near_m)) & depth_m.simd_le(splat(cutoffs.far_m));
    let found = center_px.margin.simd_ge(splat(0.0));
    let is_depth = match lens.shutter() {
        // True in every lane: without a shutter the depth needs no row.
        None => splat(0.0).simd_ge(splat(0.0)),
        Some(_) => found,
    };
    // Cull Gaussians too far outside of the lens' field, or so far outside of the image that none
    // of their points reaches it.
    // Off the axis by more than the angle: z/distance is below its cosine. No arc cosine is needed.
    let least_z = splat(bound.max_center_cos as f32) * distance_m;
    let too_far = then_m.z.simd_lt(least_z) | angles.beside(simd, center_px, view.size_px, bound);
    // A lane is dropped only on what is known of it: a depth, or a place that was found.
    let in_range = in_range & (in_depth | !is_depth) & !(found & too_far);
    if in_range.all_false() {
        return (SplatBlock::default(), 0);
    }

    // The own axes times their standard deviations, in the camera's frame at that moment.
    let rotations = Quaternions::load(simd, columns).after(simd, view.camera_from_chunk_rotation);
    let [mut x, mut y, mut z] = matrix_columns(simd, rotations);
    if let Some(shutter) = lens.shutter() {
        x = shutter.rotated(simd, x, moment.remaining);
        y = shutter.rotated(simd, y, moment.remaining);
        z = shutter.rotated(simd, z, moment.remaining);
    }
    let gaussians = CenteredBlock {
        then_m,
        axes_m: [x.scale(scale.x), y.scale(scale.y), z.scale(scale.z)],
        exposed,
        depth_m,
        log2_opacity,
        in_range,
    };
    // Most Gaussians of a street are small for their distance, so the expansion comes first.
    let Some(expansion_bound) = view.unscented.expansion_bound() else {
        return project_six_points(simd, &gaussians, view, lens, cutoffs);
    };
    let (mut splats, left) = expand(simd, &gaussians, view, lens, expansion_bound, cutoffs);
    if left.all_false() {
        return (splats, 0);
    }
    // Only the lanes that are left: each Gaussian gets its splat from exactly one of the ways.
    let gaussians = CenteredBlock { in_range: left, ..gaussians };
    let (of_points, remaining) = project_six_points(simd, &gaussians, view, lens, cutoffs);
    splats.merge(&of_points);
    (splats, remaining)
}

/// Sixteen Gaussians whose centres have been projected.
struct CenteredBlock<S: Simd> {
    /// Centres in the camera's frame at the moments of their exposure, in metres.
    then_m: Vec3x16<S>,
    /// Own axes times their standard deviations, in the same frames, in metres.
    axes_m: [Vec3x16<S>; 3],
    exposed: ExposedPixels<S>,
    depth_m: f32x16<S>,
    log2_opacity: f32x16<S>,
    /// The Gaussians that may be visible.
    in_range: mask32x16<S>,
}

/// The splats of those Gaussians for which the expansion is close enough to six points, and the
/// others that may be seen.
#[inline(always)]
fn expand<S: Simd>(
    simd: S,
    gaussians: &CenteredBlock<S>,
    view: &UnscentedChunkView<'_>,
    lens: &LensProjection,
    bound: &ExpansionBound,
    cutoffs: &Cutoffs,
) -> (SplatBlock, mask32x16<S>) {
    let CenteredBlock { then_m, axes_m, ref exposed, depth_m, log2_opacity, in_range } = *gaussians;
    let none = (SplatBlock::default(), in_range);
    let Some(expansion) = lens.expand(simd, then_m, exposed) else { return none };
    let ExpandedAxes { columns, mean_shift, remainder } = expansion.axes(simd, axes_m);
    let pixels = exposed.pixels;
    let close = in_range
        & pixels.margin.simd_ge(f32x16::splat(simd, 0.0))
        & is_close(simd, &remainder, bound);
    if close.all_false() {
        return none;
    }
    let mut root = [[f32x16::splat(simd, 0.0); 2]; 6];
    for (of_root, column) in root.iter_mut().zip(columns) {
        *of_root = [column.x, column.y];
    }
    // The same sums as for six points: the columns are those of a root, too.
    let moments = moments_of_root(simd, root);
    let projected = ProjectedBlock {
        mean_x: pixels.x_px + mean_shift.x,
        mean_y: pixels.y_px + mean_shift.y,
        depth_m,
        log2_opacity,
        ellipse: Ellipse::from_moments(simd, moments, &view.filter, f32x16::splat(simd, 1.0)),
        in_range: close,
    };
    (projected.clip(simd, view.size_px, cutoffs), in_range & !close)
}

/// The lanes in which the expansion differs from six points by less than the bound.
#[inline(always)]
fn is_close<S: Simd>(simd: S, remainder: &Remainder<S>, bound: &ExpansionBound) -> mask32x16<S> {
    let splat = |value: f64| f32x16::splat(simd, value as f32);
    let Remainder { square, longest, shutter_px, room } = *remainder;
    // second S + third s^3 + the shutter's term, see `crate::expansion`.
    let cube = longest * longest * longest;
    let error_px =
        splat(bound.second_px).mul_add(square, splat(bound.third_px).mul_add(cube, shutter_px));
    // The points lie √3 standard deviations from the centre; the rest is a margin.
    let within = room.simd_ge(splat(2.5) * longest);
    within & error_px.simd_le(splat(bound.max_error_px))
}

/// Projects those Gaussians of a block that have all six points within the lens' field. Returns
/// their splats, and a bit for each other Gaussian that may be seen.
#[inline(always)]
fn project_six_points<S: Simd>(
    simd: S,
    gaussians: &CenteredBlock<S>,
    view: &UnscentedChunkView<'_>,
    lens: &LensProjection,
    cutoffs: &Cutoffs,
) -> (SplatBlock, u64) {
    let splat = |value: f32| f32x16::splat(simd, value);
    let CenteredBlock { then_m, axes_m, ref exposed, depth_m, log2_opacity, in_range } = *gaussians;

    // The six points: ±√3 standard deviations along each own axis.
    let mut margin = exposed.pixels.margin;
    let mut pairs = [[splat(0.0); 4]; 3];
    let mut mean_x = splat(0.0);
    let mut mean_y = splat(0.0);
    let root_3 = splat(3.0_f32.sqrt());
    for (axis_m, pair) in axes_m.into_iter().zip(&mut pairs) {
        for (side, distance) in [root_3, -root_3].into_iter().enumerate() {
            let point_m = axis_m.mul_add(distance, then_m);
            let at = lens.project_near(simd, point_m, &exposed.moment, in_range);
            // A single point beyond the field sends the Gaussian to the f64 path.
            margin = margin.min(at.margin);
            mean_x += at.x_px;
            mean_y += at.y_px;
            pair[2 * side] = at.x_px;
            pair[2 * side + 1] = at.y_px;
        }
    }
    let sixth = splat(1.0 / 6.0);
    let mean_x = mean_x * sixth;
    let mean_y = mean_y * sixth;

    // The 2 x 6 root of the covariance, as in `UnscentedView::project`: half differences of each
    // pair, and distances of each pair's middle from the mean.
    let half = splat(0.5 / 3.0_f32.sqrt());
    let mut root = [[splat(0.0); 2]; 6];
    for (axis, [ax, ay, bx, by]) in pairs.into_iter().enumerate() {
        root[axis] = [(ax - bx) * half, (ay - by) * half];
        root[3 + axis] =
            [(ax - mean_x + (bx - mean_x)) * half, (ay - mean_y + (by - mean_y)) * half];
    }

    let moments = moments_of_root(simd, root);
    let ellipse = Ellipse::from_moments(simd, moments, &view.filter, splat(1.0));

    let inside = in_range & margin.simd_ge(splat(0.0));
    let projected =
        ProjectedBlock { mean_x, mean_y, depth_m, log2_opacity, ellipse, in_range: inside };
    let splats = projected.clip(simd, view.size_px, cutoffs);
    // Not `!splats.visible`: a Gaussian that is inside but misses the image is done.
    (splats, in_range.to_bitmask() & !inside.to_bitmask())
}

/// The covariance of a root with six columns, and its determinant.
///
/// With the rows x and y of the root, and `r = y - x (x·y)/(x·x)`, the part of y across x, the
/// determinant is `(x·x)(r·r)`: a product of sums of squares, which f32 rounds no more than the sum
/// of the squares of the 15 minors.
#[inline(always)]
fn moments_of_root<S: Simd>(simd: S, root: [[f32x16<S>; 2]; 6]) -> Moments<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let [mut xx, mut yy, mut xy, mut across2] = [splat(0.0); 4];
    for [x, y] in root {
        xx = x.mul_add(x, xx);
        yy = y.mul_add(y, yy);
        xy = x.mul_add(y, xy);
    }
    // A row x of zeros has no direction, and all of y is across it.
    let slope = -(xy / xx.max(splat(1e-30)));
    for [x, y] in root {
        let across = x.mul_add(slope, y);
        across2 = across.mul_add(across, across2);
    }
    Moments { xx, yy, xy, det: xx * across2 }
}

#[inline(always)]
fn add<S: Simd>((low, high): F64x16<S>, more: f32x16<S>) -> F64x16<S> {
    let more = more.widen();
    (low + more.0, high + more.1)
}

/// Depth of centres, in metres: computed in f64 and rounded to f32 once, since splats are blended
/// in order of it.
///
/// `at_end_m` are the centres in the camera's frame at the end of the exposure. The depth of a
/// centre that is exposed earlier is that at its own moment: it is larger by the distance that the
/// camera still moves until the end. `distance_m` is their distance from the camera then, rounded
/// in every step.
#[inline(always)]
fn depth<S: Simd>(
    simd: S,
    at_end_m: [F64x16<S>; 3],
    view: &UnscentedChunkView<'_>,
    lens: &LensProjection,
    distance_m: f32x16<S>,
    remaining: f32x16<S>,
) -> f32x16<S> {
    let [mut x, mut y, mut z] = at_end_m;
    if !view.depth_is_distance {
        if let Some(shutter) = lens.shutter() {
            let center = Vec3x16 { x: x.0.narrow(x.1), y: y.0.narrow(y.1), z: z.0.narrow(z.1) };
            z = add(z, shutter.z_change(simd, center, remaining));
        }
        return z.0.narrow(z.1);
    }
    // A distance does not depend on rotation.
    if let Some(shutter) = lens.shutter() {
        let translation_m = shutter.translation(simd, remaining);
        x = add(x, translation_m.x);
        y = add(y, translation_m.y);
        z = add(z, translation_m.z);
    }
    let low = x.0.mul_add(x.0, y.0.mul_add(y.0, z.0 * z.0));
    let high = x.1.mul_add(x.1, y.1.mul_add(y.1, z.1 * z.1));
    // A step of Newton's method from the f32 distance: its error, squared, is below the resolution
    // of f32.
    let (near_low, near_high) = distance_m.widen();
    let off = (low - near_low * near_low).narrow(high - near_high * near_high);
    off.mul_add(f32x16::splat(simd, 0.5) / distance_m, distance_m)
}

/// Projects one Gaussian in f64 into its lane of `to`, and returns the vector from the camera to
/// its centre, in world axes, in metres; `None` if it cannot be seen.
#[inline(always)]
fn project_one(
    columns: &[Lanes],
    lane: usize,
    view: &UnscentedChunkView<'_>,
    cutoffs: &Cutoffs,
    to: &mut SplatBlock,
) -> Option<DVec3> {
    // Read the Gaussian.
    let value = |column: usize| f64::from(columns[column].0[lane]);
    let vector = |first| DVec3::new(value(first), value(first + 1), value(first + 2));
    let log2_cut = f64::from(cutoffs.log2_alpha_cut);
    let mut log2_opacity = value(column::LOG2_OPACITY);
    // A NaN is not opaque.
    let opaque = log2_opacity >= log2_cut;
    if !opaque {
        return None;
    }
    let q = column::QUAT;
    let rotation = DQuat::from_xyzw(value(q + 1), value(q + 2), value(q + 3), value(q));
    let axes_m = DMat3::from_quat(rotation) * DMat3::from_diagonal(vector(column::SCALE));
    let mean_m = view.origin_m + vector(column::MEAN);
    let Footprint { mean_px, root_px, depth_m, camera_m } =
        view.unscented.project(mean_m, axes_m)?;

    // The covariance, and its determinant as the sum of the squares of the root's 15 minors.
    let mut xx = 0.0;
    let mut yy = 0.0;
    let mut xy = 0.0;
    let mut det_before = 0.0;
    // Each pair of columns once: 6 x 5/2 = 15.
    for (i, column_px) in root_px.iter().enumerate() {
        xx += column_px.x * column_px.x;
        yy += column_px.y * column_px.y;
        xy += column_px.x * column_px.y;
        for other_px in &root_px[..i] {
            let minor = column_px.perp_dot(*other_px);
            det_before += minor * minor;
        }
    }
    // The variances rounded to f32, so that this lane is filtered as its neighbours are.
    let Filtered { xx, yy, det, blur_share, shrink_share } =
        view.filter.rounded().filtered(xx, yy, det_before);
    if cutoffs.antialiased {
        log2_opacity += 0.5 * blur_share.max(0.005 * 0.005).log2();
    }
    if view.filter.is_shrunk() {
        log2_opacity += PixelFilter::SHRINK_POWER * shrink_share.log2();
    }

    // The box where alpha reaches the cut, against the image's pixel centres.
    let power = log2_opacity - log2_cut;
    let unit = f64::from(LOG2_UNIT);
    let sigma_x = xx.sqrt();
    let sigma_y = yy.sqrt();
    let extent_px =
        power.max(0.0).sqrt() / unit * DVec2::new(sigma_x, sigma_y) + f64::from(EXTENT_SLACK_PX);
    let on_image = power >= 0.0
        && (mean_px + extent_px).cmpge(DVec2::splat(0.5)).all()
        && (mean_px - extent_px).cmple(view.unscented.size_px() - 0.5).all();
    if !on_image {
        return None;
    }

    // The factor of the inverse, as in `Ellipse::from_moments`.
    let l2 = unit / sigma_y;
    let root_det = det.sqrt();
    to.mean_x[lane] = mean_px.x as f32;
    to.mean_y[lane] = mean_px.y as f32;
    to.l0[lane] = (unit * sigma_y / root_det) as f32;
    to.l1[lane] = (-(xy * l2) / root_det) as f32;
    to.l2[lane] = l2 as f32;
    to.log2_opacity[lane] = log2_opacity as f32;
    to.depth_m[lane] = depth_m as f32;
    to.extent_x[lane] = extent_px.x as f32;
    to.extent_y[lane] = extent_px.y as f32;
    Some(mean_m - camera_m)
}
