//! Skies: compared with numpy, baked maps with the exact sky, and skies behind Gaussians.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::sky::{CubeMap, DrawableSky, SKY_CUT, SkyError, SkyModel};
use wildcity_scene::{RenderProfile, Scene, Sky};

use crate::images::{agree, cpu, max_difference, render, render_one, view_along};
use crate::scene_files::Random;
use crate::skies::{demo_model, empty, network, sky};
use crate::streets::{street, street_views};

/// A sky that is evaluated for every pixel.
const EXACT: RenderProfile = RenderProfile { sky_error: 0.0, ..RenderProfile::DEFAULT };

/// A sky that is baked with a small error.
const FINE: RenderProfile = RenderProfile { sky_error: 0.001, ..RenderProfile::DEFAULT };

fn anywhere(random: &mut Random) -> DVec3 {
    let mut one = || 2.0 * random.unit() - 1.0;
    loop {
        let away = DVec3::new(one(), one(), one());
        if (0.01..1.0).contains(&away.length_squared()) {
            return away.normalize();
        }
    }
}

fn cube_map(drawn: DrawableSky) -> Arc<CubeMap> {
    match drawn {
        DrawableSky::CubeMap(map) => map,
        DrawableSky::Network(_) => panic!("it is not baked"),
    }
}

/// The values are those of `python scenes/sky.py truths`: a direction, its colour with the mean
/// appearance, and its colour with the appearance of image 1.
#[test]
fn the_network_is_what_numpy_says() {
    let truths: Vec<[f64; 9]> = serde_json::from_str(include_str!("sky.json")).unwrap();
    assert!(truths.len() > 40);
    for (image, first) in [(None, 3), (Some(1), 6)] {
        let sky = Sky::new(demo_model(image), DMat3::IDENTITY);
        for truth in &truths {
            let [x, y, z] = [truth[0], truth[1], truth[2]];
            let rgb = sky.rgb(DVec3::new(x, y, z));
            let wanted = DVec3::new(truth[first], truth[first + 1], truth[first + 2]);
            // Rust's mean of the appearances is rounded to f32.
            assert!((rgb - wanted).abs().max_element() < 1e-6, "{truth:?}: {rgb}");
        }
    }
}

#[test]
fn what_backends_evaluate_is_exact() {
    let scene = empty(Arc::new(Sky::new(demo_model(None), DMat3::IDENTITY)));
    let forward = DVec3::new(-0.7, -0.5, 0.5);
    let view = view_along([96, 80], 60.0, DVec3::new(1e5, 3.0, 2.0), forward, DVec3::NEG_Z);
    let sky = scene.sky.as_ref().unwrap();
    let truth: Vec<f32> = (0..96 * 80)
        .flat_map(|pixel| {
            let at_px = DVec2::new(f64::from(pixel % 96) + 0.5, f64::from(pixel / 96) + 0.5);
            let rgb = sky.rgb(view.ray_world(at_px).unwrap()).to_array();
            [rgb[0] as f32, rgb[1] as f32, rgb[2] as f32, 0.0]
        })
        .collect();
    for simd in [Simd::Best, Simd::Sse42] {
        let image = render_one(&Cpu::new(0, simd).unwrap(), &scene, &EXACT, view);
        let off = max_difference(&image.rgba, &truth);
        assert!(off < 1e-5, "{simd:?}: off by {off}");
        assert!(image.opacity.iter().all(|&opacity| opacity == 0.0), "a sky covers nothing");
    }
    // The reference backend evaluates the sky exactly with every profile.
    let image = render_one(&Reference, &scene, &RenderProfile::DEFAULT, view);
    assert!(max_difference(&image.rgba, &truth) < 1e-6);
}

#[test]
fn networks_of_every_shape() {
    let view = view_along([33, 21], 20.0, DVec3::ZERO, DVec3::new(0.2, 1.0, 0.4), DVec3::NEG_Z);
    for (identity, octaves, appearance, skip) in [
        (true, 0, 0, true),
        (true, 1, 0, false),
        (false, 6, 16, true),
        (true, 7, 16, true),
        (true, 10, 3, false),
    ] {
        let model = SkyModel::network(network(identity, octaves, appearance, skip));
        let scene = empty(Arc::new(Sky::new(model, DMat3::IDENTITY)));
        let [image, truth] =
            [&cpu() as &dyn Backend, &Reference].map(|b| render_one(b, &scene, &EXACT, view));
        let off = max_difference(&image.rgba, &truth.rgba);
        // The highest octave multiplies a direction in f32, and its error, by 512: 3e-5 rad.
        let most = if octaves == 10 { 3e-4 } else { 1e-5 };
        assert!(off < most, "{identity} {octaves} {appearance} {skip}: off by {off}");
    }
}

#[test]
fn a_baked_sky_is_within_its_bound_everywhere() {
    let mut random = Random(8);
    let mut edges = Vec::new();
    for wanted in [0.05, 0.005, 0.0005] {
        let sky = sky();
        let map = cube_map(sky.drawable(wanted).unwrap());
        assert!(map.error() <= wanted, "{} for {wanted}", map.error());
        let mut worst: f64 = 0.0;
        for _ in 0..100_000 {
            let away = anywhere(&mut random);
            let exact = sky.rgb(away);
            worst = worst.max((map.rgb(sky.sky_from_world() * away) - exact).abs().max_element());
        }
        assert!(worst <= map.error(), "{worst}, stated {}", map.error());
        // A bound that is far too large would waste memory.
        assert!(worst > 0.1 * map.error(), "{worst}, stated {}", map.error());
        edges.push(map.edge());
        assert!(Arc::ptr_eq(&map, &cube_map(sky.drawable(wanted).unwrap())), "baked once");
    }
    assert!(edges.is_sorted() && edges[0] < edges[2], "{edges:?}");
}

/// Sessions with different errors have a map each, and do not cause each other to bake again.
#[test]
fn every_error_keeps_its_map() {
    let sky = sky();
    let wanted = [0.05, 0.0005, 0.005];
    let maps = wanted.map(|wanted| cube_map(sky.drawable(wanted).unwrap()));
    let bytes = sky.bytes();
    for (wanted, map) in wanted.into_iter().zip(&maps) {
        assert!(Arc::ptr_eq(&cube_map(sky.drawable(wanted).unwrap()), map), "{wanted}");
    }
    // A session gets the coarsest map that is good enough, in whichever order sessions ask.
    let coarsest = cube_map(sky.drawable(1.0).unwrap());
    assert_eq!(coarsest.edge(), 129);
    assert!(coarsest.error() <= 0.05 && Arc::ptr_eq(&coarsest, &maps[0]));
    assert_eq!(sky.bytes(), bytes);
    let fresh = Sky::new(sky.model().clone(), sky.sky_from_world());
    assert!(*cube_map(fresh.drawable(0.005).unwrap()) == *maps[2], "whatever was asked for before");
}

#[test]
fn the_demo_sky_is_within_the_default_bound() {
    let sky = Sky::new(demo_model(None), DMat3::IDENTITY);
    let map = cube_map(sky.drawable(RenderProfile::DEFAULT.sky_error).unwrap());
    let mut random = Random(9);
    let mut worst: f64 = 0.0;
    for _ in 0..20_000 {
        let away = anywhere(&mut random);
        worst = worst.max((map.rgb(away) - sky.rgb(away)).abs().max_element());
    }
    assert!(
        worst <= map.error() && map.error() <= RenderProfile::DEFAULT.sky_error,
        "{worst}, stated {}",
        map.error()
    );
}

#[test]
fn a_sky_too_sharp_for_any_map_is_refused_with_the_way_out() {
    let mut layers = network(true, 7, 0, false).layers().clone();
    layers[0].weight.iter_mut().for_each(|weight| *weight *= 40.0);
    let sharp = wildcity_scene::sky::Network::new(layers, Vec::new()).unwrap();
    let sky = Arc::new(Sky::new(SkyModel::network(sharp), DMat3::IDENTITY));
    let error = sky.drawable(1e-4).unwrap_err();
    assert!(matches!(error, SkyError::Coarse { edge: 1025, .. }), "{error}");
    assert!(error.to_string().contains("set sky_error to"), "{error}");
    let scene = empty(sky);
    let profile = RenderProfile { sky_error: 1e-4, ..RenderProfile::DEFAULT };
    let view = view_along([8, 8], 8.0, DVec3::ZERO, DVec3::X, DVec3::NEG_Z);
    let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
    let mut image = vec![0.0; 4 * 64];
    let mut targets = [Target { rgba: Some(&mut image), ..Target::default() }];
    let refused = cpu().render(&frame, &mut targets, &|_, _| {});
    assert_eq!(refused, Err(RenderError::Sky(error)));
    // Evaluated exactly, it is drawn.
    render_one(&cpu(), &scene, &EXACT, view);
}

/// A sky behind a street: the two backends agree, and it adds the right colours to those of the
/// street without a sky.
#[test]
fn a_sky_behind_gaussians() {
    let mut gaussians = street(20_000, 1, 6);
    // In front of each camera three layers of opacity 0.9, which leave a transmittance of 1e-3.
    for view in street_views() {
        for behind in [5.0, 5.1, 5.2] {
            let axes = view.world_from_camera.rotation_matrix();
            let mean_m = view.world_from_camera.position_m + behind * axes.z_axis;
            gaussians.means_m.push(mean_m.to_array());
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([0.0; 3]);
            gaussians.logit_opacities.push(0.9_f32.ln() - 0.1_f32.ln());
            gaussians.sh.extend([0.1; 12]);
        }
    }
    let alone = Scene::from_gaussians(&gaussians);
    let scene = Scene { sky: Some(sky()), ..alone.clone() };
    for profile in [FINE, EXACT] {
        let images = render(&cpu(), &scene, &profile, &street_views());
        let truths = render(&Reference, &scene, &EXACT, &street_views());
        let without = render(&cpu(), &alone, &profile, &street_views());
        for ((image, truth), (without, view)) in
            images.iter().zip(&truths).zip(without.iter().zip(street_views()))
        {
            let db = agree(image, truth).unwrap();
            assert!(profile != EXACT || db > 75.0, "{db}");
            assert_eq!((&image.opacity, &image.depth_m), (&without.opacity, &without.depth_m));
            let sky = scene.sky.as_ref().unwrap();
            let mut shown = 0;
            let mut hidden = 0;
            for (pixel, (with, alone)) in
                image.rgba.chunks(4).zip(without.rgba.chunks(4)).enumerate()
            {
                let width = view.camera.width_px as usize;
                let at = |k: usize| k as f64 + 0.5;
                let at_px = DVec2::new(at(pixel % width), at(pixel / width));
                let rgb = sky.rgb(view.ray_world(at_px).unwrap());
                let background = 1.0 - f64::from(alone[3]);
                // Close to the cut the rounding of 1 - (1 - T) decides.
                if (background - SKY_CUT).abs() < 1e-6 {
                    continue;
                }
                for c in 0..3 {
                    let added = f64::from(with[c] - alone[c]);
                    let wanted = if background > SKY_CUT { background * rgb[c] } else { 0.0 };
                    assert!((added - wanted).abs() < 2.1e-3, "{added}, not {wanted}");
                }
                if background > SKY_CUT { shown += 1 } else { hidden += 1 }
            }
            assert!(shown > 100 && hidden > 100, "{shown} {hidden}");
        }
    }
}

/// A sky is infinitely far away: its image does not change when the camera moves, and does when it
/// rotates.
#[test]
fn a_sky_has_no_parallax() {
    let scene = empty(sky());
    let at = |position_m, forward| {
        let view = view_along([40, 30], 30.0, position_m, forward, DVec3::NEG_Z);
        render_one(&cpu(), &scene, &RenderProfile::DEFAULT, view).rgba
    };
    let here = at(DVec3::ZERO, DVec3::X);
    assert_eq!(here, at(DVec3::new(1e6, -3e5, 80.0), DVec3::X));
    assert!(max_difference(&here, &at(DVec3::ZERO, DVec3::new(1.0, 0.2, 0.0))) > 0.01);
}

#[test]
fn images_are_their_own_map() {
    // Each face has its own red, and its green and blue rise to the right and to the bottom.
    let side = 16;
    let mut rgb8 = Vec::new();
    for face in 0..6_u8 {
        for k in 0..side * side {
            rgb8.extend([40 * face, 8 * (k % side) as u8, 8 * (k / side) as u8]);
        }
    }
    let sky = Sky::new(SkyModel::cube(CubeMap::from_faces(side, &rgb8).unwrap()), DMat3::IDENTITY);
    let scene = empty(Arc::new(sky));
    for forward in [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::new(0.5, -0.7, 0.9)] {
        let view = view_along([64, 48], 24.0, DVec3::ZERO, forward, DVec3::new(0.11, 0.13, -1.0));
        for profile in [RenderProfile::DEFAULT, EXACT] {
            let [image, truth] =
                [&cpu() as &dyn Backend, &Reference].map(|b| render_one(b, &scene, &profile, view));
            // No pixel looks exactly along the edge of two faces, where either would be right: the
            // closest is 6e-5 off.
            let off = |limit: f32| {
                let pairs = image.rgba.iter().zip(&truth.rgba);
                let within = pairs.filter(|(a, b)| (*a - *b).abs() <= limit).count();
                image.rgba.len() - within
            };
            assert_eq!(off(0.02), 0, "{forward}");
            assert!(off(1e-4) < image.rgba.len() / 100, "{forward}: {} values", off(1e-4));
        }
    }
}

#[test]
fn a_background_is_a_sky_of_one_colour() {
    let mut profile = RenderProfile::default();
    profile.set("background=0.25,0.5,1").unwrap();
    let view: View = view_along([20, 20], 20.0, DVec3::ZERO, DVec3::X, DVec3::NEG_Z);
    for backend in [&cpu() as &dyn Backend, &Reference] {
        let image = render_one(backend, &Scene::default(), &profile, view);
        assert!(image.rgb8.chunks(3).all(|rgb| rgb == [64, 128, 255]), "{:?}", &image.rgb8[..3]);
        // With a sky the background is not visible.
        let scene = empty(sky());
        let with = render_one(backend, &scene, &profile, view);
        assert_eq!(with, render_one(backend, &scene, &RenderProfile::DEFAULT, view));
    }
}
