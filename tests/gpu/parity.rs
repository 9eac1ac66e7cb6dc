//! Whole images: gpu against cpu, and against images of independent renderers.

use glam::DVec3;
use wildcity_render::View;
use wildcity_render::reference::Reference;
use wildcity_scene::{RenderProfile, Scene};

use crate::data::real;
use crate::gpu::gpu;
use crate::images::{agree, cpu, max_difference, psnr, render, render_one, view_along};
use crate::scene_files::gaussians;
use crate::streets::{demo_street, street, street_views};
use crate::truths::{gsplat, read, skull_front};

/// Compares all views on both backends.
fn compare(scene: &Scene, profile: &RenderProfile, views: &[View], what: &str) {
    let images = render(&gpu(), scene, profile, views);
    let truths = render(&cpu(), scene, profile, views);
    for (view, (image, truth)) in images.iter().zip(&truths).enumerate() {
        assert!(truth.opacity.iter().any(|&o| o > 0.5), "{what}: view {view} is empty");
        agree(image, truth).unwrap_or_else(|e| panic!("{what}, view {view}: {e}"));
    }
}

/// Compares colour and opacity only. In dense scenes, an alpha may lie at the cut or a
/// transmittance at the stop, and two backends may decide differently. That changes a pixel's
/// colour by at most a hundredth, but its depth by any amount.
fn compare_colors(scene: &Scene, profile: &RenderProfile, views: &[View], what: &str) {
    let images = render(&gpu(), scene, profile, views);
    let truths = render(&cpu(), scene, profile, views);
    for (view, (image, truth)) in images.iter().zip(&truths).enumerate() {
        let (db, off) = (psnr(&image.rgba, &truth.rgba), max_difference(&image.rgba, &truth.rgba));
        assert!(truth.opacity.iter().any(|&o| o > 0.5), "{what}: view {view} is empty");
        let close = db >= 80.0 && off <= 0.01;
        assert!(close, "{what}, view {view}: {db:.1} dB, off by {off}");
    }
}

#[test]
pub(crate) fn streets_of_every_sh_degree() {
    for degree in 0..=3 {
        let scene = Scene::from_gaussians(&street(30_000, degree, 5));
        compare(&scene, &RenderProfile::default(), &street_views(), &format!("degree {degree}"));
    }
}

#[test]
fn the_demo_street_from_its_own_cameras() {
    let (street, views) = demo_street();
    let scene = Scene::from_gaussians(&street);
    // Thousands of surfels of one plane: both backends order them equally only if depths are
    // rounded once.
    compare_colors(&scene, &RenderProfile::default(), &views, "the demo street");
}

#[test]
fn every_field_of_the_profile() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 6));
    for setting in [
        "near=0.2",
        "far=40",
        "blur=0.1",
        "antialiased=true",
        "alpha_cap=0.999",
        "alpha_cut=0.007",
        "stop=0.01",
    ] {
        let mut profile = RenderProfile::default();
        profile.set(setting).unwrap();
        compare(&scene, &profile, &street_views(), setting);
    }
}

#[test]
fn a_cloud_around_the_camera() {
    let view = view_along([128, 96], 80.0, DVec3::ZERO, DVec3::new(0.3, -0.2, 1.0), DVec3::Y);
    let cloud = Scene::from_gaussians(&gaussians(3_000, 2, 2.0, 8));
    compare(&cloud, &RenderProfile::default(), &[view], "cloud");
}

#[test]
fn sixteen_views_of_sizes_that_are_no_multiple_of_a_tile() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 7));
    let views: Vec<View> = (0..16)
        .map(|i| {
            let yaw = 0.4 * f64::from(i);
            let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
            let size_px = [17 + 13 * i, 1 + 11 * i];
            view_along(size_px, 60.0, DVec3::new(0.0, 0.0, 30.0), forward, DVec3::Y)
        })
        .collect();
    let images = render(&gpu(), &scene, &RenderProfile::default(), &views);
    let truths = render(&cpu(), &scene, &RenderProfile::default(), &views);
    for (view, (image, truth)) in images.iter().zip(&truths).enumerate() {
        agree(image, truth).unwrap_or_else(|e| panic!("view {view}: {e}"));
    }
}

/// 132 B each at degree 3: 139 MB, two bindings of lavapipe.
#[test]
fn a_scene_of_several_pages() {
    let scene = Scene::from_gaussians(&street(1_050_000, 3, 10));
    compare_colors(&scene, &RenderProfile::default(), &street_views(), "pages");
}

#[test]
fn real_captures() {
    for (file, at, forward, down) in [
        ("scenes/skull/skull.ply", DVec3::new(0.0, -0.5, -2.0), DVec3::Z, DVec3::Y),
        ("scenes/skull/skull.ply", DVec3::new(0.3, -0.4, -0.6), DVec3::Z, DVec3::Y),
        ("scenes/train-1000.ply", DVec3::new(0.0, 0.0, -3.0), DVec3::Z, DVec3::Y),
        (
            "scenes/biker/biker.compressed.ply",
            DVec3::new(0.0, 1.0, 2.5),
            DVec3::NEG_Z,
            DVec3::NEG_Y,
        ),
        (
            "scenes/guitar/guitar.compressed.ply",
            DVec3::new(0.0, -0.8, 2.2),
            DVec3::NEG_Z,
            DVec3::NEG_Y,
        ),
        ("scenes/playbot/lod-meta.json", DVec3::new(0.0, -0.5, -2.5), DVec3::Z, DVec3::Y),
        ("scenes/playcanvas-logo/meta.json", DVec3::new(0.0, -1.2, -4.0), DVec3::Z, DVec3::Y),
    ] {
        let Some(path) = real(file) else { return };
        let view = view_along([640, 480], 600.0, at, forward, down);
        let profile = RenderProfile { near: 0.2, alpha_cap: 0.999, ..RenderProfile::default() };
        compare_colors(&read(&path), &profile, &[view], file);
    }
}

#[test]
fn images_equal_those_of_gsplat() {
    let Some(truth) = gsplat() else { return };
    let image = render_one(&gpu(), &truth.scene, &truth.profile, truth.view);
    let off = max_difference(&image.rgba, &truth.rgba);
    assert!(off <= 1e-4, "off by {off:e}");
}

#[test]
fn an_image_of_a_real_capture_equals_that_of_an_independent_renderer() {
    let Some(truth) = skull_front() else { return };
    let image = render_one(&gpu(), &truth.scene, &truth.profile, truth.view);
    let db = psnr(&image.rgba, &truth.rgba);
    assert!(db >= 60.0, "{db:.1} dB");
}

/// The gpu directly against the definition, without the cpu backend.
#[test]
fn the_gpu_draws_what_the_definition_draws() {
    let scene = Scene::from_gaussians(&street(5_000, 3, 9));
    let view = street_views()[0];
    let image = render_one(&gpu(), &scene, &RenderProfile::default(), view);
    let truth = render_one(&Reference, &scene, &RenderProfile::default(), view);
    agree(&image, &truth).unwrap();
}
