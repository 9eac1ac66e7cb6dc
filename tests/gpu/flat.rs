//! Memory over ten thousand steps.

use std::fs;

use glam::DVec3;
use wildcity::render::{Backend, Frame, Target, View};
use wildcity::scene::{RenderProfile, Scene};

use crate::gpu::gpu;
use crate::images::look;
use crate::streets::street;

/// What one step may leave behind is 4 MiB / 10,000 = 419 B; a bind group or a buffer is more.
const GROWTH_BYTES: u64 = 4 << 20;

#[test]
fn memory_is_flat_over_ten_thousand_steps() {
    let output = std::process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "flat::ten_thousand_steps", "--ignored"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
#[ignore = "a process of its own, started by memory_is_flat_over_ten_thousand_steps"]
fn ten_thousand_steps() {
    let (gpu, profile) = (gpu(), RenderProfile::default());
    let scene = Scene::from_gaussians(&street(300, 1, 61));
    let step = |step: u32| {
        let view = |yaw: f64| -> View {
            let at = DVec3::new(0.0, 0.0, 20.0 + 0.01 * f64::from(step % 1_000));
            let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
            look([24 + 8 * (step % 3), 16], 20.0, at, forward, DVec3::Y)
        };
        let views = [view(0.0), view(2.0)];
        let mut images = views.map(|view| vec![0; 3 * view.camera.pixels()]);
        let mut targets =
            images.each_mut().map(|image| Target { rgb8: Some(image), ..Target::default() });
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        gpu.render(&frame, &mut targets, &|_, _| {}).unwrap();
    };
    let memory = || (status_bytes("VmRSS"), gpu.usage().unwrap().allocated_bytes);
    (0..1_000).for_each(step);
    let (before, device_before) = memory();
    (0..10_000).for_each(step);
    let (after, device_after) = memory();
    assert!(after <= before + GROWTH_BYTES, "{before} B grew to {after} B");
    assert!(device_before.is_some_and(|bytes| bytes > 0), "the device does not count its memory");
    assert_eq!(device_before, device_after);
}

/// A size of /proc/self/status.
fn status_bytes(field: &str) -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with(field)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}
