//! A comparison that cannot fail proves nothing: every stage is broken, and it must be noticed.

use wildcity::render::Backend;
use wildcity::render::gpu::shaders::Shaders;
use wildcity::scene::{Gaussians, RenderProfile, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{agree, cpu, render};
use crate::streets::{street, street_views};

/// A fault to plant in a shader.
#[derive(Debug)]
pub(crate) struct Slip {
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
) -> Slip {
    Slip { shader, part, text, stages }
}

const PROJECT: &[&str] = &["project"];
const SORT: &[&str] = &["sort"];
const BIN: &[&str] = &["bin"];
const RASTERIZE: &[&str] = &["rasterize"];
const SORTS: &[&str] = &["sort", "bin"];

pub(crate) const SLIPS: &[Slip] = &[
    slip(
        "project",
        "let clamped = clamp(slope, view.slope_min, view.slope_max);",
        "let clamped = slope * 0.9;",
        PROJECT,
    ),
    slip("project", "let l1 = -(b * l2)", "let l1 = (b * l2)", PROJECT),
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
    slip("sort", "place = next[digit(key)]", "place = offsets[digit(key)]", SORTS),
    slip("sort", "is_last = after == 0u", "is_last = beside == own_bit", SORTS),
    // Tiles have no third digit here.
    slip("sort", "(key >> SHIFT)", "(key >> min(SHIFT, 16u))", SORT),
    slip("bin", "last - first + 1u", "last - first", BIN),
    slip(
        "bin",
        "half_width(reach, right_dy) + EXTENT_SLACK_PX",
        "0.7 * half_width(reach, right_dy)",
        BIN,
    ),
    slip("bin", "row_first_tile[holder] + i", "row_first_tile[holder]", BIN),
    slip("ranges", "ranges[tile].y = i + 1u", "ranges[tile].y = i", BIN),
    slip("rasterize", "after > vec4f(frame.stop)", "after > vec4f(50.0 * frame.stop)", RASTERIZE),
    slip("rasterize", "instance_places[first + k]", "instance_places[first + (k ^ 1u)]", RASTERIZE),
    slip("rasterize", "sums.green += weight", "sums.green += alpha", RASTERIZE),
    slip("rasterize", "vec4f(0.0, 1.0, 2.0, 3.0)", "vec4f(0.0, 1.0, 3.0, 2.0)", RASTERIZE),
    slip("rasterize", "sums.depth / select", "sums.depth * select", RASTERIZE),
    slip("rasterize", "saturate(linear) * 255.0", "saturate(linear) * 250.0", RASTERIZE),
];

/// A street of SH degree 3 with mist in it, over more tiles than one thread emits.
pub(crate) fn misty_street(n: usize) -> Gaussians {
    let mut street = street(n, 3, 41);
    for i in (0..n).step_by(1_000) {
        street.ln_scales[i] = [2.0; 3];
        street.logit_opacities[i] = -3.0;
    }
    street
}

#[test]
fn a_slip_in_any_stage_is_caught() {
    let scene = Scene::from_gaussians(&misty_street(30_000));
    let (profile, views) = (RenderProfile::default(), street_views());
    let truths = render(&cpu(), &scene, &profile, &views);
    let caught = |backend: &dyn Backend| {
        let images = render(backend, &scene, &profile, &views);
        images.iter().zip(&truths).any(|(image, truth)| agree(image, truth).is_err())
    };
    assert!(!caught(&gpu()), "nothing is broken, and something was found");
    for slip in SLIPS {
        let broken = Shaders::default().with_slip(slip.shader, slip.part, slip.text);
        let broken = broken.unwrap_or_else(|| panic!("{slip:?}: the part is no longer there"));
        assert!(caught(&gpu_with(broken)), "{slip:?} went unnoticed");
    }
}
