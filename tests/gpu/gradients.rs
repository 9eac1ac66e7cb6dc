//! Gradients of the gpu backend against `reference`, and that they repeat.

use glam::DVec3;
use wildcity_render::compare::gradients::{GroupError, by_group, group_errors, waves};
use wildcity_render::compare::images::render_images;
use wildcity_render::gpu::Gpu;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gradient::{Differentiate, GradientError, Gradients};
use wildcity_render::reference::Reference;
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::{CLUSTER, columns};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{RenderProfile, Scene};

use crate::gpu::{bindings, gpu, gpu_with, gpu_with_limits};
use crate::gradient_cases::{
    check_actors, check_lenses, check_pinholes, check_refusals, differentiate, mutation_case,
};
use crate::images::view_along;
use crate::lenses::{lenses, rolling_view};
use crate::shared_gpu;
use crate::streets::{street, turning_views};

#[test]
fn gpu_has_the_gradients_of_the_reference() {
    check_pinholes(&**shared_gpu());
}

#[test]
fn gpu_has_the_gradients_of_every_lens_and_shutter() {
    check_lenses(&**shared_gpu());
}

#[test]
fn gpu_has_the_gradients_of_actors() {
    check_actors(&**shared_gpu());
}

#[test]
fn losses_that_do_not_fit_are_refused() {
    check_refusals(&**shared_gpu());
}

#[test]
fn a_frame_that_does_not_fit_the_device_is_refused() {
    let small = gpu_with_limits(bindings(1 << 20));
    let scene = Scene::from_gaussians(&street(20_000, 1, 12));
    let profile = RenderProfile::default();
    let views = turning_views();
    let differ = |scene: &Scene| {
        let frame = Frame { scene, profile: &profile, views: &views };
        small.differentiate(&frame, true, &mut |images| waves(images), &mut Gradients::default())
    };
    let refused = differ(&scene);
    assert!(matches!(refused, Err(GradientError::Memory { .. })), "{refused:?}");
    // The next frame fits.
    assert!(differ(&Scene::from_gaussians(&street(50, 0, 12))).is_ok());
}

/// A frame is summed in runs of macro tiles. Small bindings make them shorter, and divide the macro
/// tile where the street meets the horizon.
#[test]
fn gradients_do_not_depend_on_the_runs_of_macro_tiles() {
    // Opaque and large, so that tiles end before their last splat.
    let mut street = street(3_500, 0, 12);
    street.logit_opacities.fill(6.0);
    street.ln_scales.iter_mut().flatten().for_each(|ln_scale| *ln_scale += 3.0);
    let scene = Scene::from_gaussians(&street);
    let profile = RenderProfile::default();
    let mut views = turning_views()[..2].to_vec();
    views.push(along_the_street([120, 90]));
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    let differ = |gpu: &Gpu| {
        let mut gradients = Gradients::default();
        let mut differ = || {
            let before = gpu.usage().unwrap().totals.dispatches;
            gpu.differentiate(&frame, true, &mut |images| waves(images), &mut gradients).unwrap();
            gpu.usage().unwrap().totals.dispatches - before
        };
        // Buffers grow in the first, which draws again.
        differ();
        let dispatches = differ();
        (bits(&gradients), dispatches)
    };
    let (gradients, dispatches) = differ(&gpu());
    let (of_small, dispatches_of_small) = differ(&gpu_with_limits(bindings(5 << 16)));
    assert!(dispatches_of_small > dispatches, "{dispatches} {dispatches_of_small}");
    assert!(of_small == gradients);
}

/// What gradients take on the device beside the frame, its pixels, and the gradients themselves.
#[test]
fn gradients_take_120_bytes_a_splat() {
    let scene = Scene::from_gaussians(&street(300_000, 0, 12));
    let profile = RenderProfile::default();
    let views = [along_the_street([720, 464])];
    let gpu = gpu();
    let mut gradients = Gradients::default();
    let mut differ = |scene: &Scene| {
        let frame = Frame { scene, profile: &profile, views: &views };
        gpu.differentiate(&frame, true, &mut |images| waves(images), &mut gradients).unwrap()
    };
    // The buffers of the pixels, and those of the frame.
    differ(&Scene::from_gaussians(&street(1, 0, 12)));
    render_images(&*gpu, &scene, &profile, &views).unwrap();
    let allocated = || gpu.usage().unwrap().allocated_bytes.unwrap();
    let before = allocated();
    let stats = differ(&scene);
    let taken = allocated() - before;
    // Every cluster is seen: its values lie on the device and where the host reads them, and
    // buffers grow by a quarter more than they need.
    assert_eq!(stats.visible_pairs, 300_000);
    let clusters: usize = scene.chunks.iter().map(|chunk| chunk.len().div_ceil(CLUSTER)).sum();
    let values = 2 * 5 * (CLUSTER * columns(0) * clusters) as u64;
    let each = (taken as f64 - values as f64) / stats.visible_pairs as f64;
    eprintln!("{each}");
    assert!(each > 44.0, "{each} B a splat cannot be all");
    assert!(each <= 120.0, "{each} B a splat");
}

#[test]
fn gradients_repeat_to_the_byte() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 12));
    let profile = RenderProfile::default();
    let mut views = turning_views();
    let lens = lenses().into_iter().find(|(name, _)| *name == "fisheye").unwrap().1;
    let lens = Camera { native_size_px: None, ..lens.scaled(80, 50).unwrap() };
    let pose = views[0].world_from_camera;
    views.push(rolling_view(lens, pose, ShutterDirection::TopToBottom));
    let gpu = shared_gpu();
    let mut gradients = Gradients::default();
    let mut differ = || {
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        gpu.differentiate(&frame, true, &mut |images| waves(images), &mut gradients).unwrap();
        bits(&gradients)
    };
    let first = differ();
    for repeat in 0..20 {
        assert!(differ() == first, "repeat {repeat}");
    }
}

/// A view of a whole street: most of it is in one macro tile.
fn along_the_street(size_px: [u32; 2]) -> View {
    let from = DVec3::new(0.0, 0.0, -20.0);
    let focal_px = f64::from(size_px[0]) / 2.4;
    view_along(size_px, focal_px, from, DVec3::Z, DVec3::Y)
}

fn bits(gradients: &Gradients) -> Vec<u64> {
    let bits = |(_, values): (_, Vec<f64>)| values.into_iter().map(f64::to_bits);
    by_group(gradients).into_iter().flat_map(bits).collect()
}

#[test]
fn gradients_cost_nothing_when_absent() {
    let scene = Scene::from_gaussians(&street(1_000, 1, 12));
    let profile = RenderProfile::default();
    let views = turning_views();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    let backend = gpu();
    let render = || {
        render_images(&*backend, &scene, &profile, &views).unwrap();
        let before = backend.usage().unwrap();
        render_images(&*backend, &scene, &profile, &views).unwrap();
        let after = backend.usage().unwrap();
        let dispatches = after.totals.dispatches - before.totals.dispatches;
        (after.totals.pipelines, after.allocated_bytes, dispatches)
    };
    let (pipelines, bytes, dispatches) = render();
    backend
        .differentiate(&frame, true, &mut |images| waves(images), &mut Gradients::default())
        .unwrap();
    let (pipelines_after, bytes_after, dispatches_after) = render();
    // blend, rank, two of gather, one of project; and one of rasterize for images of floats.
    assert!((5..=7).contains(&(pipelines_after - pipelines)), "{pipelines} {pipelines_after}");
    assert!(bytes_after > bytes);
    assert_eq!(dispatches_after, dispatches);
    // A backend that has computed none has neither kernels nor buffers of gradients.
    let other = gpu();
    render_images(&*other, &scene, &profile, &views).unwrap();
    render_images(&*other, &scene, &profile, &views).unwrap();
    let usage = other.usage().unwrap();
    assert_eq!((usage.totals.pipelines, usage.allocated_bytes), (pipelines, bytes));
}

/// Faults of the way back: shader, original text, and its replacement.
const MUTATIONS: &[(&str, &str, &str)] = &[
    ("rasterize_gradient", "behind -= weight * energy;", ""),
    ("rasterize_gradient", "- behind / (1.0 - alpha)", "- behind"),
    ("rasterize_gradient", "counts & (peak <= vec4f(frame.alpha_cap))", "counts"),
    ("rasterize_gradient", "color_depth.w * by_depth", "color_depth.w * by_red"),
    ("rasterize_gradient", "sum_gu * offsets.v", "sum_gu * offsets.v * 1.001"),
    ("rasterize_gradient", "plus_block(sum, at, blocks, 13u)", "sum"),
    ("rasterize_gradient", "derivatives[plane + 2u * PLANE]", "derivatives[plane + PLANE]"),
    ("gather", "touch_ranks[middle] < rank", "touch_ranks[middle] <= rank"),
    ("gather", "ranks[splat_indices[rank]] = rank", "ranks[splat_indices[rank]] = rank / 2u"),
    ("gather", "a.vv + b.vv", "a.vv"),
    ("gather", "column <= last.x", "column < last.x"),
    ("project_gradient", "sums.uu - scale.total / LN_2", "sums.uu"),
    ("project_gradient", "2.0 * before / det_before", "before / det_before"),
    ("project_gradient", "(shrink - before) / det_native", "shrink / det_native"),
    ("project_gradient", "vec3f(yy + native.y, -xy", "vec3f(yy + native.y, xy"),
    ("project_gradient", "view.focal_px * (by_px - of_shape)", "view.focal_px * by_px"),
    ("project_gradient", "sums.depth - along / z", "sums.depth"),
    ("project_gradient", "cross(q_x, row_x) + cross(q_y, row_y)", "cross(q_x, row_x)"),
    ("project_gradient", "by_point.z * forward + by_toward", "by_point.z * forward"),
    ("project_gradient", "colors[slot].rgb > vec3f(0.0)", "colors[slot].rgb > vec3f(-1.0)"),
    ("project_gradient", "(by_d - dot(d, by_d) * d)", "by_d"),
    ("project_gradient", "8.0 * d.y * d.z", "-8.0 * d.y * d.z"),
    ("project_gradient", "-a * vec3f(d.z, 0.0, d.x)", "-a * vec3f(d.x, 0.0, d.z)"),
    ("project_gradient", "cross(twice, v)", "cross(v, twice)"),
    ("project_gradient", "rhos[thread] += rhos[thread + half];", ""),
    ("project_gradient", "cross(point, by_point) + to_camera * torque", "cross(point, by_point)"),
    ("project_gradient_actors", "rgb * light.tint * factor", "rgb * factor"),
    (
        "project_gradient",
        "gradients[first_value + line * CLUSTER] += value",
        "gradients[first_value + line * CLUSTER] = value",
    ),
];

#[test]
fn a_fault_of_each_formula_is_noticed() {
    let case = mutation_case();
    let frame = case.frame();
    let truth = differentiate(&Reference, frame.scene, frame.profile, frame.views).1;
    let undetected: Vec<_> = MUTATIONS
        .iter()
        .filter(|(shader, original, replacement)| {
            let shaders = Shaders::default().with_mutation(shader, original, replacement);
            let broken = gpu_with(shaders.unwrap_or_else(|| panic!("{shader}: {original}")));
            let ours = differentiate(&*broken, frame.scene, frame.profile, frame.views).1;
            let holds = |group: &GroupError| group.error < 1e-4 && group.cosine > 0.99999;
            group_errors(&ours, std::slice::from_ref(&truth)).iter().all(holds)
        })
        .collect();
    assert!(undetected.is_empty(), "{undetected:#?}");
    let ours = differentiate(&**shared_gpu(), frame.scene, frame.profile, frame.views).1;
    for GroupError { group, error, .. } in group_errors(&ours, std::slice::from_ref(&truth)) {
        assert!(error < 1e-4, "without a fault {group} is off by {error:e}");
    }
}
