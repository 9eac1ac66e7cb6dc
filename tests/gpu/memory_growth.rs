//! Memory does not grow over thousands of steps.

use std::fs;
use std::ops::Range;

use glam::DVec3;
use wildcity_render::gpu::Gpu;
use wildcity_render::{Backend, Frame, OnViewDone, RenderError, Target, View};
use wildcity_scene::{RenderProfile, Scene};

use crate::gaussians::{self, GaussianSpec};
use crate::gpu::{bindings, gpu, gpu_with_limits};
use crate::images::view_along;
use crate::streets::street;

/// Steps between two measurements of the memory.
const STEPS: u32 = 1_000;
/// A step may leak at most 419 B; a bind group or a buffer is larger.
const GROWTH_BYTES: u64 = 419 * STEPS as u64;
/// With several threads the allocator's own memory moves by more: in five rounds of three threads,
/// a step may leak at most 1,412 B.
const GROWTH_OF_THREADS_BYTES: u64 = 1_412 * 5 * 3 * ROUND as u64;

#[test]
fn memory_is_flat_over_a_thousand_steps() {
    in_its_own_process("memory_growth::a_thousand_steps");
}

#[test]
fn memory_is_flat_over_changing_scenes_and_frames_that_fail() {
    in_its_own_process("memory_growth::three_at_once");
}

fn in_its_own_process(test: &str) {
    let output = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", test, "--ignored"])
        // Without this, glibc gives each thread its own arena, which grows with memory that other
        // threads free.
        .env("MALLOC_ARENA_MAX", "1")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
#[ignore = "runs in its own process, started by memory_is_flat_over_a_thousand_steps"]
fn a_thousand_steps() {
    let gpu = gpu();
    let scene = Scene::from_gaussians(&street(300, 1, 61));
    let steps = |steps: Range<u32>| {
        steps.for_each(|step| draw(&gpu, &scene, step).unwrap());
        memory(&gpu)
    };
    let (mut before, device_before) = steps(0..300);
    // A heap may settle once on a busy machine. A leak goes on: it grows in the second thousand,
    // too.
    for last in [false, true] {
        let (after, device_after) = steps(0..STEPS);
        assert_eq!(device_before, device_after);
        let is_flat = after <= before + GROWTH_BYTES;
        assert!(
            is_flat || !last,
            "{before} B grew to {after} B, and so did a thousand steps before"
        );
        if is_flat {
            break;
        }
        before = after;
    }
}

/// A thread for each frame in flight, with small bindings: pages of four clusters. Scenes change,
/// so that pages are freed and allocated again, and some frames exceed the device.
#[test]
#[ignore = "runs in its own process, started by memory_is_flat_over_changing_scenes_and_frames_that_fail"]
fn three_at_once() {
    let gpu = gpu_with_limits(bindings(64 << 10));
    let layer = |i| GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, 40.0 + 1e-3 * f64::from(i)),
        sigma_m: DVec3::splat(20.0),
        ..GaussianSpec::default()
    };
    // One row of tiles may have 2,048 splats.
    let too_many = gaussians::scene_from_specs(&(0..3_000).map(layer).collect::<Vec<_>>());
    let streets = [300, 900].map(|n| street(n, 1, 62));
    let step = |step: u32| {
        let scene = Scene::from_gaussians(&streets[step as usize % 2]);
        draw(&gpu, &scene, step).unwrap();
        if step.is_multiple_of(22) {
            let refused = draw(&gpu, &too_many, step).unwrap_err();
            assert!(matches!(refused, RenderError::TooMany { .. }), "{refused}");
        }
    };
    let round = || {
        std::thread::scope(|scope| {
            for _ in 0..gpu.frames_in_flight() {
                scope.spawn(|| (0..ROUND).for_each(step));
            }
        });
        // Now only this scene is resident, whichever scenes were drawn last.
        draw(&gpu, &Scene::from_gaussians(&streets[0]), 0).unwrap();
        memory(&gpu)
    };
    // Each read-back buffer has held the largest frame, whatever the order of the threads.
    draw_within(&gpu, &Scene::from_gaussians(&streets[1]), gpu.frames_in_flight());
    let rounds = [(); 6].map(|()| round());
    let [(before, _), .., (after, _)] = rounds;
    assert!(after <= before + GROWTH_OF_THREADS_BYTES, "{before} B grew to {after} B");
    // The order of the threads decides which scenes share a page, so that a later round may need a
    // few kB more or less. A leak would grow in every round.
    let device = rounds.map(|(_, device_bytes)| device_bytes);
    assert!(
        device.windows(2).any(|two| two[1] <= two[0]),
        "bytes of the device by round: {device:?}"
    );
}

/// Draws the largest frame, and a second one from its callback, until `frames` of them are in
/// flight.
fn draw_within(gpu: &Gpu, scene: &Scene, frames: usize) {
    if frames > 0 {
        let one_more = |view: usize, _: &Target<'_>| {
            if view == 0 {
                draw_within(gpu, scene, frames - 1);
            }
        };
        draw_and(gpu, scene, 2, &one_more).unwrap();
    }
}

/// Number of steps after which scenes (2), sizes (3), and camera positions repeat.
const ROUND: u32 = 66;

/// Draws two small views whose size and position depend on the step.
fn draw(gpu: &Gpu, scene: &Scene, step: u32) -> Result<(), RenderError> {
    draw_and(gpu, scene, step, &|_, _| {})
}

fn draw_and(
    gpu: &Gpu,
    scene: &Scene,
    step: u32,
    finished: OnViewDone<'_>,
) -> Result<(), RenderError> {
    let view = |yaw: f64| -> View {
        let at = DVec3::new(0.0, 0.0, 20.0 + 0.15 * f64::from(step % ROUND));
        let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
        view_along([24 + 8 * (step % 3), 16], 20.0, at, forward, DVec3::Y)
    };
    let views = [view(0.0), view(2.0)];
    let profile = RenderProfile::default();
    let mut images = views.map(|view| vec![0; 3 * view.camera.pixels()]);
    let mut targets =
        images.each_mut().map(|image| Target { rgb8: Some(image), ..Target::default() });
    let frame = Frame { scene, profile: &profile, views: &views };
    gpu.render(&frame, &mut targets, finished).map(drop)
}

/// Bytes of memory of this process, and of the device.
fn memory(gpu: &Gpu) -> (u64, u64) {
    let device = gpu.usage().unwrap().allocated_bytes.expect("the device counts its memory");
    assert!(device > 0);
    (status_bytes("VmRSS"), device)
}

/// A size in /proc/self/status, in bytes.
fn status_bytes(field: &str) -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with(field)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}
