//! The same input gives the same bytes: at any number of threads, in any order of views, after any
//! other frame.

use std::sync::Mutex;

use wildcity_render::cpu::{Cpu, CpuError, Simd};
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{RenderProfile, Scene};

use crate::images::{cpu, render, render_one};
use crate::lenses::{lenses, rolling_view, street_scene};
use crate::scene_files::gaussians;
use crate::streets::{street, turning_views as views};

#[test]
fn a_hundred_repeats_are_equal_to_the_bit() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 11));
    let backend = cpu();
    let profile = RenderProfile::default();
    let first = render(&backend, &scene, &profile, &views());
    for repeat in 1..100 {
        assert!(render(&backend, &scene, &profile, &views()) == first, "repeat {repeat}");
    }
}

#[test]
fn the_number_of_threads_does_not_show() {
    let scene = Scene::from_gaussians(&street(40_000, 1, 12));
    let profile = RenderProfile::default();
    let by = |threads| render(&Cpu::new(threads, Simd::Best).unwrap(), &scene, &profile, &views());
    let one = by(1);
    for threads in [2, 3, 7] {
        assert!(by(threads) == one, "{threads} threads");
    }
}

/// AVX2 and AVX-512 have the same operations, of eight and of sixteen lanes. SSE4.2 has no fused
/// multiply-add: its images differ in last bits, and the backend says which instruction set it has.
#[test]
fn avx2_and_avx512_draw_the_same_bytes() {
    let [Ok(avx2), Ok(avx512)] = [Simd::Avx2, Simd::Avx512].map(|simd| Cpu::new(2, simd)) else {
        eprintln!("this machine lacks AVX-512 or AVX2, so that there is nothing to compare");
        return;
    };
    let (street, pose) = street_scene();
    let mut views = views();
    for (_, camera) in lenses() {
        views.push(View::new(camera, pose));
        views.push(rolling_view(camera, pose, ShutterDirection::TopToBottom));
        views.push(View::new(camera.scaled(80, 50).unwrap(), pose));
    }
    for profile in [
        RenderProfile::default(),
        RenderProfile { antialiased: true, lens_error_px: 1.0 / 64.0, ..RenderProfile::default() },
    ] {
        for view in &views {
            let by = |backend: &Cpu| render_one(backend, &street, &profile, *view);
            assert!(by(&avx2) == by(&avx512), "{view:?}");
        }
    }
    assert_eq!([avx2.detail(), avx512.detail()], ["Avx2", "Avx512"]);
    let sse = Cpu::new(2, Simd::Sse42).unwrap();
    assert_eq!(sse.detail(), "Sse4_2");
    let profile = RenderProfile::default();
    let by = |backend: &Cpu| render_one(backend, &street, &profile, views[0]);
    assert!(by(&sse) != by(&avx2), "not even a last bit");
}

#[test]
fn more_threads_than_any_machine_has_are_refused_before_they_start() {
    let refused = Cpu::new(wildcity_render::limits::RENDER_THREADS + 1, Simd::Best).unwrap_err();
    assert!(matches!(refused, CpuError::TooManyThreads { threads: 1025 }), "{refused}");
    assert_eq!(refused.to_string(), "1025 render threads; 0 to 1024 are accepted");
}

#[test]
fn a_view_does_not_see_its_neighbours() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 13));
    let backend = cpu();
    let profile = RenderProfile::default();
    let together = render(&backend, &scene, &profile, &views());
    for (view, image) in views().into_iter().zip(&together) {
        assert!(render_one(&backend, &scene, &profile, view) == *image);
    }
    let mut backward = views();
    backward.reverse();
    let mut reversed = render(&backend, &scene, &profile, &backward);
    reversed.reverse();
    assert!(reversed == together);
}

#[test]
fn a_frame_leaves_nothing_for_the_next() {
    let street = Scene::from_gaussians(&street(20_000, 1, 14));
    let cloud = Scene::from_gaussians(&gaussians(5_000, 3, 4.0, 15));
    let backend = cpu();
    let profile = RenderProfile::default();
    let fresh = render(&cpu(), &street, &profile, &views());
    render(&backend, &cloud, &profile, &views()[..2]);
    assert!(render(&backend, &street, &profile, &views()) == fresh);
}

#[test]
fn every_view_is_told_of_once_when_it_is_done() {
    let scene = Scene::from_gaussians(&street(5_000, 0, 16));
    let profile = RenderProfile::default();
    let views = views();
    let alone = render(&cpu(), &scene, &profile, &views);
    let mut images: Vec<Vec<u8>> = views.iter().map(|v| vec![0; 3 * v.camera.pixels()]).collect();
    let mut targets: Vec<Target<'_>> =
        images.iter_mut().map(|image| Target { rgb8: Some(image), ..Target::default() }).collect();
    let told = Mutex::new(Vec::new());
    let finished = |view: usize, target: &Target<'_>| {
        let rgb8 = target.rgb8.as_deref().unwrap().to_vec();
        told.lock().unwrap().push((view, rgb8));
    };
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    cpu().render(&frame, &mut targets, &finished).unwrap();
    let mut told = told.into_inner().unwrap();
    told.sort();
    assert_eq!(told.iter().map(|(view, _)| *view).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    assert!(told.iter().zip(&alone).all(|((_, rgb8), image)| *rgb8 == image.rgb8));
}

#[test]
fn targets_of_another_size_are_refused() {
    let scene = Scene::default();
    let profile = RenderProfile::default();
    let views = views();
    let frame = Frame { scene: &scene, profile: &profile, views: &views[..1] };
    let mut short = vec![0; 10];
    let target = Target { rgb8: Some(&mut short), ..Target::default() };
    let wanted = 3 * 150 * 90;
    assert_eq!(
        cpu().render(&frame, &mut [target], &|_, _| {}),
        Err(RenderError::TargetSize { view: 0, buffer: "rgb8", given: 10, wanted })
    );
    let targets_of_none = RenderError::Targets { targets: 0, views: 1 };
    assert_eq!(cpu().render(&frame, &mut [], &|_, _| {}), Err(targets_of_none));
    let nothing = Frame { views: &[], ..frame };
    assert_eq!(cpu().render(&nothing, &mut [], &|_, _| {}), Err(RenderError::Views { count: 0 }));
}
