//! Mutations of each stage's shader, which the comparisons of stages and images must detect: a
//! comparison that cannot fail proves nothing.

use glam::DVec3;
use wildcity_render::View;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_scene::Gaussians;

use crate::images::view_along;
use crate::streets::{street, street_views};

/// A mutation of a shader.
#[derive(Debug)]
pub(crate) struct Mutation {
    /// The shader.
    pub(crate) shader: &'static str,
    /// The text that is replaced.
    pub(crate) original: &'static str,
    /// Its replacement.
    pub(crate) replacement: &'static str,
    /// The stages that are wrong with this mutation: more than one if they share the shader.
    pub(crate) stages: &'static [&'static str],
}

const fn mutation(
    shader: &'static str,
    original: &'static str,
    replacement: &'static str,
    stages: &'static [&'static str],
) -> Mutation {
    Mutation { shader, original, replacement, stages }
}

const PROJECT: &[&str] = &["project"];
const SORT: &[&str] = &["sort"];
const BIN: &[&str] = &["bin"];
const RASTERIZE: &[&str] = &["rasterize"];
const SORTS: &[&str] = &["sort", "bin"];

pub(crate) const MUTATIONS: &[Mutation] = &[
    mutation(
        "project",
        "let clamped = clamp(slope, view.slope_min, view.slope_max);",
        "let clamped = slope * 0.9;",
        PROJECT,
    ),
    mutation("project", "-(foot.covariance.y * l2)", "(foot.covariance.y * l2)", PROJECT),
    mutation("project", "x.y + turn.z", "x.y - turn.z", PROJECT),
    mutation("project", "(high & 0xFFu) << 12u", "(high & 0xFFu) << 11u", PROJECT),
    mutation("project", "2.890611442640554", "2.0", PROJECT),
    mutation("project", "-d.y * coefficient(at, 1u)", "d.y * coefficient(at, 1u)", PROJECT),
    mutation("project", "min(depth, (1u << DEPTH_BITS) - 1u)", "0u", PROJECT),
    mutation(
        "project",
        "(own_word & own_bit) == 0u",
        "(own_word & own_bit & 0x7FFFFFFFu) == 0u",
        PROJECT,
    ),
    mutation(
        "scan",
        "sum = saturating_add(sum, before);",
        "sum = max(sum, before);",
        &["project", "sort", "bin"],
    ),
    mutation(
        "scan",
        "block_sums[count] = before;",
        "block_sums[count] = before / 2u;",
        &["project", "bin"],
    ),
    mutation(
        "sort",
        "countOneBits(beside & (own_bit - 1u))",
        "countOneBits(beside & own_bit) - 1u",
        SORTS,
    ),
    mutation("sort", "place = next[own_digit]", "place = offsets[own_digit]", SORTS),
    mutation("sort", "is_last = after == 0u", "is_last = beside == own_bit", SORTS),
    // The numbers of macro tiles have no third digit here.
    mutation("sort", "(key >> SHIFT)", "(key >> min(SHIFT, 16u))", SORT),
    mutation("bin", "u32(columns.y) / TILE_PX + 1u", "u32(columns.y) / TILE_PX", BIN),
    mutation("bin", "- first_column + 1u", "- first_column", BIN),
    mutation("bin", "1u << (end - left)", "1u << (end - left - 1u)", BIN),
    mutation("bin", "<< (k * MACRO_COLUMNS)", "<< (k * 7u)", BIN),
    mutation(
        "bin",
        "half_width(reach, right_dy) + EXTENT_SLACK_PX",
        "0.7 * half_width(reach, right_dy)",
        BIN,
    ),
    mutation("bin", "i - prefix_before(band_index)", "i", BIN),
    mutation("sort", "sorted_masks[to] = masks[i]", "sorted_masks[to] = masks[to]", BIN),
    mutation("ranges", "own + 1u] = i + 1u", "own + 1u] = i", BIN),
    mutation("expand", "own.stride] = atomicLoad(&counts[thread])", "own.stride] = 0u", BIN),
    mutation("expand", "first_batches[middle] <= number", "first_batches[middle] < number", BIN),
    mutation("expand", "index + 1u == stride", "index == 0u", BIN),
    mutation("expand", "word_starts[word] = next", "word_starts[word] = first", BIN),
    mutation("expand", "& (own_bit - 1u)", "& ~(own_bit | (own_bit - 1u))", BIN),
    mutation("expand", "k / MACRO_COLUMNS", "k / 4u", BIN),
    mutation(
        "rasterize",
        "after > vec4f(frame.stop)",
        "after > vec4f(100.0 * frame.stop)",
        RASTERIZE,
    ),
    mutation(
        "rasterize",
        "instance_splats[first + k]",
        "instance_splats[first + (k ^ 1u)]",
        RASTERIZE,
    ),
    mutation("rasterize", "(*sums).green = fma(weight", "(*sums).green = fma(alpha", RASTERIZE),
    mutation("rasterize", "(2u << high.x)", "(1u << high.x)", RASTERIZE),
    mutation("rasterize", "0x1111u", "0x0111u", RASTERIZE),
    mutation("rasterize", "<< (2u * i)", "<< i", RASTERIZE),
    mutation("rasterize", "<< (i * BLOCKS)", "<< 0u", RASTERIZE),
    mutation(
        "rasterize",
        "exponents(b, splat_offsets(b, at_px))",
        "exponents(a, splat_offsets(a, at_px))",
        RASTERIZE,
    ),
    mutation("rasterize", "vec4f(0.0, 1.0, 2.0, 3.0)", "vec4f(0.0, 1.0, 3.0, 2.0)", RASTERIZE),
    mutation("rasterize", "sums.depth / select", "sums.depth * select", RASTERIZE),
    mutation("rasterize", "vec4f(255.0)", "vec4f(250.0)", RASTERIZE),
];

/// Mutations of lenses and rolling shutters: an expression of `project_unscented`, and a different
/// one of its type; or a statement, which is left out.
pub(crate) const LENS_MUTATIONS: &[(&str, &str)] = &[
    ("0.07902598 * square", "0.0 * square"),
    ("select(0.0, 0.25 * HALF_TURN, steep)", "0.0"),
    ("off_axis < end * inside.z", "off_axis < 0.5 * end * inside.z"),
    ("azimuth * (end + (1.0 + end * end) * beyond_rad)", "azimuth * (end + end * beyond_rad)"),
    ("2.0 * slope.x * slope.y * factor.y", "slope.x * slope.y * factor.y"),
    ("p.yx * (r2 + 2.0 * slope * slope)", "p * (r2 + 2.0 * slope * slope)"),
    ("(s.xz + s.yw * r2) * r2", "(s.xy + s.zw * r2) * r2"),
    (
        "lenses[view_index].center_px + linear(view_index) * plane",
        "lenses[view_index].center_px + plane * linear(view_index)",
    ),
    ("max(x - end, 0.0)", "0.0"),
    ("at.x > y", "at.x < y"),
    (
        "end + (y - top) / lenses[view_index].end_slope",
        "end - (y - top) / lenses[view_index].end_slope",
    ),
    ("wanted != given", "wanted == given"),
    ("saturate((z - 0.05) / 0.1) * sum", "sum"),
    ("sines * sine(by, 0.5).xy", "sines"),
    ("plane.x * at_px.x + plane.y * at_px.y", "plane.x * at_px.y + plane.y * at_px.x"),
    ("2.0 * sines.y * sines.y", "sines.y * sines.y"),
    ("remaining_exposure(view_index, point.at_px)", "guess"),
    ("(1.0 / ROOT_3)", "0.0"),
    ("center.fraction * lenses[lens].moved_world_m", "vec3f(0.0)"),
    ("off_axis_rad <= lenses[lens].widest_rad", "off_axis_rad <= 0.5 * lenses[lens].widest_rad"),
    (
        "moved_m.z + rotation_shift(index_of_lens(view), at_end_m + moved_m, fraction).z",
        "moved_m.z",
    ),
    ("sum.x + (sum.y + exact_m.y)", "sum.x"),
    ("2.0 * moved.x * (offset.y + moved.y - view.depth_low[axis])", "0.0"),
    ("(((sum - square.x) - square.y) + lost) / max(2.0 * root, 1e-30)", "0.0"),
    ("k < i", "k < 1u"),
    ("vec2f(-azimuth.y, azimuth.x)", "azimuth"),
    (
        "vec4f(alpha, beta, radius.z, (alpha * cosine - beta) * per_sine)",
        "vec4f(beta, beta, 0.0, 0.0)",
    ),
    (
        "vec3f(by_x, -dot(inside.xy, by_x) * per_z)",
        "vec3f(1.1 * by_x, -dot(inside.xy, by_x) * per_z)",
    ),
    ("expansion.plane *= jacobian(view_index, slope);", ""),
    ("abc += moment * shutter.rolls * shutter.motion;", ""),
    ("expanded.shift_px += bend;", ""),
];

/// The shaders with all of [`LENS_MUTATIONS`], of which a frame chooses one by its profile's `far`:
/// [`far_of_lens_mutation`]. Software Vulkan takes seconds to compile `project_unscented`, so it is
/// compiled once.
pub(crate) fn shaders_with_lens_mutations() -> Shaders {
    let mut shaders = Shaders::default();
    let mut replace = |original: &str, replacement: &str| {
        let replaced = shaders.clone().with_mutation("project_unscented", original, replacement);
        shaders = replaced.unwrap_or_else(|| panic!("the shader has no text {original:?}"));
    };
    for (number, (original, other)) in LENS_MUTATIONS.iter().enumerate() {
        let is_chosen = format!("frame.far_m == {:?}", far_of_lens_mutation(number));
        if original.ends_with(';') {
            replace(original, &format!("if !({is_chosen}) {{ {original} }}"))
        } else {
            replace(original, &format!("select({original}, {other}, {is_chosen})"))
        }
    }
    shaders
}

/// The `far` of a profile that chooses a mutation, in metres. It lies beyond the scene, so that it
/// changes nothing else.
pub(crate) fn far_of_lens_mutation(number: usize) -> f32 {
    50_000.0 + number as f32
}

/// A street of SH degree 3 with large translucent Gaussians, some over more macro tiles than one
/// thread emits.
pub(crate) fn misty_street(n: usize) -> Gaussians {
    let mut street = street(n, 3, 41);
    for i in (0..n).step_by(1_000) {
        street.ln_scales[i] = [2.0; 3];
        street.logit_opacities[i] = -3.0;
    }
    street
}

/// The street's views, and one with many macro tiles.
pub(crate) fn wide_views() -> Vec<View> {
    let [first, ..] = street_views();
    let wide =
        view_along([700, 300], 400.0, first.world_from_camera.position_m, DVec3::Z, DVec3::Y);
    street_views().into_iter().chain([wide]).collect()
}
