// Stage project for lenses and rolling shutters by the unscented transform: the mean and covariance of
// six projected sigma points. Twin of `src/render/unscented.rs`, which explains the choice of points. Where the
// camera's expansion around the centre differs from the points by less than a bound, it replaces them.
//
// f32 suffices because no large numbers cancel: the six points are taken relative to where the centre
// lands, polynomials take fractions of the lens' field, a windshield's polynomials give the change of the
// angles only, and a rolling camera is described by its pose at the end of the exposure and the small
// motion back from there.

#import lens
#import expansion

// Most iterations of the search for the row that sees a point, and the change (a fraction of the
// exposure) at which it ends.
const ROUNDS: u32 = 32;
const CONVERGED: f32 = 1e-6;

const ROOT_3: f32 = 1.7320508;

// The splat of a Gaussian. A Gaussian that is out of range is returned as not visible, unless `decided`: then
// `cull` has already found it visible, and the range is not tested again. The pipeline `project` may round
// differently, and its splats must be those that `cull` counted.
fn project_shape(gaussian: Geometry, view: ChunkView, decided: bool) -> Projected {
    let lens = index_of_lens(view);
    let mean = vec4f(gaussian.mean_m, 1.0);
    let rows = view.camera_from_chunk;
    let center_m = vec3f(dot(rows[0], mean), dot(rows[1], mean), dot(rows[2], mean));
    let center = project_point(lens, center_m, 0.0);
    let depth_m = depth(gaussian.mean_m, view, center_m, center.fraction);
    let off_axis_rad = angle(length(center.point_m.xy), center.point_m.z);
    let in_range = depth_m >= frame.near_m && depth_m <= frame.far_m
        && off_axis_rad <= lenses[lens].widest_rad
        && gaussian.log2_opacity >= frame.log2_alpha_cut;
    if !in_range && !decided {
        return Projected();
    }

    let chunk_from_gaussian = rotation_from_quat(gaussian.quat_wxyz);
    var axes_m: array<vec3f, 3>;
    for (var axis = 0u; axis < 3u; axis++) {
        let axis_m = chunk_from_gaussian[axis] * gaussian.scale_m[axis];
        axes_m[axis] = vec3f(dot(rows[0].xyz, axis_m), dot(rows[1].xyz, axis_m), dot(rows[2].xyz, axis_m));
    }
    let from_camera_m =
        gaussian.mean_m - view.camera_m + center.fraction * lenses[lens].moved_world_m;

    // Small Gaussians: the expansion around the centre.
    let expanded = expand_axes(lens, center, axes_m);
    if expanded.close {
        return splat_of_root(
            center.at_px + expanded.shift_px, expanded.root_px, gaussian.log2_opacity, index_of_view(view), depth_m, from_camera_m,
        );
    }

    // The sigma points at +-sqrt(3) standard deviations along each axis, relative to where the centre
    // lands, so that the shape of small Gaussians is not lost to rounding.
    var pairs: array<vec4f, 3>;
    var sum_px = vec2f(0.0);
    for (var axis = 0u; axis < 3u; axis++) {
        let offset_m = ROOT_3 * axes_m[axis];
        let one_px = project_point(lens, center_m + offset_m, center.fraction).at_px - center.at_px;
        let other_px = project_point(lens, center_m - offset_m, center.fraction).at_px - center.at_px;
        pairs[axis] = vec4f(one_px, other_px);
        sum_px += one_px + other_px;
    }
    let mean_px = sum_px / 6.0;

    // A square root of the covariance with six columns. For each pair of points, half their difference
    // and the offset of their middle from the mean contribute as much as the two points themselves.
    var root_px: array<vec2f, 6>;
    for (var axis = 0u; axis < 3u; axis++) {
        let pair = pairs[axis];
        let across = (0.5 / ROOT_3) * (pair.xy - pair.zw);
        let middle = (1.0 / ROOT_3) * (0.5 * (pair.xy + pair.zw) - mean_px);
        root_px[axis] = across;
        root_px[axis + 3u] = middle;
    }
    return splat_of_root(
        center.at_px + mean_px, root_px, gaussian.log2_opacity, index_of_view(view), depth_m, from_camera_m,
    );
}

// The splat with a mean and a root of the covariance, in pixels.
fn splat_of_root(
    mean_px: vec2f,
    root_px: array<vec2f, 6>,
    log2_opacity: f32,
    view: u32,
    depth_m: f32,
    from_camera_m: vec3f,
) -> Projected {
    var root = root_px;
    var widest = 0.0;
    for (var i = 0u; i < 6u; i++) {
        widest = max(widest, max(abs(root[i].x), abs(root[i].y)));
    }
    // Covariance, and its determinant as the sum of the squares of all 2 x 2 minors (Cauchy-Binet).
    let units_per_px = min(MAX_SIGMA_PX / max(widest, 1e-30), 1.0);
    var covariance = vec3f(0.0);
    var det_unblurred = 0.0;
    for (var i = 0u; i < 6u; i++) {
        let column = root[i] * units_per_px;
        covariance += vec3f(column.x * column, column.y * column.y);
        for (var k = 0u; k < i; k++) {
            let other = root[k] * units_per_px;
            let minor = column.x * other.y - column.y * other.x;
            det_unblurred += minor * minor;
        }
    }
    let foot = Footprint(mean_px, covariance, det_unblurred, units_per_px);
    var projected = splat_shape(foot, log2_opacity, view);
    projected.depth_m = depth_m;
    projected.from_camera_m = from_camera_m;
    return projected;
}

// The place of a point on the image, and the fraction of the exposure that remains at that moment.
struct ProjectedPoint {
    at_px: vec2f,
    fraction: f32,
    // The point in the camera's frame at that moment, in metres.
    point_m: vec3f,
}

// The image of a point that is given in the camera's frame at the end of the exposure. The row determines the
// camera's pose and the pose determines the row: solved by fixed-point iteration from a first guess,
// and by bisection where an iteration does not halve the error.
fn project_point(view_index: u32, at_end_m: vec3f, guess: f32) -> ProjectedPoint {
    var point = project_point_at(view_index, at_end_m, guess);
    var least = 0.0;
    var most = 1.0;
    var off_before = 2.0;
    for (var round = 0u; round < ROUNDS; round++) {
        let fraction = remaining_exposure(view_index, point.at_px);
        let off = fraction - point.fraction;
        if abs(off) <= CONVERGED {
            break;
        }
        if off > 0.0 {
            least = point.fraction;
        } else {
            most = point.fraction;
        }
        let closes = abs(off) <= 0.5 * off_before && fraction >= least && fraction <= most;
        off_before = abs(off);
        point = project_point_at(view_index, at_end_m, select(0.5 * (least + most), fraction, closes));
    }
    return point;
}

// The image of a point with the camera's pose at which this fraction of the exposure remains.
fn project_point_at(view_index: u32, at_end_m: vec3f, fraction: f32) -> ProjectedPoint {
    let moved_m = at_end_m + fraction * lenses[view_index].moved_m;
    let point_m = moved_m + rotation_shift(view_index, moved_m, fraction);
    return ProjectedPoint(project_extrapolated(view_index, point_m), fraction, point_m);
}

// Depth of a centre in metres (z, or distance for wide lenses): exact and rounded once, except for the
// part that a camera with a rolling shutter adds by moving. That part is as exact as the row that sees
// the centre: a millionth of the camera's motion during the exposure.
fn depth(mean: vec3f, view: ChunkView, at_end_m: vec3f, fraction: f32) -> f32 {
    if lenses[index_of_lens(view)].by_distance != 0u {
        return exact_distance(mean, view, fraction * lenses[index_of_lens(view)].moved_world_m);
    }
    let moved_m = fraction * lenses[index_of_lens(view)].moved_m;
    let more_m = moved_m.z + rotation_shift(index_of_lens(view), at_end_m + moved_m, fraction).z;
    let exact_m = exact_z(mean, view);
    let sum = two_sum(exact_m.x, more_m);
    return sum.x + (sum.y + exact_m.y);
}

// Distance in metres from the camera's centre (`depth_high` plus `depth_low`) to a point moved by
// `moved_m`: exact, and rounded once.
fn exact_distance(mean: vec3f, view: ChunkView, moved_m: vec3f) -> f32 {
    var sum = 0.0;
    var lost = 0.0;
    for (var axis = 0; axis < 3; axis++) {
        let offset = two_sum(mean[axis], -view.depth_high[axis]);
        let moved = two_sum(offset.x, moved_m[axis]);
        let square = two_product(moved.x, moved.x);
        let next = two_sum(sum, square.x);
        lost += 2.0 * moved.x * (offset.y + moved.y - view.depth_low[axis]) + square.y + next.y;
        sum = next.x;
    }
    // One Newton step. The rounded root is so close that the step's residual is exact.
    let root = sqrt(sum);
    let square = two_product(root, root);
    return root + (((sum - square.x) - square.y) + lost) / max(2.0 * root, 1e-30);
}
