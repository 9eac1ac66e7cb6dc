//! A comparison that cannot fail proves nothing: every stage is broken, and it must be noticed.

use glam::DVec3;
use wildcity::render::gpu::shaders::Shaders;
use wildcity::render::{Backend, View};
use wildcity::scene::{RenderProfile, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{agree, cpu, look, render};
use crate::streets::{street, street_views};

#[test]
fn a_slip_in_any_stage_is_caught() {
    let mut street = street(30_000, 3, 41);
    // And mist over more macro tiles than one thread emits.
    for i in (0..street.len()).step_by(1_000) {
        street.ln_scales[i] = [2.0; 3];
        street.logit_opacities[i] = -3.0;
    }
    let scene = Scene::from_gaussians(&street);
    let profile = RenderProfile::default();
    let [first, ..] = street_views();
    let wide = look([700, 300], 400.0, first.world_from_camera.position_m, DVec3::Z, DVec3::Y);
    let views: Vec<View> = street_views().into_iter().chain([wide]).collect();
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
        ("sort", "place = next[own_digit]", "place = offsets[own_digit]"),
        ("sort", "is_last = after == 0u", "is_last = beside == own_bit"),
        ("bin", "u32(columns.y) / TILE_PX + 1u", "u32(columns.y) / TILE_PX"),
        ("bin", "- first_column + 1u", "- first_column"),
        ("bin", "1u << (end - left)", "1u << (end - left - 1u)"),
        ("bin", "<< (k * MACRO_COLUMNS)", "<< (k * 7u)"),
        (
            "bin",
            "half_width(reach, right_dy) + EXTENT_SLACK_PX",
            "0.7 * half_width(reach, right_dy)",
        ),
        ("bin", "i - prefix_before(holder)", "i"),
        ("sort", "sorted_masks[to] = masks[i]", "sorted_masks[to] = masks[to]"),
        ("ranges", "ranges[own].y = i + 1u", "ranges[own].y = i"),
        ("expand", "offsets[tile] = atomicLoad(&counts[thread])", "offsets[tile] = 0u"),
        ("expand", "word_starts[word] = next", "word_starts[word] = first"),
        ("expand", "& (own_bit - 1u)", "& ~(own_bit | (own_bit - 1u))"),
        ("expand", "k / MACRO_COLUMNS", "k / 4u"),
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
