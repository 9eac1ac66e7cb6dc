//! The same input yields the same bytes.

use std::io::Write;

use wildcity_render::gpu::devices;
use wildcity_scene::{RenderProfile, Scene};

use crate::gpu::gpu;
use crate::images::{render, render_one};
use crate::parity::streets_of_every_sh_degree;
use crate::scene_files::gaussians;
use crate::streets::{street, turning_views as views};

#[test]
fn thirty_repeats_are_bit_identical() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 11));
    let backend = gpu();
    let profile = RenderProfile::default();
    let first = render(&backend, &scene, &profile, &views());
    for repeat in 1..30 {
        assert!(render(&backend, &scene, &profile, &views()) == first, "repeat {repeat}");
    }
}

#[test]
fn a_frame_that_outgrows_its_buffers_is_the_same_frame() {
    // 300,000 splats do not fit the initial buffers.
    let scene = Scene::from_gaussians(&street(300_000, 1, 12));
    let profile = RenderProfile::default();
    let backend = gpu();
    let grown = render(&backend, &scene, &profile, &views());
    let retries = backend.usage().unwrap().retries;
    assert!(retries >= 3, "splats, touches and instances did not all grow: {retries} retries");
    let fitting = render(&backend, &scene, &profile, &views());
    assert_eq!(backend.usage().unwrap().retries, retries, "the second frame grew too");
    assert!(grown == fitting);
}

#[test]
fn a_view_does_not_depend_on_the_other_views() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 13));
    let backend = gpu();
    let profile = RenderProfile::default();
    let together = render(&backend, &scene, &profile, &views());
    for (view, image) in views().into_iter().zip(&together) {
        assert!(render_one(&backend, &scene, &profile, view) == *image);
    }
}

#[test]
fn a_frame_does_not_depend_on_the_previous_one() {
    let street = Scene::from_gaussians(&street(20_000, 1, 14));
    let cloud = Scene::from_gaussians(&gaussians(5_000, 3, 4.0, 15));
    let backend = gpu();
    let profile = RenderProfile::default();
    let fresh = render(&gpu(), &street, &profile, &views());
    render(&backend, &cloud, &profile, &views()[..2]);
    assert!(render(&backend, &street, &profile, &views()) == fresh);
}

/// Lavapipe takes the size of its subgroups from an environment variable: 4, 8, and 16 threads. On
/// other devices the variable has no effect. Each size runs in its own process, since a driver
/// reads the variable once; the process prints the size that it found.
#[test]
fn subgroups_of_any_size() {
    let is_lavapipe = devices()[0].name.contains("llvmpipe");
    for (width, threads) in [("128", 4), ("256", 8), ("512", 16)] {
        let output = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "determinism::one_size_of_subgroups", "--ignored", "--nocapture"])
            .env("LP_NATIVE_VECTOR_WIDTH", width)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && said.contains("1 passed"), "{width}: {said}");
        let sizes = format!("subgroups of {threads} to {threads} threads");
        assert!(!is_lavapipe || said.contains(&sizes), "{width}: {said}");
    }
}

#[test]
#[ignore = "runs in its own process, started by subgroups_of_any_size"]
fn one_size_of_subgroups() {
    streets_of_every_sh_degree();
    let threads = devices()[0].subgroup_threads.clone();
    let line = format!("\nsubgroups of {} to {} threads\n", threads.start(), threads.end());
    std::io::stdout().write_all(line.as_bytes()).unwrap();
}
