//! A comparison that cannot fail proves nothing: every stage is broken, and it must be noticed.

use glam::DVec3;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::{Backend, RenderError, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{agree, cpu, render, try_render, view_along};
use crate::streets::{street, street_views};

/// A fault to plant in a shader.
#[derive(Debug)]
pub(crate) struct Mutation {
    /// Which shader.
    pub(crate) shader: &'static str,
    /// What of it is replaced.
    pub(crate) part: &'static str,
    /// By what.
    pub(crate) text: &'static str,
    /// The stages that are wrong then: more than one where they share the shader.
    pub(crate) stages: &'static [&'static str],
}

const fn slip(
    shader: &'static str,
    part: &'static str,
    text: &'static str,
    stages: &'static [&'static str],
) -> Mutation {
    Mutation { shader, part, text, stages }
}

const PROJECT: &[&str] = &["project"];
const SORT: &[&str] = &["sort"];
const BIN: &[&str] = &["bin"];
const RASTERIZE: &[&str] = &["rasterize"];
const SORTS: &[&str] = &["sort", "bin"];

pub(crate) const MUTATIONS: &[Mutation] = &[
    slip(
        "project",
        "let clamped = clamp(slope, view.slope_min, view.slope_max);",
        "let clamped = slope * 0.9;",
        PROJECT,
    ),
    slip("project", "-(foot.covariance.y * l2)", "(foot.covariance.y * l2)", PROJECT),
    slip("project", "x.y + turn.z", "x.y - turn.z", PROJECT),
    slip("project", "(high & 0xFFu) << 12u", "(high & 0xFFu) << 11u", PROJECT),
    slip("project", "2.890611442640554", "2.0", PROJECT),
    slip("project", "-d.y * coefficient(at, 1u)", "d.y * coefficient(at, 1u)", PROJECT),
    slip("project", "min(depth, (1u << DEPTH_BITS) - 1u)", "0u", PROJECT),
    slip(
        "project",
        "(own_word & own_bit) == 0u",
        "(own_word & own_bit & 0x7FFFFFFFu) == 0u",
        PROJECT,
    ),
    slip(
        "scan",
        "sum = saturating_add(sum, before);",
        "sum = max(sum, before);",
        &["project", "sort", "bin"],
    ),
    slip(
        "scan",
        "block_sums[count] = before;",
        "block_sums[count] = before / 2u;",
        &["project", "bin"],
    ),
    slip(
        "sort",
        "countOneBits(beside & (own_bit - 1u))",
        "countOneBits(beside & own_bit) - 1u",
        SORTS,
    ),
    slip("sort", "place = next[own_digit]", "place = offsets[own_digit]", SORTS),
    slip("sort", "is_last = after == 0u", "is_last = beside == own_bit", SORTS),
    // Macro tiles have no third digit here.
    slip("sort", "(key >> SHIFT)", "(key >> min(SHIFT, 16u))", SORT),
    slip("bin", "u32(columns.y) / TILE_PX + 1u", "u32(columns.y) / TILE_PX", BIN),
    slip("bin", "- first_column + 1u", "- first_column", BIN),
    slip("bin", "1u << (end - left)", "1u << (end - left - 1u)", BIN),
    slip("bin", "<< (k * MACRO_COLUMNS)", "<< (k * 7u)", BIN),
    slip(
        "bin",
        "half_width(reach, right_dy) + EXTENT_SLACK_PX",
        "0.7 * half_width(reach, right_dy)",
        BIN,
    ),
    slip("bin", "i - prefix_before(holder)", "i", BIN),
    slip("sort", "sorted_masks[to] = masks[i]", "sorted_masks[to] = masks[to]", BIN),
    slip("ranges", "ranges[own].y = i + 1u", "ranges[own].y = i", BIN),
    slip("expand", "offsets[tile] = atomicLoad(&counts[thread])", "offsets[tile] = 0u", BIN),
    slip("expand", "word_starts[word] = next", "word_starts[word] = first", BIN),
    slip("expand", "& (own_bit - 1u)", "& ~(own_bit | (own_bit - 1u))", BIN),
    slip("expand", "k / MACRO_COLUMNS", "k / 4u", BIN),
    slip("rasterize", "after > vec4f(frame.stop)", "after > vec4f(100.0 * frame.stop)", RASTERIZE),
    slip("rasterize", "instance_places[first + k]", "instance_places[first + (k ^ 1u)]", RASTERIZE),
    slip("rasterize", "sums.green += weight", "sums.green += alpha", RASTERIZE),
    slip("rasterize", "vec4f(0.0, 1.0, 2.0, 3.0)", "vec4f(0.0, 1.0, 3.0, 2.0)", RASTERIZE),
    slip("rasterize", "sums.depth / select", "sums.depth * select", RASTERIZE),
    slip("rasterize", "saturate(linear) * 255.0", "saturate(linear) * 250.0", RASTERIZE),
];

/// Faults of lenses and shutters: what of `project_bent` is replaced, by what.
pub(crate) const LENS_MUTATIONS: &[(&str, &str)] = &[
    ("0.07902598 * square", "0.0 * square"),
    ("select(0.0, 0.25 * HALF_TURN, steep)", "0.0"),
    ("off_axis < end * inside.z", "off_axis < 0.5 * end * inside.z"),
    ("azimuth * (end + (1.0 + end * end) * beyond_rad)", "azimuth * (end + end * beyond_rad)"),
    (
        "let across = 2.0 * slope.x * slope.y * factor.y",
        "let across = slope.x * slope.y * factor.y",
    ),
    ("p.yx * (r2 + 2.0 * slope * slope)", "p * (r2 + 2.0 * slope * slope)"),
    ("(s.xz + s.yw * r2) * r2", "(s.xy + s.zw * r2) * r2"),
    (
        "lenses[of_view].center_px + linear(of_view) * plane",
        "lenses[of_view].center_px + plane * linear(of_view)",
    ),
    ("max(x - end, 0.0)", "0.0"),
    ("if at.x > y {", "if at.x < y {"),
    ("end + (y - top)", "end - (y - top)"),
    ("if way != has {", "if way == has {"),
    ("saturate((z - 0.05) / 0.1) * sum", "sum"),
    ("sines * sine(by, 0.5).xy", "sines"),
    ("along.x * at_px.x + along.y * at_px.y", "along.x * at_px.y + along.y * at_px.x"),
    ("2.0 * sines.y * sines.y", "sines.y * sines.y"),
    ("let share = still_to_come(of_view, seen.at_px);", "let share = guess;"),
    ("middle = (1.0 / ROOT_3)", "middle = 0.0"),
    ("+ center.share * lenses[of_view].moved_world_m", ""),
    ("<= lenses[of_view].widest_rad", "<= 0.5 * lenses[of_view].widest_rad"),
    ("moved_m.z + turning(view.view, at_end_m + moved_m, share).z", "moved_m.z"),
    ("sum.x + (sum.y + exact_m.y)", "sum.x"),
    ("2.0 * then.x * (away.y + then.y - view.depth_low[axis])", "0.0"),
    ("/ max(2.0 * root, 1e-30)", "* 0.0"),
    ("for (var k = 0u; k < i; k++)", "for (var k = 0u; k < 1u; k++)"),
];

/// A street of SH degree 3 with mist in it, over more macro tiles than one thread emits.
pub(crate) fn misty_street(n: usize) -> Gaussians {
    let mut street = street(n, 3, 41);
    for i in (0..n).step_by(1_000) {
        street.ln_scales[i] = [2.0; 3];
        street.logit_opacities[i] = -3.0;
    }
    street
}

/// The street's views, and one of many macro tiles.
pub(crate) fn wide_views() -> Vec<View> {
    let [first, ..] = street_views();
    let wide =
        view_along([700, 300], 400.0, first.world_from_camera.position_m, DVec3::Z, DVec3::Y);
    street_views().into_iter().chain([wide]).collect()
}

#[test]
fn a_slip_in_any_stage_is_caught() {
    let scene = Scene::from_gaussians(&misty_street(30_000));
    let (profile, views) = (RenderProfile::default(), wide_views());
    let truths = render(&cpu(), &scene, &profile, &views);
    let caught = |backend: &dyn Backend| {
        match try_render(backend, &scene, &profile, &views) {
            Ok(images) => {
                images.iter().zip(&truths).any(|(image, truth)| agree(image, truth).is_err())
            }
            // A stage that counts wrong may ask for more than there is.
            Err(RenderError::TooMany { .. }) => true,
            Err(error) => panic!("{error}"),
        }
    };
    assert!(!caught(&gpu()), "nothing is broken, and something was found");
    for slip in MUTATIONS {
        let broken = Shaders::default().with_mutation(slip.shader, slip.part, slip.text);
        let broken = broken.unwrap_or_else(|| panic!("{slip:?}: the part is no longer there"));
        assert!(caught(&gpu_with(broken)), "{slip:?} went unnoticed");
    }
}
