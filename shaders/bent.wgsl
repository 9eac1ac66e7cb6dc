// Stage project for lenses and rolling shutters: the mean and the scatter of six points. Twin of
// `src/render/unscented.rs`, where the choice is explained.

#import lens

// Rounds of the search for the row that sees a point, and the share of the exposure at which it ends.
const ROUNDS: u32 = 32;
const STILL: f32 = 1e-6;

const ROOT_3: f32 = 1.7320508;

// What is not in range has no shape, unless it was `decided` that it is.
fn project_shape(own: Geometry, view: ChunkView, decided: bool) -> Projected {
    let of_view = view.view;
    let mean = vec4f(own.mean_m, 1.0);
    let rows = view.camera_from_chunk;
    let center_m = vec3f(dot(rows[0], mean), dot(rows[1], mean), dot(rows[2], mean));
    let center = expose(of_view, center_m, 0.0);
    let depth_m = depth(own.mean_m, view, center_m, center.share);
    let off_axis_rad = angle(length(center.point_m.xy), center.point_m.z);
    let in_range = depth_m >= frame.near_m && depth_m <= frame.far_m
        && off_axis_rad <= lenses[of_view].widest_rad
        && own.log2_opacity >= frame.log2_alpha_cut;
    if !in_range && !decided {
        return Projected();
    }

    // Relative to where the centre lands, so that small things keep their shape.
    let chunk_from_own = rotation_from_quat(own.quat_wxyz);
    var pairs: array<vec4f, 3>;
    var sum_px = vec2f(0.0);
    for (var axis = 0u; axis < 3u; axis++) {
        let axis_m = chunk_from_own[axis] * (ROOT_3 * own.scale_m[axis]);
        let offset_m = vec3f(dot(rows[0].xyz, axis_m), dot(rows[1].xyz, axis_m), dot(rows[2].xyz, axis_m));
        let one_px = expose(of_view, center_m + offset_m, center.share).at_px - center.at_px;
        let other_px = expose(of_view, center_m - offset_m, center.share).at_px - center.at_px;
        pairs[axis] = vec4f(one_px, other_px);
        sum_px += one_px + other_px;
    }
    let mean_px = sum_px / 6.0;

    // Of each pair, the half difference and the middle's distance from the mean scatter as much as both.
    var root_px: array<vec2f, 6>;
    var widest = 0.0;
    for (var axis = 0u; axis < 3u; axis++) {
        let pair = pairs[axis];
        let across = (0.5 / ROOT_3) * (pair.xy - pair.zw);
        let middle = (1.0 / ROOT_3) * (0.5 * (pair.xy + pair.zw) - mean_px);
        root_px[axis] = across;
        root_px[axis + 3u] = middle;
        widest = max(widest, max(max(abs(across.x), abs(across.y)), max(abs(middle.x), abs(middle.y))));
    }
    let per_px = min(MAX_SIGMA_PX / max(widest, 1e-30), 1.0);
    var covariance = vec3f(0.0);
    var det_before = 0.0;
    for (var i = 0u; i < 6u; i++) {
        let column = root_px[i] * per_px;
        covariance += vec3f(column.x * column, column.y * column.y);
        for (var k = 0u; k < i; k++) {
            let other = root_px[k] * per_px;
            let minor = column.x * other.y - column.y * other.x;
            det_before += minor * minor;
        }
    }
    let foot = Footprint(center.at_px + mean_px, covariance, det_before, per_px);
    var projected = shape_of(foot, own.log2_opacity, of_view);
    projected.depth_m = depth_m;
    projected.toward_m = own.mean_m - view.camera_m + center.share * lenses[of_view].moved_world_m;
    return projected;
}

// Where a point lands, and which share of the exposure is still to come then.
struct Exposed {
    at_px: vec2f,
    share: f32,
    // In the camera's frame then, in metres.
    point_m: vec3f,
}

// Of a point in the camera's frame at the exposure's end. The row decides where the camera stands, and
// that decides the row: found by going back and forth, from a first guess, or by halves where that leads astray.
fn expose(of_view: u32, at_end_m: vec3f, guess: f32) -> Exposed {
    var seen = exposed(of_view, at_end_m, guess);
    var least = 0.0;
    var most = 1.0;
    var off_before = 2.0;
    for (var round = 0u; round < ROUNDS; round++) {
        let share = still_to_come(of_view, seen.at_px);
        let off = share - seen.share;
        if abs(off) <= STILL {
            break;
        }
        if off > 0.0 {
            least = seen.share;
        } else {
            most = seen.share;
        }
        let closes = abs(off) <= 0.5 * off_before && share >= least && share <= most;
        off_before = abs(off);
        seen = exposed(of_view, at_end_m, select(0.5 * (least + most), share, closes));
    }
    return seen;
}

fn exposed(of_view: u32, at_end_m: vec3f, share: f32) -> Exposed {
    let moved_m = at_end_m + share * lenses[of_view].moved_m;
    let point_m = moved_m + turning(of_view, moved_m, share);
    return Exposed(land(of_view, point_m), share, point_m);
}

// As if computed exactly and rounded once, but for what a moving camera adds.
fn depth(mean: vec3f, view: ChunkView, at_end_m: vec3f, share: f32) -> f32 {
    if lenses[view.view].by_distance != 0u {
        return exact_distance(mean, view, share * lenses[view.view].moved_world_m);
    }
    let moved_m = share * lenses[view.view].moved_m;
    let more_m = moved_m.z + turning(view.view, at_end_m + moved_m, share).z;
    let exact_m = exact_z(mean, view);
    let sum = sum_of(exact_m.x, more_m);
    return sum.x + (sum.y + exact_m.y);
}

// The distance from the camera's centre, which lies in `depth_high` and `depth_low`, to a point that is
// moved by so much: exact, and rounded once.
fn exact_distance(mean: vec3f, view: ChunkView, moved_m: vec3f) -> f32 {
    var sum = 0.0;
    var lost = 0.0;
    for (var axis = 0; axis < 3; axis++) {
        let away = sum_of(mean[axis], -view.depth_high[axis]);
        let then = sum_of(away.x, moved_m[axis]);
        let square = product(then.x, then.x);
        let next = sum_of(sum, square.x);
        lost += 2.0 * then.x * (away.y + then.y - view.depth_low[axis]) + square.y + next.y;
        sum = next.x;
    }
    // One step of Newton's, of which the rounded root is so close that its error is exact.
    let root = sqrt(sum);
    let square = product(root, root);
    return root + (((sum - square.x) - square.y) + lost) / max(2.0 * root, 1e-30);
}
