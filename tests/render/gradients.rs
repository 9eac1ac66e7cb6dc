//! Gradients: `reference` against its own differences, and the fast backends against `reference`.
//! (`tests/train` compares both with vectors that others computed.)

use std::iter::zip;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_render::compare::gradients::{by_group, waves};
use wildcity_render::compare::images::render_images;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gradient::{Differentiate, GaussianImages, GradientError, Gradients, Twist};
use wildcity_render::reference::gradient::{Decisions, Images, Source, SourceGradient, Sources};
use wildcity_render::reference::{Gaussian, Reference};
use wildcity_render::{Backend, Frame, RollingShutter, View};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::camera::{Pinhole, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Chunk, RenderProfile, Scene};

use crate::gradient_cases::{check_actors, check_lenses, check_pinholes, check_refusals};
use crate::images::cpu;
use crate::lenses::{lenses, rolling_view};
use crate::scene_files::Random;
use crate::streets::{street, turning_views};

#[test]
fn cpu_has_the_gradients_of_the_reference() {
    check_pinholes(&cpu());
}

#[test]
fn cpu_has_the_gradients_of_every_lens_and_shutter() {
    check_lenses(&cpu());
}

#[test]
fn cpu_has_the_gradients_of_actors() {
    check_actors(&cpu());
}

#[test]
fn losses_that_do_not_fit_are_refused() {
    check_refusals(&cpu());
    check_refusals(&Reference);
}

#[test]
fn a_frame_beyond_the_limit_is_refused() {
    let backend = cpu();
    let scene = Scene::from_gaussians(&street(60_000, 1, 12));
    let profile = RenderProfile::default();
    let views = turning_views();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    let differ = || {
        let mut loss = |images: &[GaussianImages]| images.to_vec();
        backend.differentiate(&frame, false, &mut loss, &mut Gradients::default())
    };
    assert!(differ().is_ok());
    backend.limit_frame_bytes(1 << 20);
    let refused = differ();
    assert!(matches!(refused, Err(GradientError::Memory { .. })), "{refused:?}");
}

#[test]
fn gradients_do_not_depend_on_threads_or_on_earlier_frames() {
    let scene = Scene::from_gaussians(&street(40_000, 1, 12));
    let profile = RenderProfile::default();
    let mut views = turning_views();
    let lens = lenses().into_iter().find(|(name, _)| *name == "fisheye").unwrap().1;
    let lens = Camera { native_size_px: None, ..lens.scaled(80, 50).unwrap() };
    let pose = views[0].world_from_camera;
    views.push(rolling_view(lens, pose, ShutterDirection::TopToBottom));
    let differ = |backend: &Cpu, gradients: &mut Gradients| {
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        backend.differentiate(&frame, true, &mut |images| waves(images), gradients).unwrap();
        let bits = |(_, values): (_, Vec<f64>)| values.into_iter().map(f64::to_bits);
        by_group(gradients).into_iter().flat_map(bits).collect::<Vec<u64>>()
    };
    let one = differ(&Cpu::new(1, Simd::Best).unwrap(), &mut Gradients::default());
    for threads in [1, 2, 4, 7] {
        let backend = Cpu::new(threads, Simd::Best).unwrap();
        let mut gradients = Gradients::default();
        for repeat in 0..26 {
            assert!(differ(&backend, &mut gradients) == one, "{threads} threads, {repeat}");
        }
    }
    // AVX2 has the operations of AVX-512, eight lanes at a time.
    if let Ok(avx2) = Cpu::new(2, Simd::Avx2) {
        assert!(differ(&avx2, &mut Gradients::default()) == one, "AVX2");
    }
}

/// What a frame's gradients take beside the frame: bytes of each splat and pixel, and the gradients
/// themselves.
#[test]
fn gradients_take_120_bytes_a_splat() {
    let output = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "gradients::bytes_of_gradients", "--ignored", "--nocapture"])
        .env("MALLOC_ARENA_MAX", "1")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
#[ignore = "runs in its own process, started by gradients_take_120_bytes_a_splat"]
fn bytes_of_gradients() {
    let status_bytes = |field: &str| {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find(|line| line.starts_with(field)).unwrap();
        1024 * line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    };
    let scene = Scene::from_gaussians(&street(1_000_000, 0, 12));
    let profile = RenderProfile::default();
    let view = turning_views()[0];
    let views = [View { camera: view.camera.scaled(720, 464).unwrap(), ..view }];
    let backend = Cpu::new(4, Simd::Best).unwrap();
    // The buffers of a frame, which stay.
    let images = render_images(&backend, &scene, &profile, &views).unwrap();
    drop(images);
    // The peak until now is that of making the scene; this begins another.
    std::fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = status_bytes("VmHWM:");
    let mut gradients = Gradients::default();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    let mut loss = |images: &[GaussianImages]| images.to_vec();
    let stats = backend.differentiate(&frame, false, &mut loss, &mut gradients).unwrap();
    let taken = status_bytes("VmHWM:") - before;
    // 16 B a pixel of images, 16 B of derivatives, and 24 B of what a tile keeps; 14 columns of f32
    // for each Gaussian, visible or not.
    let pixels = views[0].camera.pixels() as u64;
    let others = 56 * pixels + 56 * scene.gaussians() as u64;
    let each = (taken as f64 - others as f64) / stats.visible_pairs as f64;
    eprintln!("{taken} B, {} splats: {each:.0} B each", stats.visible_pairs);
    assert!(stats.visible_pairs > 300_000, "{}", stats.visible_pairs);
    assert!(each > 20.0, "{each} B a splat cannot be all");
    assert!(each <= 120.0, "{each} B a splat");
}

/// A loss of the images with given decisions: the sum of products with fixed numbers.
fn loss(sources: &Sources<'_>, decisions: &Decisions, by: &Images) -> f64 {
    let images = sources.images(decisions);
    let rgb = zip(&images.rgb, &by.rgb).map(|(a, b)| a.dot(*b)).sum::<f64>();
    let sum = |a: &[f64], b: &[f64]| zip(a, b).map(|(a, b)| a * b).sum::<f64>();
    rgb + sum(&images.opacity, &by.opacity) + sum(&images.depth_sum_m, &by.depth_sum_m)
}

/// The derivative of a function at 0 by central differences of fourth order.
fn difference(f: impl Fn(f64) -> f64) -> f64 {
    let h = 1e-4;
    (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
}

/// A parameter of a Gaussian, moved by `step`.
fn moved(gaussian: &Gaussian, parameter: usize, step: f64) -> Gaussian {
    let mut gaussian = *gaussian;
    let q = &mut gaussian.rotation;
    match parameter {
        0..3 => gaussian.mean_m[parameter] += step,
        3 => q.w += step,
        4 => q.x += step,
        5 => q.y += step,
        6 => q.z += step,
        7..10 => gaussian.scale_m[parameter - 7] *= step.exp(),
        10 => gaussian.log2_opacity += step,
        _ => gaussian.sh[(parameter - 11) / 3][(parameter - 11) % 3] += step,
    }
    gaussian
}

/// The derivative by that parameter.
fn derivative(gaussian: &Gaussian, gradient: &SourceGradient, parameter: usize) -> f64 {
    let geometry = &gradient.geometry;
    match parameter {
        0..3 => geometry.mean_m[parameter],
        3..7 => geometry.quat_wxyz[parameter - 3] / gaussian.rotation.length(),
        7..10 => geometry.ln_scale[parameter - 7],
        10 => geometry.log2_opacity,
        _ => gradient.sh[(parameter - 11) / 3][(parameter - 11) % 3],
    }
}

/// An actor that has turned and moves during the exposure. Its Gaussians are those of the test.
fn turned_actor() -> PlacedChunk {
    let pose = Pose {
        position_m: DVec3::new(4.0, -2.0, 1.5),
        rotation: DQuat::from_rotation_z(0.7) * DQuat::from_rotation_x(0.2),
    };
    let before = Pose { position_m: pose.position_m - DVec3::new(0.05, 0.02, 0.0), ..pose };
    let chunk = Arc::new(Chunk::new([0, 0], DVec3::ZERO, 0, 0));
    PlacedChunk { world_from_actor_at_start: before, ..PlacedChunk::at_rest(chunk, pose, 0) }
}

/// A scene of 24 Gaussians in front of a camera; every third lies at an extreme: long and thin, at
/// the cap, of a quaternion of another length, close to the camera, just beyond the near plane. The
/// last eight are those of an actor that has turned and, under a rolling shutter, moves.
fn random_sources<'a>(random: &mut Random, view: View, profile: &'a RenderProfile) -> Sources<'a> {
    let views = vec![view, view.seen_from(&turned_actor())];
    let source = |i: usize| {
        let mut number = |low: f64, high: f64| f64::from(random.between(low, high));
        let depth_m = match i {
            5 => number(0.3, 0.6),
            // The near plane is at 0.01 m. A camera that moves by 0.3 m would pass it.
            6 if view.rolling_shutter.is_none() => number(0.0105, 0.011),
            _ => number(2.0, 9.0),
        };
        let in_camera_m = depth_m * DVec3::new(number(-0.8, 0.8), number(-0.6, 0.6), 1.0);
        let long = if i.is_multiple_of(3) { 20.0 } else { 1.0 };
        let scale = DVec3::new(long * number(0.02, 0.05), number(0.03, 0.3), number(0.005, 0.3));
        let length = [1.0, 1e-3, 1e3][i % 3];
        let rotation = DQuat::from_xyzw(
            number(-1.0, 1.0),
            number(-1.0, 1.0),
            number(-1.0, 1.0),
            number(0.1, 1.0),
        );
        let of_view = usize::from(i >= 16);
        let gaussian = Gaussian {
            mean_m: views[of_view].world_from_camera.transform_point(in_camera_m),
            rotation: rotation * length,
            scale_m: scale * depth_m / 4.0,
            log2_opacity: if i % 5 == 1 { -1e-4 } else { number(-3.0, -0.05) },
            sh: std::array::from_fn(|_| {
                0.5 * DVec3::new(number(-0.5, 0.7), number(-0.5, 0.7), number(-0.5, 0.7))
            }),
        };
        Source { gaussian, view: of_view, tint: DVec3::new(1.0, 0.8, 1.1) }
    };
    let gaussians = (0..24).map(source).collect();
    Sources { profile, gaussians, views: views.clone(), depth_is_z: false }
}

/// Fifty random scenes, by every kind of camera: every derivative of the reference is that of its
/// own images with the same decisions.
#[test]
fn reference_has_the_derivatives_of_its_own_images() {
    let mut random = Random(77);
    let pinhole = Camera::from_pinhole(28, 20, Pinhole { fx: 20.0, fy: 21.0, cx: 13.0, cy: 11.0 });
    let mut cameras = vec![("pinhole", pinhole)];
    for (name, camera) in lenses() {
        let camera = camera.scaled(28, 20).unwrap();
        cameras.push((name, Camera { native_size_px: None, ..camera }));
        // A half of its native size.
        cameras.push(("shrunk", camera.scaled(14, 10).unwrap()));
    }
    let profiles =
        [false, true].map(|antialiased| RenderProfile { antialiased, ..RenderProfile::default() });
    let mut worst: f64 = 0.0;
    for scene in 0..50 {
        let (name, camera) = cameras[scene % cameras.len()];
        let pose = Twist::from_array([3.0, -1.0, 2.0, 0.3, 0.1 * scene as f64, -0.2]).exp();
        let mut view = View::new(camera, pose);
        let rolls = scene % 3 == 1;
        let turns = scene % 6 == 1;
        if rolls {
            let moves_m = pose.rotation * DVec3::new(0.1, 0.02, 0.3);
            let turn = DQuat::from_rotation_y(if turns { -0.08 } else { 0.0 });
            view.rolling_shutter = Some(RollingShutter {
                direction: ShutterDirection::TopToBottom,
                world_from_camera_first: Pose {
                    position_m: pose.position_m - moves_m,
                    rotation: pose.rotation * turn,
                },
            });
        }
        let sources = random_sources(&mut random, view, &profiles[scene / 2 % 2]);
        let decisions = sources.decisions();
        let pixels = camera.pixels();
        let mut number = || random.unit() - 0.5;
        let by = Images {
            rgb: (0..pixels).map(|_| DVec3::new(number(), number(), number())).collect(),
            opacity: (0..pixels).map(|_| number()).collect(),
            depth_sum_m: (0..pixels).map(|_| 0.2 * number()).collect(),
        };
        let (gradients, twist) = sources.gradients(&sources.splat_gradients(&decisions, &by));
        let mut check = |what: String, ours: f64, theirs: f64, scale: f64| {
            let error = (ours - theirs).abs() / scale;
            worst = worst.max(error);
            assert!(error < 2e-6, "scene {scene}, {name}, rolls {rolls}, {what}: {ours} {theirs}");
        };
        for parameter in 0..59 {
            // Quaternions have lengths of three sizes, and one Gaussian lies at the near plane: steps
            // are in proportion to these.
            let unit = |i: usize| match parameter {
                3..7 => sources.gaussians[i].gaussian.rotation.length(),
                0..3 if i == 6 => 0.005,
                _ => 1.0,
            };
            let values: Vec<f64> = (0..24)
                .map(|i| {
                    unit(i) * derivative(&sources.gaussians[i].gaussian, &gradients[i], parameter)
                })
                .collect();
            let most = values.iter().fold(1e-3_f64, |most, value| most.max(value.abs()));
            // Two Gaussians for each parameter, others in every scene.
            for index in [(7 * parameter + scene) % 24, (5 * parameter + 3 * scene + 1) % 24] {
                let gaussian = &sources.gaussians[index].gaussian;
                let theirs = difference(|step| {
                    let mut sources = sources.clone();
                    sources.gaussians[index].gaussian =
                        moved(gaussian, parameter, unit(index) * step);
                    loss(&sources, &decisions, &by)
                });
                check(format!("parameter {parameter} of {index}"), values[index], theirs, most);
            }
        }
        // Of a camera that turns, both ends are twisted, and not every moment.
        if turns {
            continue;
        }
        let twist = twist.to_array();
        let most = twist.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
        // Small against the depth of the nearest one.
        let unit = |axis: usize| if axis < 3 { 0.005 } else { 1.0 };
        for axis in 0..6 {
            let theirs = difference(|step| {
                let mut values = [0.0; 6];
                values[axis] = unit(axis) * step;
                let mut sources = sources.clone();
                for view in &mut sources.views {
                    *view = view.twisted(Twist::from_array(values));
                }
                loss(&sources, &decisions, &by)
            });
            let ours = unit(axis) * twist[axis];
            check(format!("twist {axis}"), ours, theirs, unit(axis) * most);
        }
    }
    eprintln!("largest error of 50 scenes: {worst:.1e}");
}
