//! Frames that exceed a device are drawn region by region, to the same bytes.

use glam::DVec3;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::gpu::{bindings, gpu, gpu_with_limits};
use crate::images::{agree, cpu, render, render_one, view_along};
use crate::scene_files::{Random, gaussians};
use crate::streets::{street, turning_views};

/// A street with large translucent Gaussians over many tiles, so that both splats and instances
/// exceed the limits.
fn misty(n: usize, step: usize, seed: u64) -> Scene {
    let mut street = street(n, 1, seed);
    for i in (0..street.len()).step_by(step) {
        street.ln_scales[i] = [1.5; 3];
        street.logit_opacities[i] = -3.0;
    }
    Scene::from_gaussians(&street)
}

/// A splat takes 32 B and an instance 4 B: many small Gaussians exceed the limit of splats, and few
/// large ones that of instances.
#[test]
fn the_image_does_not_depend_on_the_regions() {
    let view = |yaw: f64| {
        let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
        view_along([90, 360], 150.0, DVec3::ZERO, forward, DVec3::Y)
    };
    let views: Vec<View> = (0..6).map(f64::from).map(view).collect();
    let profile = RenderProfile::default();
    for (n, ln_scale) in [(60_000, -3.0), (3_000, 1.0)] {
        let mut cloud = gaussians(n, 1, 20.0, 31);
        cloud.ln_scales.fill([ln_scale; 3]);
        cloud.logit_opacities.fill(-2.0);
        let scene = Scene::from_gaussians(&cloud);
        let whole = gpu();
        let expected = render(&whole, &scene, &profile, &views);
        assert_eq!(whole.usage().unwrap().regions, 1);
        // Groups of views, then bands of single views.
        let regions = [256 << 10, 128 << 10, 64 << 10].map(|binding_bytes| {
            let limited = gpu_with_limits(bindings(binding_bytes));
            assert!(render(&limited, &scene, &profile, &views) == expected, "{binding_bytes} B");
            limited.usage().unwrap().regions
        });
        let has_bands = regions[2] > 2 * views.len() as u64;
        assert!(regions.is_sorted() && regions[0] >= 2 && has_bands, "{regions:?}");
    }
}

#[test]
fn a_frame_starts_with_the_regions_of_the_previous_one() {
    let scene = misty(12_000, 4, 32);
    let profile = RenderProfile::default();
    let views = turning_views();
    let other = misty(9_000, 100, 33);
    let limited = gpu_with_limits(bindings(256 << 10));
    let expected = render(&limited, &scene, &profile, &views);
    render(&limited, &other, &profile, &views);
    let known = limited.usage().unwrap();
    assert!(known.retries > 0 && known.regions > 4, "nothing was split: {known:?}");
    for _ in 0..3 {
        assert!(render(&limited, &scene, &profile, &views) == expected);
        render(&limited, &other, &profile, &views);
    }
    assert_eq!(limited.usage().unwrap().retries, known.retries, "a frame had to be drawn again");

    // A frame that fits is drawn at once again.
    let small = Scene::from_gaussians(&street(2_000, 1, 34));
    let before = limited.usage().unwrap().regions;
    render(&limited, &small, &profile, &views);
    assert_eq!(limited.usage().unwrap().regions, before + 1);
}

#[test]
fn a_row_of_tiles_that_exceeds_a_device_is_an_error() {
    let mut wall = Gaussians::with_capacity(0, 3_000);
    for i in 0..3_000 {
        wall.means_m.push([0.0, 0.0, 5.0 + 1e-3 * f64::from(i)]);
        wall.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        wall.ln_scales.push([3.0; 3]);
        wall.logit_opacities.push(-4.0);
        wall.sh.extend([0.5; 3]);
    }
    let scene = Scene::from_gaussians(&wall);
    let profile = RenderProfile::default();
    let limited = gpu_with_limits(bindings(64 << 10));
    let one_row = view_along([64, 16], 50.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    let rows = view_along([64, 64], 50.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    for view in [one_row, rows] {
        let mut image = vec![77; 3 * view.camera.pixels()];
        let target = Target { rgb8: Some(&mut image), ..Target::default() };
        let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
        let error = limited.render(&frame, &mut [target], &|_, _| {}).unwrap_err();
        let what = "visible splats in one row of tiles";
        assert_eq!(error, RenderError::TooMany { what, limit: 2_048 });
        assert!(image.iter().all(|&byte| byte == 77), "something was written");
    }
    // The next frame is drawn.
    let street = Scene::from_gaussians(&street(1_000, 1, 35));
    let view = turning_views()[0];
    let image = render_one(&limited, &street, &profile, view);
    assert!(image == render_one(&gpu(), &street, &profile, view));
}

/// A binding of lavapipe holds 4,194,304 splats of 32 B; one of a graphics card holds 16 times as
/// many.
#[test]
fn more_splats_than_lavapipe_holds_at_once() {
    let width = 640;
    let height = 400;
    let focal_px = 300.0;
    let mut random = Random(36);
    let mut dust = Gaussians::with_capacity(0, 4_200_000);
    for _ in 0..4_200_000 {
        let z = 5.0 + 100.0 * random.unit();
        let slope = |size: f64| (random.unit() - 0.5) * size / focal_px;
        let [x, y] = [f64::from(width), f64::from(height)].map(slope);
        dust.means_m.push([x * z, y * z, z]);
        dust.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        dust.ln_scales.push([-5.0; 3]);
        dust.logit_opacities.push(-2.0);
        dust.sh.extend([random.between(-1.0, 1.0), 0.2, 0.4]);
    }
    let view = view_along([width, height], focal_px, DVec3::ZERO, DVec3::Z, DVec3::Y);
    exceeds_lavapipe(&Scene::from_gaussians(&dust), view);
}

/// A binding of lavapipe holds 33,554,432 instances of 4 B; one of a graphics card holds four times
/// as many.
#[test]
fn more_instances_than_lavapipe_holds_at_once() {
    let mut mist = street(60_000, 0, 37);
    mist.ln_scales.fill([2.5; 3]);
    mist.logit_opacities.fill(-3.0);
    let view = view_along([960, 600], 500.0, DVec3::new(0.0, 0.0, -5.0), DVec3::Z, DVec3::Y);
    exceeds_lavapipe(&Scene::from_gaussians(&mist), view);
}

/// Draws a scene that exceeds bindings of 128 MiB, even if the device allows larger ones.
fn exceeds_lavapipe(scene: &Scene, view: View) {
    let limited = gpu_with_limits(bindings(128 << 20));
    let image = render_one(&limited, scene, &RenderProfile::default(), view);
    let regions = limited.usage().unwrap().regions;
    assert!(regions >= 2, "the frame fitted at once");
    let truth = render_one(&cpu(), scene, &RenderProfile::default(), view);
    agree(&image, &truth).unwrap();
}

/// Lavapipe leaves a loop after 65,535 iterations. A frame whose splats it would not all blend must
/// be refused, not drawn without them.
#[test]
fn more_splats_in_a_tile_than_software_blends() {
    let view = view_along([16, 16], 4.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    let profile = RenderProfile { stop: 1e-300, ..RenderProfile::default() };
    for (count, is_refused) in [(83_000, false), (120_000, true)] {
        // All of them in the third block of 4 x 4 px of the second row: it has every splat of every
        // batch.
        let mut dust = Gaussians::with_capacity(0, count);
        for i in 0..count {
            let depth_m = 5.0 + 1e-5 * i as f64;
            let at = |px: usize| (px as f64 - 7.5) / 4.0 * depth_m;
            dust.means_m.push([at(8 + i % 4), at(4 + i / 4 % 4), depth_m]);
            dust.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            dust.ln_scales.push([-3.0; 3]);
            // Alpha is 1/100, above the cut of 1/255: a pixel keeps 2e-22 after 5,000 of them.
            dust.logit_opacities.push(-4.6);
            dust.sh.extend([0.5; 3]);
        }
        let scene = Scene::from_gaussians(&dust);
        let backend = gpu();
        let mut image = vec![77; 3 * 256];
        let target = Target { rgb8: Some(&mut image), ..Target::default() };
        let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
        match backend.render(&frame, &mut [target], &|_, _| {}) {
            Err(RenderError::TooMany { limit, .. }) => {
                assert!(is_refused && limit >= 83_000, "{count}: at most {limit}");
            }
            drawn => {
                drawn.unwrap();
                assert!(!is_refused || !backend.detail().contains("llvmpipe"), "{count} are drawn");
                let image = render_one(&backend, &scene, &profile, view);
                agree(&image, &render_one(&cpu(), &scene, &profile, view)).unwrap();
            }
        }
    }
}

/// The loops that list the tiles of huge splats have the same limit: if the image were not drawn in
/// bands, some of its 10,625 tiles would keep the pixels of the previous frame.
#[test]
fn huge_splats_on_a_large_image() {
    let mut haze = Gaussians::with_capacity(0, 300);
    for i in 0..300 {
        haze.means_m.push([0.0, 0.0, 5.0 + 0.01 * f64::from(i)]);
        haze.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        haze.ln_scales.push([5.0; 3]);
        haze.logit_opacities.push(-4.5);
        haze.sh.extend([0.01 * i as f32, 0.5, 0.2]);
    }
    let scene = Scene::from_gaussians(&haze);
    let profile = RenderProfile::default();
    let view = view_along([2_000, 1_360], 1_000.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    let image = render_one(&gpu(), &scene, &profile, view);
    agree(&image, &render_one(&cpu(), &scene, &profile, view)).unwrap();
}
