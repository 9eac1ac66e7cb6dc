// Stage project: projects 3D Gaussians to splats on the images of all views, one workgroup per cluster
// view (one cluster of 256 Gaussians in one view). Cluster views are in order of (view, global id).
//
// `cull` decides which Gaussians are visible and counts them, a prefix sum over the cluster views gives
// each the index of its first splat, and `project` writes the visible splats, so that splats keep the
// order of their cluster views. Twin of `src/render/cpu/project`, where the equations are documented.
// `PROJECTION` stands for `pinhole` (static pinhole cameras) or `unscented` (lenses and rolling
// shutters), and `ACTORS` for `actors` (chunks of actors, and those of the twin beneath them) or
// `no_actors`.

#import constants
#import layout
#import math
#import splat_slot
#import ACTORS
#import PROJECTION

override SH_DEGREE: u32;

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> page_cluster_views: array<u32>;
@group(0) @binding(3) var<storage, read> cluster_views: array<ClusterView>;
@group(0) @binding(4) var<storage, read> chunk_views: array<ChunkView>;
@group(0) @binding(5) var<storage, read> gaussians: array<u32>;
@group(0) @binding(6) var<storage, read_write> visible: array<u32>;
@group(0) @binding(7) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(8) var<storage, read_write> shapes: array<SplatShape>;
@group(0) @binding(9) var<storage, read_write> colors: array<SplatColor>;
@group(0) @binding(10) var<storage, read_write> keys: array<u32>;
@group(0) @binding(11) var<storage, read_write> splat_indices: array<u32>;

var<workgroup> mask: array<atomic<u32>, MASK_WORDS>;

@compute @workgroup_size(CLUSTER)
fn cull(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let cluster_view_index = page_cluster_views[span.first + index];
    let cluster_view = cluster_views[cluster_view_index];
    if thread < MASK_WORDS {
        atomicStore(&mask[thread], 0u);
    }
    workgroupBarrier();
    // The header's third word is the number of Gaussians; after the last one lie other clusters.
    if thread < gaussians[cluster_view.line * SOA_BLOCK + 2u]
        && project_shape(geometry(cluster_view.line, thread), chunk_views[cluster_view.chunk_view], false).visible {
        atomicOr(&mask[thread / 32u], 1u << (thread % 32u));
    }
    workgroupBarrier();
    if thread < MASK_WORDS {
        visible[cluster_view_index * MASK_WORDS + thread] = atomicLoad(&mask[thread]);
    }
    if thread == 0u {
        var count = 0u;
        for (var word = 0u; word < MASK_WORDS; word++) {
            count += countOneBits(atomicLoad(&mask[word]));
        }
        offsets[cluster_view_index] = count;
    }
}

@compute @workgroup_size(CLUSTER)
fn project(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let cluster_view_index = page_cluster_views[span.first + index];
    let cluster_view = cluster_views[cluster_view_index];
    // `INVISIBLE` is beyond any capacity.
    let slot = splat_slot(cluster_view_index, thread);
    if slot >= frame.splat_capacity {
        return;
    }
    let chunk_view = chunk_views[cluster_view.chunk_view];
    let gaussian = geometry(cluster_view.line, thread);
    let projected = project_shape(gaussian, chunk_view, true);
    shapes[slot] = projected.shape;
    let stored = color(cluster_view.line, thread, projected.from_camera_m);
    let rgb = lit(stored, cluster_view.chunk_view, gaussian.mean_m);
    colors[slot] = SplatColor(rgb, projected.depth_m);
    let depth = bitcast<u32>(max(projected.depth_m, frame.near_m)) - bitcast<u32>(frame.near_m);
    keys[slot] = (index_of_view(chunk_view) << DEPTH_BITS) | min(depth, (1u << DEPTH_BITS) - 1u);
    splat_indices[slot] = slot;
}

// A splat, and the inputs of its key and its colour.
struct Projected {
    visible: bool,
    shape: SplatShape,
    depth_m: f32,
    // From the camera's centre to the Gaussian's, in world axes.
    from_camera_m: vec3f,
}

// A Gaussian on the image, before the blur, in a unit of which `units_per_px` are a pixel.
struct Footprint {
    mean_px: vec2f,
    // xx, xy, yy, and their determinant, which is computed as a sum of squares: it cannot become
    // negative.
    covariance: vec3f,
    det_unblurred: f32,
    units_per_px: f32,
}

// The shape of a footprint after the pixel filter (`PixelFilter` in `src/render/layout.rs`), and whether any
// of it lies on the rows that are drawn. A native image has its own branch, which keeps its bytes.
fn splat_shape(foot: Footprint, gaussian_log2_opacity: f32, view: u32) -> Projected {
    let image = frame.view[view];
    let units2 = foot.units_per_px * foot.units_per_px;
    let blur = image.total_px2.x * foot.units_per_px * foot.units_per_px;
    let xx = foot.covariance.x;
    let yy = foot.covariance.z;
    var det = blur * (xx + yy + blur) + foot.det_unblurred;
    let a = xx + blur;
    var c = yy + blur;
    var det_native = det;
    var log2_opacity = gaussian_log2_opacity;
    if any(image.native_px2 != image.total_px2) {
        det_native = det_with(foot, image.native_px2 * units2);
        det = det_with(foot, image.total_px2 * units2);
        c = yy + image.total_px2.y * units2;
        log2_opacity += 0.5 * log2(det_native / det);
    }
    if frame.antialiased != 0u {
        log2_opacity += 0.5 * log2(max(foot.det_unblurred / det_native, 0.005 * 0.005));
    }
    let unit = 0.8493218 * foot.units_per_px; // sqrt(log2(e) / 2)
    let root_c = sqrt(c);
    let root_det = sqrt(det);
    let l2 = unit / root_c;
    let l0 = unit * root_c / root_det;
    let l1 = -(foot.covariance.y * l2) / root_det;

    // The box in which alpha reaches alpha_cut, against the pixel centres of the rows that are drawn.
    let power = log2_opacity - frame.log2_alpha_cut;
    let reach = sqrt(max(power, 0.0)) / unit;
    let extent_px = reach * vec2f(sqrt(a), root_c) + EXTENT_SLACK_PX;
    let first_px = vec2u(0u, image.rows.x * TILE_PX);
    let end_px = vec2u(image.size_px.x, min(image.rows.y * TILE_PX, image.size_px.y));
    let on_image = all(foot.mean_px + extent_px >= vec2f(first_px) + 0.5)
        && all(foot.mean_px - extent_px <= vec2f(end_px) - 0.5);
    let shape = SplatShape(foot.mean_px, extent_px, vec3f(l0, l1, l2), log2_opacity);
    return Projected(power >= 0.0 && on_image, shape, 0.0, vec3f(0.0));
}

// Determinant of a footprint's covariance with two variances added along x and y.
fn det_with(foot: Footprint, add: vec2f) -> f32 {
    return add.x * (foot.covariance.z + add.y) + (add.y * foot.covariance.x + foot.det_unblurred);
}

// A product and its rounding error (TwoProduct, Dekker 1971). `fma` would be shorter, but WGSL allows it
// to round twice, and lavapipe's does.
fn two_product(a: f32, b: f32) -> vec2f {
    let rounds_to = a * b;
    let p = split(a);
    let q = split(b);
    return vec2f(rounds_to, ((p.x * q.x - rounds_to) + p.x * q.y + p.y * q.x) + p.y * q.y);
}

// A sum and its rounding error (TwoSum, Knuth).
fn two_sum(a: f32, b: f32) -> vec2f {
    let next = keep_rounding(a + b);
    let part = keep_rounding(next - a);
    return vec2f(next, (a - (next - part)) + (b - part));
}

// Camera-space z at the end of the exposure as a pair (z, rounding error), in metres: a compensated dot
// product. The sum of both is rounded only once. Splats are blended in order of depth, and surfels of
// one facade, which have equal depths, must not be ordered by rounding errors.
fn exact_z(mean: vec3f, view: ChunkView) -> vec2f {
    var sum = view.depth_high.w;
    var lost = view.depth_low.w;
    for (var axis = 0; axis < 3; axis++) {
        let term = two_product(mean[axis], view.depth_high[axis]);
        lost += term.y;
        lost += mean[axis] * view.depth_low[axis];
        let next = two_sum(sum, term.x);
        lost += next.y;
        sum = next.x;
    }
    return vec2f(sum, lost);
}

// Forces the compiler to round the argument. WGSL has no `precise`, and Mesa simplifies (a + b) - a to
// b; a `max` with a number that no depth reaches stops it.
fn keep_rounding(x: f32) -> f32 {
    return max(x, -3e38);
}

// Splits a number into a sum of two with 12 significant bits each; products of those are exact in the
// 24 bits of f32.
fn split(x: f32) -> vec2f {
    let high = bitcast<f32>(bitcast<u32>(x) & 0xFFFFF000u);
    return vec2f(high, x - high);
}

fn max_component(v: vec3f) -> f32 {
    return max(v.x, max(v.y, v.z));
}

// Rotation matrix (world from the Gaussian's axes) of a unit quaternion.
fn rotation_from_quat(wxyz: vec4f) -> mat3x3f {
    let w = wxyz.x;
    let x = 2.0 * wxyz.y * wxyz.yzw;
    let y = 2.0 * wxyz.z * wxyz.yzw;
    let z = 2.0 * wxyz.w * wxyz.yzw;
    let turn = 2.0 * w * wxyz.yzw;
    return mat3x3f(
        vec3f(1.0 - y.y - z.z, x.y + turn.z, x.z - turn.y),
        vec3f(x.y - turn.z, 1.0 - x.x - z.z, y.z + turn.x),
        vec3f(x.z + turn.y, y.z - turn.x, 1.0 - x.x - y.y),
    );
}

// A Gaussian without its colour, in its chunk's frame.
struct Geometry {
    mean_m: vec3f,
    scale_m: vec3f,
    log2_opacity: f32,
    quat_wxyz: vec4f,
}

// Decodes a Gaussian of a cluster; the format is documented in `src/render/gpu/mirror/encode.rs`.
fn geometry(line: u32, thread: u32) -> Geometry {
    var at = first_word(line, thread);
    var gaussian: Geometry;
    gaussian.mean_m = vec3f(float(at), float(at + SOA_BLOCK), float(at + 2u * SOA_BLOCK));
    at += 3u * SOA_BLOCK;
    gaussian.scale_m = vec3f(float(at), float(at + SOA_BLOCK), float(at + 2u * SOA_BLOCK));
    gaussian.log2_opacity = float(at + 3u * SOA_BLOCK);
    gaussian.quat_wxyz = quat_from_bits(gaussians[at + 4u * SOA_BLOCK], gaussians[at + 5u * SOA_BLOCK]);
    return gaussian;
}

// Decodes a unit quaternion: the three smaller components in 20 bits each, and the index of the largest
// one, which is positive.
fn quat_from_bits(low: u32, high: u32) -> vec4f {
    let steps = vec3u(low & 0xFFFFFu, (low >> 20u) | ((high & 0xFFu) << 12u), (high >> 8u) & 0xFFFFFu);
    let small = (vec3f(steps) / 1048575.0 * 2.0 - 1.0) * 0.70710678;
    let large = sqrt(max(1.0 - dot(small, small), 0.0));
    switch high >> 28u {
        case 0u: { return vec4f(large, small); }
        case 1u: { return vec4f(small.x, large, small.yz); }
        case 2u: { return vec4f(small.xy, large, small.z); }
        default: { return vec4f(small, large); }
    }
}

// SH coefficients per colour channel.
fn coefficients() -> u32 {
    return (SH_DEGREE + 1u) * (SH_DEGREE + 1u);
}

// Index of the first word of a Gaussian. The cluster's header is its first line.
fn first_word(line: u32, thread: u32) -> u32 {
    let words = GEOMETRY_WORDS + (3u * coefficients() + 1u) / 2u;
    return (line + 1u + thread / SOA_BLOCK * words) * SOA_BLOCK + thread % SOA_BLOCK;
}

fn float(at: u32) -> f32 {
    return bitcast<f32>(gaussians[at]);
}

// `max(0, SH(direction) + 0.5)` in the direction of `toward`, which need not be a unit vector. The basis
// functions and their signs are those of Kerbl et al. 2023.
fn color(line: u32, thread: u32, toward: vec3f) -> vec3f {
    let scale = vec2f(float(line * SOA_BLOCK), float(line * SOA_BLOCK + 1u));
    let at = first_word(line, thread) + GEOMETRY_WORDS * SOA_BLOCK;
    var rgb = 0.28209479177387814 * scale.x * coefficient(at, 0u) + 0.5;
    if SH_DEGREE > 0u {
        let d = toward * (1.0 / sqrt(max(dot(toward, toward), 1e-30)));
        var sum = 0.4886025119029199
            * (-d.y * coefficient(at, 1u) + d.z * coefficient(at, 2u) - d.x * coefficient(at, 3u));
        if SH_DEGREE > 1u {
            sum += second_band(at, d);
        }
        if SH_DEGREE > 2u {
            sum += third_band(at, d);
        }
        rgb += scale.y * sum;
    }
    return max(rgb, vec3f(0.0));
}

fn second_band(at: u32, d: vec3f) -> vec3f {
    let dd = d * d;
    return 1.0925484305920792 * d.x * d.y * coefficient(at, 4u)
        - 1.0925484305920792 * d.y * d.z * coefficient(at, 5u)
        + 0.31539156525252005 * (2.0 * dd.z - dd.x - dd.y) * coefficient(at, 6u)
        - 1.0925484305920792 * d.x * d.z * coefficient(at, 7u)
        + 0.5462742152960396 * (dd.x - dd.y) * coefficient(at, 8u);
}

fn third_band(at: u32, d: vec3f) -> vec3f {
    let dd = d * d;
    return -0.5900435899266435 * d.y * (3.0 * dd.x - dd.y) * coefficient(at, 9u)
        + 2.890611442640554 * d.x * d.y * d.z * coefficient(at, 10u)
        - 0.4570457994644658 * d.y * (4.0 * dd.z - dd.x - dd.y) * coefficient(at, 11u)
        + 0.3731763325901154 * d.z * (2.0 * dd.z - 3.0 * (dd.x + dd.y)) * coefficient(at, 12u)
        - 0.4570457994644658 * d.x * (4.0 * dd.z - dd.x - dd.y) * coefficient(at, 13u)
        + 1.445305721320277 * d.z * (dd.x - dd.y) * coefficient(at, 14u)
        - 0.5900435899266435 * d.x * (dd.x - 3.0 * dd.y) * coefficient(at, 15u);
}

// Red, green, and blue of coefficient `k` as fractions of the cluster's largest value, two to a word.
fn coefficient(at: u32, k: u32) -> vec3f {
    let word = at + (3u * k / 2u) * SOA_BLOCK;
    let first = unpack2x16snorm(gaussians[word]);
    let second = unpack2x16snorm(gaussians[word + SOA_BLOCK]);
    return select(vec3f(first.y, second), vec3f(first, second.x), k % 2u == 0u);
}
