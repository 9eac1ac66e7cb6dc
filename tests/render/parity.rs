//! The cpu backend against the reference backend.

use glam::DVec3;
use wildcity_render::View;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::reference::Reference;
use wildcity_scene::{Gaussians, RenderProfile, Scene};
use wildcity_twin::ingest;

use crate::data::real;
use crate::images::{agree, cpu, render, render_one, view_along};
use crate::scene_files::gaussians;
use crate::streets::{demo_street, street, street_views};

/// Asserts that all views agree, and returns the lowest PSNR in dB.
fn compare(scene: &Gaussians, profile: &RenderProfile, views: &[View]) -> f64 {
    let scene = Scene::from_gaussians(scene);
    let images = render(&cpu(), &scene, profile, views);
    let truths = render(&Reference, &scene, profile, views);
    let agreed = images.iter().zip(&truths).map(|(image, truth)| {
        assert!(truth.opacity.iter().any(|&o| o > 0.5), "the view is empty");
        agree(image, truth).unwrap()
    });
    agreed.fold(f64::INFINITY, f64::min)
}

#[test]
fn streets_of_every_sh_degree() {
    for degree in 0..=3 {
        compare(&street(30_000, degree, 5), &RenderProfile::default(), &street_views());
    }
}

#[test]
fn every_field_of_the_profile() {
    let scene = street(20_000, 1, 6);
    for setting in [
        "near=0.2",
        "far=40",
        "blur=0.1",
        "antialiased=true",
        "alpha_cap=0.999",
        "alpha_cut=0.02",
        "stop=0.01",
    ] {
        let mut profile = RenderProfile::default();
        profile.set(setting).unwrap();
        compare(&scene, &profile, &street_views());
    }
}

#[test]
fn a_cloud_around_the_camera() {
    // Centres up to 2 m from the camera, half of them behind it.
    let view = view_along([128, 96], 80.0, DVec3::ZERO, DVec3::new(0.3, -0.2, 1.0), DVec3::Y);
    compare(&gaussians(3_000, 2, 2.0, 8), &RenderProfile::default(), &[view]);
}

#[test]
fn the_demo_street_from_its_own_cameras() {
    // Thousands of coplanar surfels: where depths differ by less than the resolution of f32, the
    // backends may draw them in different orders.
    let (street, views) = demo_street();
    compare(&street, &RenderProfile::default(), &views);
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
    ] {
        let Some(path) = real(file) else { return };
        let scene = ingest::read(&path, &mut |_, _| {}).unwrap();
        let view = view_along([160, 120], 150.0, at, forward, down);
        let near = RenderProfile { near: 0.2, alpha_cap: 0.999, ..RenderProfile::default() };
        compare(&scene, &near, &[view]);
    }
}

#[test]
fn every_instruction_set_of_this_machine() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 7));
    let profile = RenderProfile::default();
    let truths = render(&Reference, &scene, &profile, &street_views());
    let mut compared = 0;
    for simd in [Simd::Sse42, Simd::Avx2, Simd::Avx512] {
        let Ok(backend) = Cpu::new(0, simd) else { continue };
        for (image, truth) in
            render(&backend, &scene, &profile, &street_views()).iter().zip(&truths)
        {
            agree(image, truth).unwrap_or_else(|e| panic!("{simd:?}: {e}"));
        }
        compared += 1;
    }
    assert!(compared > 0, "no instruction set was compared");
}

/// A comparison that cannot fail proves nothing.
#[test]
fn a_mutated_scene_is_caught() {
    let right = street(20_000, 1, 9);
    let profile = RenderProfile::default();
    let view = street_views()[0];
    let truth = render_one(&Reference, &Scene::from_gaussians(&right), &profile, view);
    let caught = |wrong: &Gaussians| {
        let image = render_one(&cpu(), &Scene::from_gaussians(wrong), &profile, view);
        agree(&image, &truth).is_err()
    };
    assert!(!caught(&right));
    let mutations: [fn(&mut Gaussians); 5] = [
        |g| g.means_m.iter_mut().for_each(|m| m[0] += 0.002),
        |g| g.quats_wxyz.iter_mut().for_each(|q| q[1] = -q[1]),
        |g| g.ln_scales.iter_mut().for_each(|s| s.swap(0, 2)),
        |g| g.logit_opacities.iter_mut().for_each(|o| *o += 0.01),
        |g| g.sh.chunks_mut(12).for_each(|k| k.swap(3, 9)),
    ];
    for (i, mutate) in mutations.into_iter().enumerate() {
        let mut wrong = right.clone();
        mutate(&mut wrong);
        assert!(caught(&wrong), "mutation {i} went unnoticed");
    }
}
