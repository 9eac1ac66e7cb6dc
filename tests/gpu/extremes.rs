//! Stiff and extreme scenes, by the numbers of the design's stress table, against the definition.

use glam::{DQuat, DVec3};
use wildcity::render::View;
use wildcity::render::gpu::Gpu;
use wildcity::render::reference::Reference;
use wildcity::scene::{RenderProfile, Scene};

use crate::blobs::{Blob, ahead, raw, scene};
use crate::gpu::gpu;
use crate::images::{Image, agree, cpu, crop, crop_difference, look, max_difference, render_one};
use crate::poisons::{poisoned, with_one_more};
use crate::streets::street;

/// The image, after it was made sure that the definition gives it too.
fn agreed(gpu: &Gpu, scene: &Scene, profile: &RenderProfile, view: View, what: &str) -> Image {
    let image = render_one(gpu, scene, profile, view);
    let truth = render_one(&Reference, scene, profile, view);
    agree(&image, &truth).unwrap_or_else(|e| panic!("{what}: {e}"));
    image
}

#[test]
fn t1_needles_at_every_angle() {
    let (gpu, profile, view) = (gpu(), RenderProfile::default(), ahead([640, 480], 1000.0));
    for sigma_px in [1e3, 1e4] {
        for degrees in (0..180).step_by(5) {
            let needle = scene(&[Blob {
                rotation: DQuat::from_rotation_z(f64::from(degrees).to_radians()),
                sigma_m: DVec3::new(sigma_px * 5.0 / 1000.0, 1e-4, 1e-4),
                ..Blob::default()
            }]);
            let image = render_one(&gpu, &needle, &profile, view);
            let truth = render_one(&Reference, &needle, &profile, view);
            let off = max_difference(&image.opacity, &truth.opacity);
            assert!(off <= 2e-3, "{sigma_px} px at {degrees}: alpha off by {off}");
            assert!(image.opacity.iter().any(|&o| o > 0.5), "{sigma_px} px at {degrees}: culled");
        }
    }
}

#[test]
fn t2_t3_beside_the_view_and_larger_than_the_screen() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    for [x, y] in [[6.0, 1.6], [-6.0, 1.6], [0.5, 7.0], [9.0, -7.0]] {
        let long = scene(&[Blob {
            mean_m: DVec3::new(x, y, 4.0),
            rotation: DQuat::from_rotation_y(1.2),
            sigma_m: DVec3::new(4.0, 0.05, 0.3),
            ..Blob::default()
        }]);
        agreed(&gpu, &long, &profile, ahead([320, 240], 200.0), &format!("({x}, {y})"));
    }
    // On 4 x 5 macro tiles: a whole workgroup emits them.
    for sigma_m in [2.0, 10.0, 1e3, 1e4] {
        let walls: Vec<Blob> = (0..40)
            .map(|i| Blob {
                mean_m: DVec3::new(0.1 * f64::from(i), 0.0, 5.0 + 0.1 * f64::from(i)),
                sigma_m: DVec3::splat(sigma_m),
                opacity: 0.03,
                ..Blob::default()
            })
            .collect();
        let view = ahead([444, 280], 300.0);
        let image = agreed(&gpu, &scene(&walls), &profile, view, &format!("{sigma_m} m"));
        assert!(image.opacity.iter().any(|&o| o > 0.5), "{sigma_m} m");
    }
}

#[test]
fn t4_t5_close_to_around_and_behind_the_camera() {
    let gpu = gpu();
    for near in [0.01, 0.2] {
        let profile = RenderProfile { near, ..RenderProfile::default() };
        for z in [0.0100001, 0.011, 0.05, 0.19, 0.21] {
            let close = scene(&[Blob {
                mean_m: DVec3::new(0.002, -0.001, z),
                sigma_m: DVec3::new(0.003, 0.02, 0.1),
                ..Blob::default()
            }]);
            let what = format!("{z} m, near {near} m");
            let image = agreed(&gpu, &close, &profile, ahead([160, 120], 1800.0), &what);
            assert_eq!(image.opacity.iter().any(|&o| o > 0.0), z > near, "{what}");
        }
    }
    for z in [0.3, -1.0] {
        let around =
            Blob { mean_m: DVec3::new(0.1, 0.0, z), sigma_m: DVec3::splat(2.0), ..Blob::default() };
        let profile = RenderProfile::default();
        agreed(&gpu, &scene(&[around]), &profile, ahead([160, 120], 100.0), &format!("{z} m"));
    }
}

#[test]
fn t6_equal_depths_keep_the_order_of_ids() {
    let grid = |rgb: [f64; 3]| {
        (0..100).map(move |i| Blob {
            mean_m: DVec3::new(0.1 * f64::from(i % 10), 0.1 * f64::from(i / 10), 5.0),
            rgb,
            ..Blob::default()
        })
    };
    let blobs: Vec<Blob> = grid([1.0, 0.0, 0.0]).chain(grid([0.0, 1.0, 0.0])).collect();
    let (gpu, scene, view) = (gpu(), scene(&blobs), ahead([200, 150], 150.0));
    let image = agreed(&gpu, &scene, &RenderProfile::default(), view, "grid");
    for _ in 0..100 {
        assert!(render_one(&gpu, &scene, &RenderProfile::default(), view) == image);
    }
}

#[test]
fn t7_depths_from_a_centimetre_to_ten_kilometres() {
    // Pairs one step of f32 apart along +x, where chunks follow each other.
    let mut blobs = Vec::new();
    for (i, x) in [0.0101_f32, 0.5, 3.0, 70.0, 1000.0, 9999.0].into_iter().enumerate() {
        let slope = (i as f64 - 2.5) * 0.3;
        for (x, rgb) in [(x.next_up(), [0.0, 1.0, 0.0]), (x, [1.0, 0.0, 0.0])] {
            let x = f64::from(x);
            blobs.push(Blob {
                mean_m: DVec3::new(x, -slope * x, 0.0),
                sigma_m: DVec3::splat(0.02 * x),
                rgb,
                opacity: 0.95,
                ..Blob::default()
            });
        }
    }
    let view = look([200, 100], 100.0, DVec3::ZERO, DVec3::X, DVec3::NEG_Z);
    agreed(&gpu(), &scene(&blobs), &RenderProfile::default(), view, "pairs");
}

#[test]
fn t9_far_from_the_origin_nothing_changes() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    let near = street(10_000, 1, 21);
    let view = look([200, 120], 150.0, DVec3::new(0.3, 0.1, 20.0), DVec3::Z, DVec3::Y);
    let here = render_one(&gpu, &Scene::from_gaussians(&near), &profile, view);
    for away_m in [1e4, 5e5, 4.5e6] {
        let away = DVec3::new(1.0, -1.0, 1.0) * (away_m / 64.0_f64).round() * 64.0;
        let mut far = near.clone();
        for mean in &mut far.means_m {
            *mean = (DVec3::from_array(*mean) + away).to_array();
        }
        let mut moved = view;
        moved.world_from_camera.position_m += away;
        let there = render_one(&gpu, &Scene::from_gaussians(&far), &profile, moved);
        let off = max_difference(&here.rgba, &there.rgba);
        assert!(off <= 1.0 / 255.0, "{away_m} m: off by {off}");
    }
}

#[test]
fn t11_t13_every_opacity_and_every_thinness() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    let logits = [f32::NEG_INFINITY, -100.0, -6.0, -5.0, 0.0, 2.0, 6.0, 100.0, f32::INFINITY];
    let peaks = logits.map(|logit| {
        let mut g = raw(&[Blob::default()]);
        g.logit_opacities[0] = logit;
        let scene = Scene::from_gaussians(&g);
        let image = agreed(&gpu, &scene, &profile, ahead([65, 65], 100.0), &format!("{logit}"));
        image.opacity.iter().fold(0.0_f32, |most, &o| most.max(o))
    });
    assert!(peaks.is_sorted() && peaks[..3] == [0.0; 3], "{peaks:?}");
    for sigma_m in [DVec3::splat(1e-8), DVec3::new(1.0, 1e-6, 1e-6), DVec3::new(1e-8, 1e-2, 1e-8)] {
        let thin = scene(&[Blob { sigma_m, ..Blob::default() }]);
        agreed(&gpu, &thin, &profile, ahead([96, 96], 120.0), &format!("{sigma_m}"));
    }
}

#[test]
fn t12_what_slips_past_the_gate_is_not_drawn() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    let good = street(2_000, 1, 24);
    let view = look([160, 100], 120.0, DVec3::new(0.3, 0.1, 20.0), DVec3::Z, DVec3::Y);
    let right = render_one(&gpu, &Scene::from_gaussians(&good), &profile, view);
    let more = with_one_more(&good, [0.3, 0.1, 22.0]);
    let seen = render_one(&gpu, &Scene::from_gaussians(&more), &profile, view);
    assert!(max_difference(&seen.rgba, &right.rgba) > 0.1, "unpoisoned, it would be seen");
    for (poison, poisoned) in poisoned(&more) {
        let image = agreed(&gpu, &Scene::from_gaussians(&poisoned), &profile, view, &poison);
        // One place further, a Gaussian may be in the next cluster, whose colours have other steps:
        // 1.5 / 32,767 of each coefficient.
        let off = max_difference(&image.rgba, &right.rgba);
        assert!(off < 1e-4, "{poison}: neighbours are off by {off}");
    }
}

#[test]
fn t16_little_or_nothing() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    for empty in [
        Scene::default(),
        scene(&[Blob { mean_m: DVec3::new(0.0, 0.0, -5.0), ..Blob::default() }]),
        scene(&[Blob { mean_m: DVec3::new(500.0, 0.0, 5.0), ..Blob::default() }]),
    ] {
        let image = render_one(&gpu, &empty, &profile, ahead([50, 40], 40.0));
        assert!(image.rgba.iter().all(|&v| v == 0.0) && image.rgb8.iter().all(|&v| v == 0));
        assert!(image.depth_m.iter().chain(&image.opacity).all(|&v| v == 0.0));
    }
    let one = scene(&[Blob::default()]);
    let image = agreed(&gpu, &one, &profile, ahead([50, 40], 40.0), "one splat");
    assert!(image.opacity.iter().any(|&o| o > 0.5));
    agreed(&gpu, &one, &profile, ahead([1, 1], 1.0), "one pixel");
}

/// 130,351 tiles, more than 65,535 workgroups; 6 KiB each in all planes are 800 MB, seven bindings of
/// lavapipe.
#[test]
fn t17_an_8k_image() {
    let view = ahead([7681, 4321], 4000.0);
    let street = Scene::from_gaussians(&street(3_000, 1, 22));
    let image = render_one(&gpu(), &street, &RenderProfile::default(), view);
    let truth = render_one(&cpu(), &street, &RenderProfile::default(), view);
    agree(&image, &truth).unwrap();
}

#[test]
fn t18_a_principal_point_far_off_centre() {
    let (gpu, profile, whole) = (gpu(), RenderProfile::default(), ahead([600, 400], 200.0));
    let street = Scene::from_gaussians(&street(20_000, 1, 23));
    let image = render_one(&gpu, &street, &profile, whole);
    for at in [[0, 0], [430, 300]] {
        let part = crop(whole, at, [170, 100]);
        let own = agreed(&gpu, &street, &profile, part, &format!("crop at {at:?}"));
        let off = crop_difference((&own, part), (&image, whole), at, 40);
        assert!(off <= 2e-3, "crop at {at:?}: off by {off}");
    }
}

#[test]
fn t19_the_stop_rule_exactly() {
    let layer = |i: i32| Blob {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-3 * f64::from(i)),
        sigma_m: DVec3::splat(20.0),
        rgb: [1.0; 3],
        ..Blob::default()
    };
    let gpu = gpu();
    let center = |count: i32, stop: f64| {
        let profile = RenderProfile { stop, ..RenderProfile::default() };
        let layers: Vec<Blob> = (0..count).map(layer).collect();
        let image = agreed(&gpu, &scene(&layers), &profile, ahead([9, 9], 1000.0), "layers");
        1.0 - image.opacity[4 * 9 + 4]
    };
    for count in [3, 4, 10_000] {
        let transmittance = center(count, 1.0001e-4);
        assert!((transmittance - 1e-3).abs() < 1e-6, "{count} layers: {transmittance:e}");
    }
    assert!((center(10_000, 0.9999e-4) - 1e-4).abs() < 1e-6);

    // Once stopped, a pixel stays stopped, though what follows would fit, and its neighbours go on.
    let dot = |i| Blob { sigma_m: DVec3::splat(0.015), ..layer(i) };
    let thin = |i| Blob { opacity: 0.1, ..layer(10 + i) };
    let layers: Vec<Blob> = (0..4).map(dot).chain((0..50).map(thin)).collect();
    let profile = RenderProfile { stop: 1.0001e-4, ..RenderProfile::default() };
    let image = agreed(&gpu, &scene(&layers), &profile, ahead([9, 9], 1000.0), "thin layers");
    let transmittance = 1.0 - image.opacity[4 * 9 + 4];
    assert!((transmittance - 1e-3).abs() < 1e-5, "{transmittance:e}");
}
