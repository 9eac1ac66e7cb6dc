//! A comparison that cannot fail proves nothing: every stage is broken, and it must be noticed.

use wildcity::render::Backend;
use wildcity::render::gpu::shaders::Shaders;
use wildcity::scene::{RenderProfile, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{agree, cpu, render};
use crate::streets::{street, street_views};

#[test]
fn a_slip_in_any_stage_is_caught() {
    let mut street = street(30_000, 3, 41);
    // And mist over more tiles than one thread emits.
    for i in (0..street.len()).step_by(1_000) {
        street.ln_scales[i] = [2.0; 3];
        street.logit_opacities[i] = -3.0;
    }
    let scene = Scene::from_gaussians(&street);
    let (profile, views) = (RenderProfile::default(), street_views());
    let truths = render(&cpu(), &scene, &profile, &views);
    let caught = |backend: &dyn Backend| {
        let images = render(backend, &scene, &profile, &views);
        images.iter().zip(&truths).any(|(image, truth)| agree(image, truth).is_err())
    };
    assert!(!caught(&gpu()), "nothing is broken, and something was found");
    for (stage, part, slip) in [
        (
            "project",
            "let clamped = clamp(slope, view.slope_min, view.slope_max);",
            "let clamped = slope * 0.9;",
        ),
        ("project", "let l1 = -(b * l2)", "let l1 = (b * l2)"),
        ("project", "x.y + turn.z", "x.y - turn.z"),
        ("project", "(high & 0xFFu) << 12u", "(high & 0xFFu) << 11u"),
        ("project", "2.890611442640554", "2.0"),
        ("project", "-d.y * coefficient(at, 1u)", "d.y * coefficient(at, 1u)"),
        ("project", "min(depth, (1u << DEPTH_BITS) - 1u)", "0u"),
        ("project", "(own_word & own_bit) == 0u", "(own_word & own_bit & 0x7FFFFFFFu) == 0u"),
        ("scan", "sum = saturating_add(sum, before);", "sum = max(sum, before);"),
        ("scan", "block_sums[count] = before;", "block_sums[count] = before / 2u;"),
        ("sort", "countOneBits(beside & (own_bit - 1u))", "countOneBits(beside & own_bit) - 1u"),
        ("sort", "place = next[digit(key)]", "place = offsets[digit(key)]"),
        ("sort", "is_last = after == 0u", "is_last = beside == own_bit"),
        ("bin", "last - first + 1u", "last - first"),
        (
            "bin",
            "half_width(reach, right_dy) + EXTENT_SLACK_PX",
            "0.7 * half_width(reach, right_dy)",
        ),
        ("bin", "row_first_tile[holder] + i", "row_first_tile[holder]"),
        ("ranges", "ranges[tile].y = i + 1u", "ranges[tile].y = i"),
        ("rasterize", "after > vec4f(frame.stop)", "after > vec4f(50.0 * frame.stop)"),
        ("rasterize", "instance_places[first + k]", "instance_places[first + (k ^ 1u)]"),
        ("rasterize", "sums.green += weight", "sums.green += alpha"),
        ("rasterize", "vec4f(0.0, 1.0, 2.0, 3.0)", "vec4f(0.0, 1.0, 3.0, 2.0)"),
        ("rasterize", "sums.depth / select", "sums.depth * select"),
        ("rasterize", "saturate(linear) * 255.0", "saturate(linear) * 250.0"),
    ] {
        let broken = Shaders::default().with_slip(stage, part, slip);
        let broken = broken.unwrap_or_else(|| panic!("{part:?} is no longer in {stage}"));
        assert!(caught(&gpu_with(broken)), "{stage}: {slip:?} went unnoticed");
    }
}
