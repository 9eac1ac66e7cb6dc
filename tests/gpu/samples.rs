//! Images whose pixels have several samples, against the cpu backend, and in frames with others.

use glam::DVec3;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{Scatter, Tuning};
use wildcity_render::{Backend, View};
use wildcity_scene::{RenderProfile, Scene};

use crate::cameras::lens_views;
use crate::gpu::{bindings, gpu_with, gpu_with_limits, gpu_with_tuning};
use crate::images::{Image, agree, cpu, render, render_one, view_along};
use crate::placed;
use crate::shared_gpu;
use crate::skies::{appearance, draw_seen, sky};
use crate::streets::street;

/// Cameras of every model, at rest and rolling, with images of less than half of their native size.
fn sampled_views() -> Vec<View> {
    let scaled = |view: View| View { camera: view.camera.scaled(70, 33).unwrap(), ..view };
    let pinhole = view_along([240, 150], 130.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    lens_views().into_iter().step_by(2).chain([pinhole]).map(scaled).collect()
}

/// A street with actors and classes, under a sky.
fn scene() -> Scene {
    let mut scene = Scene::from_gaussians(&street(10_000, 1, 31));
    scene.placed = placed::street_with_actors().0.placed;
    scene.sky = Some(sky());
    placed::labelled(&scene)
}

fn profile() -> RenderProfile {
    RenderProfile { lens_error_px: 0.0, ..RenderProfile::DEFAULT }
}

/// The share of owners that the cpu backend finds, too.
fn same_owners(gpu: &dyn Backend, scene: &Scene, views: &[View]) -> f64 {
    let [(a, _), (b, _)] = [gpu, &cpu()].map(|backend| placed::owners(backend, scene, views));
    let pixels: Vec<bool> = std::iter::zip(&a, &b)
        .flat_map(|((ids, classes), (true_ids, true_classes))| {
            let ids = std::iter::zip(ids, true_ids).map(|(a, b)| a == b);
            let classes = std::iter::zip(classes, true_classes).map(|(a, b)| a == b);
            std::iter::zip(ids, classes).map(|(a, b)| a && b)
        })
        .collect();
    pixels.iter().filter(|&&same| same).count() as f64 / pixels.len() as f64
}

/// The first difference from the cpu backend.
fn check(gpu: &dyn Backend, views: &[View]) -> Result<(), String> {
    let scene = scene();
    let pairs = std::iter::zip(
        render(gpu, &scene, &profile(), views),
        render(&cpu(), &scene, &profile(), views),
    );
    for (k, (image, truth)) in pairs.enumerate() {
        agree(&image, &truth).map_err(|e| format!("view {k}: {e}"))?;
    }
    let same = same_owners(gpu, &scene, views);
    if same < 0.995 {
        return Err(format!("{same} of the owners"));
    }
    let view = views[views.len() - 1];
    let seen = appearance(view);
    let [image, truth] = [gpu, &cpu()].map(|backend| draw_seen(backend, &scene, view, &seen));
    agree(&image, &truth).map(|_| ()).map_err(|e| format!("with an overlay: {e}"))
}

#[test]
fn samples_are_drawn_as_by_the_cpu() {
    check(&*shared_gpu(), &sampled_views()).unwrap();
    // The network itself, and not the map that it is baked into.
    let exact = RenderProfile { sky_error: 0.0, ..profile() };
    let view = sampled_views()[0];
    let [image, truth]: [Image; 2] = [&*shared_gpu() as &dyn Backend, &cpu()]
        .map(|backend| render_one(backend, &scene(), &exact, view));
    agree(&image, &truth).unwrap();
}

/// Faults of the shader that the comparison must notice.
#[test]
fn faults_are_noticed() {
    for (original, replacement) in [
        ("return values.xz + values.yw;", "return values.xz + values.xz;"),
        ("return 0.25 * (mean_factors", "return 0.26 * (mean_factors"),
        (
            "0.25 * vec4f(through[0].xy, through[1].xy)",
            "0.25 * vec4f(through[0].xy, through[0].xy)",
        ),
        ("let second = first + 4u;", "let second = first;"),
        ("if count > most", "if count >= most"),
        ("* samples(view_index)", "* 1.0"),
    ] {
        // Kernels for lenses take seconds to compile, so that one fault of theirs is enough.
        let is_of_lens = original.contains("view_index");
        let names: &[&str] =
            if is_of_lens { &["rasterize_map_lens"] } else { &["rasterize_map", "owners_map"] };
        let views = sampled_views();
        let views = if is_of_lens { &views[..1] } else { &views[views.len() - 1..] };
        let mut shaders = Some(Shaders::default());
        let mut mutated = 0;
        for name in names {
            let with = shaders.clone().and_then(|s| s.with_mutation(name, original, replacement));
            mutated += usize::from(with.is_some());
            shaders = with.or(shaders);
        }
        assert!(mutated > 0, "no shader has {original}");
        let gpu = gpu_with(shaders.unwrap());
        let found = check(&*gpu, views);
        assert!(found.is_err(), "{original}: not noticed");
        eprintln!("{original}: {found:?}");
    }
}

/// With images of native size in the frame the tiles have another layout.
#[test]
fn a_frame_of_both_kinds_has_the_images_of_each() {
    let gpu = shared_gpu();
    let scene = scene();
    let mut views = sampled_views();
    for view in views.iter_mut().step_by(2) {
        view.camera = view.camera.scaled(100, 60).unwrap();
    }
    let images = render(&*gpu, &scene, &profile(), &views);
    let (owners, _) = placed::owners(&*gpu, &scene, &views);
    for (k, &view) in views.iter().enumerate() {
        assert!(images[k] == render_one(&*gpu, &scene, &profile(), view), "view {k}");
        assert!(owners[k] == placed::owners(&*gpu, &scene, &[view]).0[0], "owners of view {k}");
    }
}

/// Region by region, and with a kernel of their own for long lists.
#[test]
fn samples_do_not_depend_on_regions_and_kernels() {
    let mut scene = scene();
    // A sky takes more than a region may have, and so do actors in the row of tiles that has all.
    scene.sky = None;
    scene.placed.clear();
    let views = sampled_views();
    let expected = render(&*shared_gpu(), &scene, &profile(), &views);
    let (owners, _) = placed::owners(&*shared_gpu(), &scene, &views);
    let limited = gpu_with_limits(bindings(512 << 10));
    assert!(render(&*limited, &scene, &profile(), &views) == expected, "in regions");
    assert!(limited.usage().unwrap().regions > 2, "one region");
    let tuning = Tuning { scatter: Scatter::Plain, long_tile_splats: 64 };
    let long = gpu_with_tuning(Shaders::default(), tuning);
    assert!(render(&*long, &scene, &profile(), &views) == expected, "with long lists");
    assert!(placed::owners(&*long, &scene, &views).0 == owners, "owners with long lists");
}
