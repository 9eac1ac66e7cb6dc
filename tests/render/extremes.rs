//! Stiff and extreme scenes, by the numbers of the design's stress table. Each has broken a
//! published renderer.

use glam::{DQuat, DVec3};
use wildcity::geometry::Pose;
use wildcity::render::reference::Reference;
use wildcity::render::{Backend, Frame, RenderError, Target, View};
use wildcity::scene::{Gaussians, RenderProfile, Scene};

use crate::blobs::{Blob, ahead, raw, scene};
use crate::images::{Image, agree, cpu, crop, crop_difference, look, max_difference, render_one};
use crate::poisons::{poisoned, with_one_more};
use crate::scene_files::Random;
use crate::streets::street;

fn both(scene: &Scene, profile: &RenderProfile, view: View) -> (Image, Image) {
    (render_one(&cpu(), scene, profile, view), render_one(&Reference, scene, profile, view))
}

/// Both images, after it was made sure that they agree and that something is on them.
fn agreed(scene: &Scene, profile: &RenderProfile, view: View) -> Image {
    let (image, truth) = both(scene, profile, view);
    assert!(truth.opacity.iter().any(|&o| o > 0.0), "nothing is on the image");
    agree(&image, &truth).unwrap();
    image
}

#[test]
fn t1_needles_at_every_angle() {
    let profile = RenderProfile::default();
    let view = ahead([640, 480], 1000.0);
    for sigma_px in [1e3, 3e3, 1e4] {
        for degrees in 0..90 {
            let angle = f64::from(degrees).to_radians() * 2.0;
            let needle = scene(&[Blob {
                rotation: DQuat::from_rotation_z(angle),
                sigma_m: DVec3::new(sigma_px * 5.0 / 1000.0, 1e-4, 1e-4),
                ..Blob::default()
            }]);
            let (image, truth) = both(&needle, &profile, view);
            let off = max_difference(&image.opacity, &truth.opacity);
            assert!(off <= 2e-3, "{sigma_px} px at {degrees}: alpha off by {off}");
            assert!(image.opacity.iter().any(|&o| o > 0.5), "{sigma_px} px at {degrees}: culled");
        }
    }
}

#[test]
fn t2_long_things_on_the_ground_beside_the_view() {
    // Centres outside the image on every side, long enough to reach into it.
    for [x, y] in [[6.0, 1.6], [-6.0, 1.6], [0.5, 7.0], [9.0, -7.0]] {
        for angle in [0.0, 0.5, 1.2, 2.5] {
            let long = scene(&[Blob {
                mean_m: DVec3::new(x, y, 4.0),
                rotation: DQuat::from_rotation_y(angle),
                sigma_m: DVec3::new(4.0, 0.05, 0.3),
                ..Blob::default()
            }]);
            let (image, truth) = both(&long, &RenderProfile::default(), ahead([320, 240], 200.0));
            agree(&image, &truth).unwrap_or_else(|e| panic!("({x}, {y}) at {angle}: {e}"));
        }
    }
}

#[test]
fn t3_a_splat_larger_than_the_screen() {
    let wall = |sigma_m| Blob { sigma_m: DVec3::splat(sigma_m), ..Blob::default() };
    let view = ahead([333, 250], 300.0);
    for sigma_m in [10.0, 1e3, 1e4] {
        let image = agreed(&scene(&[wall(sigma_m)]), &RenderProfile::default(), view);
        assert!(image.opacity.iter().all(|&o| (o - 0.9).abs() < 0.15), "{sigma_m} m");
    }
}

#[test]
fn t3_a_needle_of_two_thousand_million_pixels() {
    // 22 km long, 1 mm thin, a centimetre before a lens of 1,000 px: xx² is 1e37.
    for angle in [0.0, 0.4, 0.8, 1.3] {
        let needle = scene(&[Blob {
            mean_m: DVec3::new(0.0, 0.0, 0.0101),
            rotation: DQuat::from_rotation_z(angle),
            sigma_m: DVec3::new(2.2e4, 1e-3, 1e-3),
            ..Blob::default()
        }]);
        let image = agreed(&needle, &RenderProfile::default(), ahead([160, 120], 1000.0));
        assert!(image.opacity.iter().all(|o| o.is_finite()));
    }
}

#[test]
fn t4_closer_than_a_hand() {
    for near in [0.01, 0.2] {
        let profile = RenderProfile { near, ..RenderProfile::default() };
        for z in [0.0100001, 0.011, 0.05, 0.19, 0.21] {
            let close = scene(&[Blob {
                mean_m: DVec3::new(0.002, -0.001, z),
                sigma_m: DVec3::new(0.003, 0.02, 0.1),
                ..Blob::default()
            }]);
            let (image, truth) = both(&close, &profile, ahead([160, 120], 1800.0));
            agree(&image, &truth).unwrap_or_else(|e| panic!("{z} m, near {near} m: {e}"));
            let drawn = image.opacity.iter().any(|&o| o > 0.0);
            assert_eq!(drawn, z > near, "{z} m, near {near} m");
        }
    }
}

#[test]
fn t5_around_and_behind_the_camera() {
    let inside =
        Blob { mean_m: DVec3::new(0.1, 0.0, 0.3), sigma_m: DVec3::splat(2.0), ..Blob::default() };
    agreed(&scene(&[inside]), &RenderProfile::default(), ahead([160, 120], 100.0));
    let behind =
        Blob { mean_m: DVec3::new(0.0, 0.0, -1.0), sigma_m: DVec3::splat(3.0), ..Blob::default() };
    let (image, _) = both(&scene(&[behind]), &RenderProfile::default(), ahead([160, 120], 100.0));
    assert!(image.opacity.iter().all(|&o| o == 0.0), "a mirrored contribution");
}

#[test]
fn t6_equal_depths_keep_the_order_of_ids() {
    // Two walls of duplicates in one plane: whoever has the lower id is in front.
    let grid = |rgb: [f64; 3]| {
        (0..100).map(move |i| Blob {
            mean_m: DVec3::new(0.1 * f64::from(i % 10), 0.1 * f64::from(i / 10), 5.0),
            rgb,
            ..Blob::default()
        })
    };
    let blobs: Vec<Blob> = grid([1.0, 0.0, 0.0]).chain(grid([0.0, 1.0, 0.0])).collect();
    let image = agreed(&scene(&blobs), &RenderProfile::default(), ahead([200, 150], 150.0));
    for _ in 0..100 {
        let again =
            render_one(&cpu(), &scene(&blobs), &RenderProfile::default(), ahead([200, 150], 150.0));
        assert!(again == image);
    }
    let center = 4 * (80 * 200 + 110);
    assert!(image.rgba[center] > image.rgba[center + 1], "the first of each pair is in front");
}

#[test]
fn t7_depths_from_a_centimetre_to_ten_kilometres() {
    // Each a little behind the other, by one step of f32, and each covering the one behind.
    let mut blobs = Vec::new();
    let mut expected = Vec::new();
    // Along +x, where chunks follow each other, so that centres keep their f32.
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
        expected.push(((slope * 100.0 + 100.0) as usize, 50));
    }
    let view = look([200, 100], 100.0, DVec3::ZERO, DVec3::X, DVec3::NEG_Z);
    let image = agreed(&scene(&blobs), &RenderProfile::default(), view);
    for (x, y) in expected {
        let pixel = 4 * (y * 200 + x);
        assert!(image.rgba[pixel] > 0.8 && image.rgba[pixel + 1] < 0.2, "at column {x}");
    }
}

#[test]
fn t9_far_from_the_origin_nothing_changes() {
    let near = street(10_000, 1, 21);
    let profile = RenderProfile::default();
    let view = look([200, 120], 150.0, DVec3::new(0.3, 0.1, 20.0), DVec3::Z, DVec3::Y);
    let here = render_one(&cpu(), &Scene::from_gaussians(&near), &profile, view);
    for away_m in [1e4, 5e5, 4.5e6] {
        // Multiples of a cell, so that the chunks hold the same numbers.
        let away = DVec3::new(1.0, -1.0, 1.0) * (away_m / 64.0_f64).round() * 64.0;
        let mut far = near.clone();
        for mean in &mut far.means_m {
            *mean = (DVec3::from_array(*mean) + away).to_array();
        }
        let mut moved = view;
        moved.world_from_camera.position_m += away;
        let there = render_one(&cpu(), &Scene::from_gaussians(&far), &profile, moved);
        let off = max_difference(&here.rgba, &there.rgba);
        assert!(off <= 1.0 / 255.0, "{away_m} m: off by {off}");
    }
}

#[test]
fn t11_every_opacity() {
    let profile = RenderProfile::default();
    let view = ahead([65, 65], 100.0);
    let peak = |logit: f32| {
        let mut g = raw(&[Blob::default()]);
        g.logit_opacities[0] = logit;
        let (image, truth) = both(&Scene::from_gaussians(&g), &profile, view);
        agree(&image, &truth).unwrap();
        image.opacity.iter().fold(0.0_f32, |most, &o| most.max(o))
    };
    let logits = [f32::NEG_INFINITY, -100.0, -6.0, -5.0, 0.0, 2.0, 6.0, 100.0, f32::INFINITY];
    let peaks: Vec<f32> = logits.into_iter().map(peak).collect();
    assert!(peaks.is_sorted(), "{peaks:?}");
    assert_eq!(peaks[..3], [0.0; 3], "below 1/255");
    // ln(1/254) is the logit of 1/255: seen just above, not below.
    let cut = (1.0_f32 / 254.0).ln();
    assert_eq!([peak(cut - 1e-3) > 0.0, peak(cut + 1e-3) > 0.0], [false, true]);
    assert!((peaks[8] - 0.99).abs() < 1e-6, "the cap");
}

#[test]
fn t12_what_slips_past_the_gate_is_not_drawn() {
    let good = street(2_000, 1, 24);
    let view = look([160, 100], 120.0, DVec3::new(0.3, 0.1, 20.0), DVec3::Z, DVec3::Y);
    let profile = RenderProfile::default();
    let right = render_one(&cpu(), &Scene::from_gaussians(&good), &profile, view);
    // It must not be seen.
    let more = with_one_more(&good, [0.3, 0.1, 22.0]);
    let seen = render_one(&cpu(), &Scene::from_gaussians(&more), &profile, view);
    assert!(max_difference(&seen.rgba, &right.rgba) > 0.1, "unpoisoned, it would be seen");
    for (poison, poisoned) in poisoned(&more) {
        let (image, truth) = both(&Scene::from_gaussians(&poisoned), &profile, view);
        assert!(max_difference(&image.rgba, &right.rgba) < 1e-6, "{poison}");
        agree(&image, &truth).unwrap_or_else(|e| panic!("{poison}: {e}"));
    }
}

#[test]
fn t13_needles_and_dust_are_as_wide_as_the_blur() {
    for sigma_m in [DVec3::splat(1e-8), DVec3::new(1.0, 1e-6, 1e-6), DVec3::new(1e-8, 1e-2, 1e-8)] {
        agreed(
            &scene(&[Blob { sigma_m, ..Blob::default() }]),
            &RenderProfile::default(),
            ahead([96, 96], 120.0),
        );
    }
    let dust = scene(&[Blob { sigma_m: DVec3::splat(1e-8), ..Blob::default() }]);
    let image = agreed(&dust, &RenderProfile::default(), ahead([9, 9], 100.0));
    // The middle of 9 px is the centre of a pixel, which has all of it.
    assert!((image.opacity[4 * 9 + 4] - 0.9).abs() < 1e-4);
}

#[test]
fn t15_too_much_is_refused_and_the_next_frame_is_right() {
    // 400,000 tiles of an 10,240 px square times 340 walls are beyond 2^27 pairs.
    let wall = || Blob { sigma_m: DVec3::splat(1e3), opacity: 0.01, ..Blob::default() };
    let walls: Vec<Blob> = (0..340).map(|_| wall()).collect();
    let (backend, profile) = (cpu(), RenderProfile::default());
    let view = ahead([10_240, 10_240], 300.0);
    let small = ahead([64, 48], 50.0);
    let walls = scene(&walls);
    let fresh = render_one(&backend, &walls, &profile, small);
    let mut opacity = vec![7.0; view.camera.pixels()];
    let target = Target { opacity: Some(&mut opacity), ..Target::default() };
    let frame = Frame { scene: &walls, profile: &profile, views: &[view] };
    let refused = backend.render(&frame, &mut [target], &|_, _| {}).unwrap_err();
    assert!(matches!(refused, RenderError::TooMany { .. }), "{refused}");
    assert!(opacity.iter().all(|&o| o == 7.0), "nothing was written");
    assert!(render_one(&backend, &walls, &profile, small) == fresh);
}

#[test]
fn t16_little_or_nothing() {
    let profile = RenderProfile::default();
    let view = ahead([50, 40], 40.0);
    for empty in [
        Scene::default(),
        scene(&[Blob { mean_m: DVec3::new(0.0, 0.0, -5.0), ..Blob::default() }]),
        scene(&[Blob { mean_m: DVec3::new(500.0, 0.0, 5.0), ..Blob::default() }]),
    ] {
        let (image, truth) = both(&empty, &profile, view);
        assert!(image == truth);
        assert!(image.rgba.iter().all(|&v| v == 0.0) && image.rgb8.iter().all(|&v| v == 0));
    }
    agreed(&scene(&[Blob::default()]), &profile, view);
    agreed(&scene(&[Blob::default()]), &profile, ahead([1, 1], 1.0));
}

#[test]
fn t17_an_8k_image_is_its_crops() {
    let whole = ahead([7681, 4321], 4000.0);
    let street = Scene::from_gaussians(&street(3_000, 1, 22));
    let image = render_one(&cpu(), &street, &RenderProfile::default(), whole);
    for at in [[0, 0], [3600, 1900], [7681 - 901, 4321 - 700]] {
        let part = crop(whole, at, [901, 700]);
        let own = agreed(&street, &RenderProfile::default(), part);
        let off = crop_difference((&own, part), (&image, whole), at, 300);
        assert!(off <= 2e-3, "crop at {at:?}: off by {off}");
    }
}

#[test]
fn t18_a_principal_point_far_off_centre() {
    let whole = ahead([600, 400], 200.0);
    let street = Scene::from_gaussians(&street(20_000, 1, 23));
    let image = render_one(&cpu(), &street, &RenderProfile::default(), whole);
    for at in [[0, 0], [430, 300]] {
        let part = crop(whole, at, [170, 100]);
        let own = agreed(&street, &RenderProfile::default(), part);
        let off = crop_difference((&own, part), (&image, whole), at, 40);
        assert!(off <= 2e-3, "crop at {at:?}: off by {off}");
    }
}

/// Sixteen views of 4,400,000 Gaussians each, and each of them alone, which the definition agrees with.
#[test]
#[ignore = "gigabytes of memory and a minute: cargo test --release --test render t21 -- --ignored"]
fn t21_seventy_million_sort_keys() {
    let n = 4_400_000;
    let mut random = Random(25);
    let mut dust = Gaussians::with_capacity(0, n);
    for _ in 0..n {
        let z = 5.0 + 100.0 * random.unit();
        let [x, y] = [0; 2].map(|_| 0.8 * (random.unit() - 0.5) * z);
        dust.means_m.push([x, y, z]);
        dust.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        dust.ln_scales.push([-4.0; 3]);
        dust.logit_opacities.push(-5.0);
        dust.sh.extend([0; 3].map(|_| random.between(-1.0, 1.0)));
    }
    let scene = Scene::from_gaussians(&dust);
    drop(dust);
    let views: Vec<View> = (0..16)
        .map(|i| {
            let at = DVec3::new(0.0, 0.0, 0.1 * f64::from(i));
            look([16, 16], 15.0, at, DVec3::Z, DVec3::Y)
        })
        .collect();
    let (backend, profile) = (cpu(), RenderProfile::default());
    let mut images: Vec<Vec<u8>> = views.iter().map(|v| vec![0; 3 * v.camera.pixels()]).collect();
    let mut targets: Vec<Target<'_>> =
        images.iter_mut().map(|image| Target { rgb8: Some(image), ..Target::default() }).collect();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    let stats = backend.render(&frame, &mut targets, &|_, _| {}).unwrap();
    assert!(stats.visible_pairs >= 70_000_000, "{} keys", stats.visible_pairs);
    for (view, image) in views.iter().zip(&images) {
        assert!(render_one(&backend, &scene, &profile, *view).rgb8 == *image);
    }
    agreed(&scene, &profile, views[7]);
}

#[test]
fn t19_the_stop_rule_exactly() {
    // Layers of alpha 0.9 at the centre: the transmittance is 0.1, 0.01, 0.001, then 1e-4: the
    // fourth would reach the stop and is left out. Ten thousand layers change nothing.
    let layer = |i: i32| Blob {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-3 * f64::from(i)),
        sigma_m: DVec3::splat(20.0),
        opacity: 0.9,
        rgb: [1.0; 3],
        ..Blob::default()
    };
    let profile = RenderProfile { stop: 1.0001e-4, ..RenderProfile::default() };
    let center = |count: i32, profile: &RenderProfile| {
        let layers: Vec<Blob> = (0..count).map(layer).collect();
        let (image, truth) = both(&scene(&layers), profile, ahead([9, 9], 1000.0));
        agree(&image, &truth).unwrap();
        1.0 - image.opacity[4 * 9 + 4]
    };
    for count in [3, 4, 10_000] {
        let transmittance = center(count, &profile);
        assert!((transmittance - 1e-3).abs() < 1e-6, "{count} layers: {transmittance:e}");
    }
    let further = RenderProfile { stop: 0.9999e-4, ..profile };
    assert!((center(10_000, &further) - 1e-4).abs() < 1e-6);
}

#[test]
fn a_pose_turns_and_moves_the_image() {
    // A blob ahead of a camera that looks along +x lies in the middle of its image.
    let east = Pose {
        position_m: DVec3::new(3.0, 0.0, 0.0),
        rotation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
    };
    let view = View { world_from_camera: east, ..ahead([65, 65], 100.0) };
    let blob = scene(&[Blob { mean_m: DVec3::new(8.0, 0.0, 0.0), ..Blob::default() }]);
    let image = agreed(&blob, &RenderProfile::default(), view);
    let brightest = image.opacity.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
    assert_eq!(brightest, 32 * 65 + 32);
    assert!((image.depth_m[brightest] - 5.0).abs() < 1e-4);
}
