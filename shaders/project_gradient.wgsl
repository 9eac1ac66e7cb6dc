// Gradients, stage project: from the sums of each splat back to its Gaussian, for static pinhole cameras. One workgroup
// per cluster view, as `project`, and one dispatch per view: each adds to what the views before it gave. Twin of
// `src/render/cpu/project/gradient`; the formulas are there.

#import project
#import splat_sums

@group(0) @binding(15) var<storage, read> splat_sums: array<SplatSums>;
// For each cluster view, the first of its cluster's lines in `gradients`.
@group(0) @binding(16) var<storage, read> first_lines: array<u32>;
// Lines of a value of each of a cluster's Gaussians: a line for each column of a chunk.
@group(0) @binding(17) var<storage, read_write> gradients: array<f32>;
// For each cluster view, the derivatives by the view's twist: rho, then phi.
@group(0) @binding(18) var<storage, read_write> twists: array<f32>;

// Lines of a cluster, as the columns in `src/scene/chunk.rs`.
const MEAN_LINE: u32 = 0u;
const SCALE_LINE: u32 = 3u;
const QUAT_LINE: u32 = 6u;
const LOG2_OPACITY_LINE: u32 = 10u;
const SH_LINE: u32 = 11u;

const LN_2: f32 = 0.69314718055994530942;
// `PixelFilter::SHRINK_POWER`.
const SHRINK_POWER: f32 = 0.5;
const MIN_BLUR_SHARE: f32 = 0.005 * 0.005;

// Derivatives by a twist of the view.
struct Twist {
    rho: vec3f,
    phi: vec3f,
}

var<workgroup> rhos: array<vec3f, CLUSTER>;
var<workgroup> phis: array<vec3f, CLUSTER>;
// The value of the thread's Gaussian in the first line of its cluster.
var<private> first_value: u32;

@compute @workgroup_size(CLUSTER)
fn back_project(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let cluster_view_index = page_cluster_views[span.first + index];
    first_value = first_lines[cluster_view_index] * CLUSTER + thread;
    var twist = Twist();
    let slot = splat_slot(cluster_view_index, thread);
    if slot != INVISIBLE {
        twist = back_project_splat(slot, cluster_views[cluster_view_index], thread);
    }
    // The sums of the cluster, in pairs.
    rhos[thread] = twist.rho;
    phis[thread] = twist.phi;
    for (var half = CLUSTER / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if thread < half {
            rhos[thread] += rhos[thread + half];
            phis[thread] += phis[thread + half];
        }
    }
    if thread == 0u {
        let at = 6u * cluster_view_index;
        for (var axis = 0u; axis < 3u; axis++) {
            twists[at + axis] = rhos[0][axis];
            twists[at + 3u + axis] = phis[0][axis];
        }
    }
}

fn back_project_splat(slot: u32, cluster_view: ClusterView, thread: u32) -> Twist {
    let view = chunk_views[cluster_view.chunk_view];
    let gaussian = geometry(cluster_view.line, thread);
    let sums = splat_sums[slot];
    let factor = shapes[slot].factor;

    // The projection once more, as in `pinhole.wgsl`: keeping it would take 100 B for each splat.
    let mean = vec4f(gaussian.mean_m, 1.0);
    let x = dot(view.camera_from_chunk[0], mean);
    let y = dot(view.camera_from_chunk[1], mean);
    let exact_m = exact_z(gaussian.mean_m, view);
    let z = exact_m.x + exact_m.y;
    let slope = vec2f(x, y) / z;
    let clamped = clamp(slope, view.slope_min, view.slope_max);
    let px_per_m = view.focal_px / z;
    let right = view.camera_from_chunk[0].xyz;
    let down = view.camera_from_chunk[1].xyz;
    let forward = view.camera_from_chunk[2].xyz;
    let axes = rotation_from_quat(gaussian.quat_wxyz);
    let row_x = (right - clamped.x * forward) * px_per_m.x;
    let row_y = (down - clamped.y * forward) * px_per_m.y;
    let v0 = row_x * axes * gaussian.scale_m;
    let v1 = row_y * axes * gaussian.scale_m;

    // By the rows of the root: through the total covariance, which also has the opacity's scale, and through the others.
    let scale = opacity_scale(v0, v1, sums.g, index_of_view(view));
    let uu = sums.uu - scale.total / LN_2;
    let vv = sums.vv - scale.total / LN_2;
    let w_u = factor.x * v0 + factor.y * v1;
    let w_v = factor.z * v1;
    let z_u = 4.0 * LN_2 * LN_2 * (uu * w_u + sums.uv * w_v);
    let z_v = 4.0 * LN_2 * LN_2 * (sums.uv * w_u + vv * w_v);
    let filter_0 = scale.by_before_0 + 2.0 * (scale.by_native.x * v0 + scale.by_native.y * v1);
    let filter_1 = scale.by_before_1 + 2.0 * (scale.by_native.y * v0 + scale.by_native.z * v1);
    let by_v0 = factor.x * z_u + filter_0;
    let by_v1 = factor.y * z_u + factor.z * z_v + filter_1;
    let by_ln_scale = w_u * z_u + w_v * z_v + filter_0 * v0 + filter_1 * v1;
    let q_x = axes * (by_v0 * gaussian.scale_m);
    let q_y = axes * (by_v1 * gaussian.scale_m);
    let torque = cross(q_x, row_x) + cross(q_y, row_y);

    // By the centre, in the camera's axes.
    let by_px = 2.0 * LN_2 * vec2f(factor.x * sums.u, factor.y * sums.u + factor.z * sums.v);
    let is_free = (slope >= view.slope_min) & (slope <= view.slope_max);
    let of_shape = select(vec2f(0.0), vec2f(dot(q_x, forward), dot(q_y, forward)) / z, is_free);
    let by_slope = view.focal_px * (by_px - of_shape);
    let along = dot(by_slope, slope) + dot(q_x, row_x) + dot(q_y, row_y);
    let by_point = vec3f(by_slope / z, sums.depth - along / z);

    let by_toward = back_project_color(slot, cluster_view, gaussian.mean_m, thread, sums);
    add3(MEAN_LINE, by_point.x * right + by_point.y * down + by_point.z * forward + by_toward);
    add3(SCALE_LINE, by_ln_scale);
    // 2 (0, t) q.
    let twice = 2.0 * torque;
    let v = gaussian.quat_wxyz.yzw;
    add(QUAT_LINE, -dot(twice, v));
    add3(QUAT_LINE + 1u, gaussian.quat_wxyz.x * twice + cross(twice, v));
    add(LOG2_OPACITY_LINE, LN_2 * sums.g);

    let to_camera = mat3x3f(
        vec3f(right.x, down.x, forward.x),
        vec3f(right.y, down.y, forward.y),
        vec3f(right.z, down.z, forward.z),
    );
    let point = vec3f(x, y, z);
    return Twist(by_point + to_camera * by_toward, cross(point, by_point) + to_camera * torque);
}

// The derivatives through the scales of the opacity: powers of shares of determinants.
struct OpacityScale {
    // Share of g that has the total covariance's determinant with a minus.
    total: f32,
    // By the rows of the root.
    by_before_0: vec3f,
    by_before_1: vec3f,
    // By the covariance (xx, xy, yy).
    by_native: vec3f,
}

fn opacity_scale(v0: vec3f, v1: vec3f, g: f32, view: u32) -> OpacityScale {
    let image = frame.view[view];
    let is_shrunk = any(image.native_px2 != image.total_px2);
    // A splat so wide that its determinant leaves f32 is not changed by any filter.
    let is_measured = max(max_component(abs(v0)), max_component(abs(v1))) <= MAX_SIGMA_PX;
    if !is_measured || (frame.antialiased == 0u && !is_shrunk) {
        return OpacityScale();
    }
    let minors = cross(v0, v1);
    let det_before = dot(minors, minors);
    let native = image.native_px2;
    let xx = dot(v0, v0);
    let xy = dot(v0, v1);
    let yy = dot(v1, v1);
    let det_native = native.x * (yy + native.y) + (native.y * xx + det_before);
    let is_scaled = frame.antialiased != 0u && det_before / det_native > MIN_BLUR_SHARE;
    let before = select(0.0, 0.5 * g, is_scaled);
    let shrink = select(0.0, SHRINK_POWER * g, is_shrunk);
    let per_det = select(0.0, 2.0 * before / det_before, is_scaled);
    let by_native = (shrink - before) / det_native;
    return OpacityScale(
        shrink,
        per_det * cross(v1, minors),
        per_det * cross(minors, v0),
        by_native * vec3f(yy + native.y, -xy, xx + native.x),
    );
}

// The derivatives by the vector from the camera to the centre; adds those by the coefficients. A colour that is clamped at
// 0 has none.
fn back_project_color(slot: u32, cluster_view: ClusterView, mean_m: vec3f, thread: u32, sums: SplatSums) -> vec3f {
    let lit_by = lit(vec3f(sums.red, sums.green, sums.blue), cluster_view.chunk_view, mean_m);
    let by = select(vec3f(0.0), lit_by, colors[slot].rgb > vec3f(0.0));
    add3(SH_LINE, 0.28209479177387814 * by);
    if SH_DEGREE == 0u {
        return vec3f(0.0);
    }
    let scale = float(cluster_view.line * SOA_BLOCK + 1u);
    let at = first_word(cluster_view.line, thread) + GEOMETRY_WORDS * SOA_BLOCK;
    let toward = mean_m - chunk_views[cluster_view.chunk_view].camera_m;
    let inverse_length = 1.0 / sqrt(max(dot(toward, toward), 1e-30));
    let d = toward * inverse_length;
    // As in `color` of `project.wgsl`, with the derivatives of each basis function by x, y and z.
    let c1 = 0.4886025119029199;
    var by_d = term(1u, -c1 * d.y, vec3f(0.0, -c1, 0.0), at, by)
        + term(2u, c1 * d.z, vec3f(0.0, 0.0, c1), at, by)
        + term(3u, -c1 * d.x, vec3f(-c1, 0.0, 0.0), at, by);
    if SH_DEGREE > 1u {
        by_d += second_band_gradient(at, d, by);
    }
    if SH_DEGREE > 2u {
        by_d += third_band_gradient(at, d, by);
    }
    // d/|d| has the derivative (I - d dᵀ)/|d|. The coefficients are fractions of `scale`.
    return (by_d - dot(d, by_d) * d) * (scale * inverse_length);
}

fn second_band_gradient(at: u32, d: vec3f, by: vec3f) -> vec3f {
    let dd = d * d;
    let a = 1.0925484305920792;
    let c = 0.31539156525252005;
    let e = 0.5462742152960396;
    return term(4u, a * d.x * d.y, a * vec3f(d.y, d.x, 0.0), at, by)
        + term(5u, -a * d.y * d.z, -a * vec3f(0.0, d.z, d.y), at, by)
        + term(6u, c * (2.0 * dd.z - dd.x - dd.y), 2.0 * c * vec3f(-d.x, -d.y, 2.0 * d.z), at, by)
        + term(7u, -a * d.x * d.z, -a * vec3f(d.z, 0.0, d.x), at, by)
        + term(8u, e * (dd.x - dd.y), 2.0 * e * vec3f(d.x, -d.y, 0.0), at, by);
}

fn third_band_gradient(at: u32, d: vec3f, by: vec3f) -> vec3f {
    let dd = d * d;
    let in_plane = dd.x - dd.y;
    let across = 4.0 * dd.z - dd.x - dd.y;
    let a = -0.5900435899266435;
    let b = 2.890611442640554;
    let c = -0.4570457994644658;
    let e = 0.3731763325901154;
    let f = 1.445305721320277;
    return term(9u, a * d.y * (3.0 * dd.x - dd.y), 3.0 * a * vec3f(2.0 * d.x * d.y, in_plane, 0.0), at, by)
        + term(10u, b * d.x * d.y * d.z, b * vec3f(d.y * d.z, d.x * d.z, d.x * d.y), at, by)
        + term(11u, c * d.y * across, c * vec3f(-2.0 * d.x * d.y, across - 2.0 * dd.y, 8.0 * d.y * d.z), at, by)
        + term(
            12u,
            e * d.z * (2.0 * dd.z - 3.0 * (dd.x + dd.y)),
            3.0 * e * vec3f(-2.0 * d.x * d.z, -2.0 * d.y * d.z, 2.0 * dd.z - dd.x - dd.y),
            at,
            by,
        )
        + term(13u, c * d.x * across, c * vec3f(across - 2.0 * dd.x, -2.0 * d.x * d.y, 8.0 * d.x * d.z), at, by)
        + term(14u, f * d.z * in_plane, f * vec3f(2.0 * d.x * d.z, -2.0 * d.y * d.z, in_plane), at, by)
        + term(15u, a * d.x * (dd.x - 3.0 * dd.y), 3.0 * a * vec3f(in_plane, -2.0 * d.x * d.y, 0.0), at, by);
}

// Coefficient `k`, with the value and the derivatives of its basis function: adds the derivative by it, and returns those
// by the direction, as a fraction of the largest coefficient.
fn term(k: u32, basis: f32, by_direction: vec3f, at: u32, by: vec3f) -> vec3f {
    add3(SH_LINE + 3u * k, basis * by);
    return dot(coefficient(at, k), by) * by_direction;
}

fn add(line: u32, value: f32) {
    gradients[first_value + line * CLUSTER] += value;
}

fn add3(line: u32, value: vec3f) {
    add(line, value.x);
    add(line + 1u, value.y);
    add(line + 2u, value.z);
}
