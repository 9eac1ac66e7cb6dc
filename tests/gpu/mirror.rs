//! The Gaussians in the device's memory: bytes per Gaussian, eviction, and limits.

use std::sync::Arc;

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::gpu::MemoryLimits;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::chunk::{CellRun, Partition};
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene, lod};

use crate::gpu::{bindings, gpu, gpu_with_limits};
use crate::images::{render, view_along};
use crate::streets::{street, turning_views};

/// Largest number of bytes per resident Gaussian of SH degree 1.
const BYTES: f64 = 64.0;

/// The demo street in blocks of 16 m as in a twin, for each focal length. Each block is at the
/// coarsest level of detail whose error is at most one pixel in a camera with this focal length at
/// the start of the street.
fn demo(focals_px: [f32; 3]) -> [Scene; 3] {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let (gaussians, eye_m) = (street.gaussians, street.trajectory.at_station(0.0).position_m);
    let Partition { cells, order } = Partition::new(&gaussians.means_m);
    let block = |cell: &CellRun, indices: &[u32]| -> [Arc<Chunk>; 3] {
        let mut full = Chunk::new(cell.cell, cell.origin_m, gaussians.sh_degree, indices.len());
        for &index in indices {
            full.push(&cell.record(&gaussians, index as usize));
        }
        let eye_m = (eye_m - cell.origin_m).as_vec3();
        let distance_m = full
            .clusters()
            .iter()
            .map(|cluster| eye_m.distance(eye_m.clamp(cluster.min_m, cluster.max_m)));
        let distance_m = distance_m.fold(f32::INFINITY, f32::min);
        let levels: Vec<lod::Level> = lod::levels(&full).collect();
        let full = Arc::new(full);
        focals_px.map(|focal_px| {
            let mut from_coarsest = levels.iter().rev();
            let coarsest = from_coarsest.find(|level| focal_px * level.error_m <= distance_m);
            coarsest.map_or(Arc::clone(&full), |level| Arc::new(level.chunk.clone()))
        })
    };
    let mut scenes = [(); 3].map(|()| Scene::default());
    for cell in &cells {
        for (_, run) in &cell.blocks {
            let chunks = block(cell, &order[run.clone()]);
            scenes.iter_mut().zip(chunks).for_each(|(scene, chunk)| scene.chunks.push(chunk));
        }
    }
    scenes
}

fn bytes_per_gaussian(scene: &Scene) -> f64 {
    let backend = gpu();
    // A view into the sky: all chunks of a scene become resident in any view, and none has to be
    // projected.
    let view = view_along([64, 64], 50.0, DVec3::new(0.0, 0.0, 500.0), DVec3::Z, DVec3::X);
    render(&backend, scene, &RenderProfile::default(), &[view]);
    backend.usage().unwrap().mirror_bytes as f64 / scene.gaussians() as f64
}

#[test]
fn a_gaussian_of_a_twin_takes_at_most_64_bytes() {
    // At full detail, for a camera of 1440 pixels, and for one of a fifth of that.
    let [full, sharp, small] = demo([f32::INFINITY, 1_200.0, 240.0]);
    let counts = [&full, &sharp, &small].map(Scene::gaussians);
    assert!(counts[1] < counts[0] && counts[2] < counts[0] / 2, "{counts:?}");
    for scene in [full, sharp, small] {
        let bytes = bytes_per_gaussian(&scene);
        assert!(bytes > 0.5 * BYTES, "{bytes} B for each: not all are resident");
        assert!(bytes <= BYTES, "{bytes} B for each of {}", scene.gaussians());
    }
}

#[test]
fn memory_is_proportional_to_the_resident_gaussians() {
    let (backend, profile) = (gpu(), RenderProfile::default());
    let bytes = || backend.usage().unwrap().mirror_bytes;
    let street_of = |seed| Scene::from_gaussians(&street(40_000, 1, seed));
    render(&backend, &street_of(16), &profile, &turning_views()[..1]);
    let one = bytes();
    assert!(one <= 61 * 40_000, "{one} B for 40,000 Gaussians");
    for seed in 17..27 {
        let scene = street_of(seed);
        render(&backend, &scene, &profile, &turning_views()[..1]);
        assert!(bytes() <= 3 * one, "{} B after scene {seed}", bytes());
    }
}

/// Cells along a route, of which a few are drawn at a time.
fn route() -> Vec<Scene> {
    let mut cells: Vec<Gaussians> =
        (0..8).map(|seed| street(5_000 + 700 * seed as usize, 1, seed)).collect();
    for (k, cell) in cells.iter_mut().enumerate() {
        cell.means_m.iter_mut().for_each(|mean_m| mean_m[0] += 64.0 * k as f64);
    }
    cells.iter().map(Scene::from_gaussians).collect()
}

/// A drive back and forth with jumps, under several limits: memory never exceeds the limit, and the
/// images equal those without a limit.
#[test]
fn the_least_recently_drawn_chunks_are_evicted() {
    let (cells, profile) = (route(), RenderProfile::default());
    let window = |at: usize| {
        let chunks = cells[at..at + 3].iter().flat_map(|cell| cell.chunks.iter().cloned());
        Scene { chunks: chunks.collect(), ..Scene::default() }
    };
    let view = |at: usize| {
        let eye_m = DVec3::new(64.0 * (at + 1) as f64, 0.0, 0.0);
        view_along([96, 64], 60.0, eye_m, DVec3::new(1.0, 0.1, 0.2), DVec3::Y)
    };
    let free = gpu();
    let expected = [0, 1, 2, 3, 4, 5].map(|at| render(&free, &window(at), &profile, &[view(at)]));
    // Also with small bindings, so that a scene lies on many pages.
    for bound in [MemoryLimits::default(), bindings(256 << 10)] {
        // Copies, so that no chunk remains on the device when the next window is drawn.
        let backend = gpu_with_limits(bound);
        let alone = (0..6).map(|at| {
            let mut copy = window(at);
            copy.chunks.iter_mut().for_each(|chunk| *chunk = Arc::new((**chunk).clone()));
            render(&backend, &copy, &profile, &[view(at)]);
            backend.usage().unwrap().mirror_bytes
        });
        let largest = alone.max().unwrap();
        for mirror_bytes in [largest, largest + largest / 10, 2 * largest] {
            let limited = gpu_with_limits(MemoryLimits { mirror_bytes, ..bound });
            for at in [0, 1, 2, 3, 4, 5, 4, 3, 0, 5, 1, 3, 0, 2, 5] {
                let drawn = render(&limited, &window(at), &profile, &[view(at)]);
                assert!(drawn == expected[at], "at {at} within {mirror_bytes} B, {bound:?}");
                let held = limited.usage().unwrap().mirror_bytes;
                assert!(held <= mirror_bytes, "{held} B at {at} of {mirror_bytes}, {bound:?}");
            }
        }
    }
}

#[test]
fn a_scene_beyond_the_limit_is_refused_and_the_next_is_drawn() {
    let profile = RenderProfile::default();
    // Each cell fits by itself, but not all of them together.
    let cells = route();
    let all = cells.iter().flat_map(|cell| cell.chunks.iter().cloned());
    let (small, large) = (&cells[0], &Scene { chunks: all.collect(), ..Scene::default() });
    let limited =
        gpu_with_limits(MemoryLimits { mirror_bytes: 1_000_000, ..MemoryLimits::default() });
    let expected = render(&gpu(), small, &profile, &turning_views());
    for _ in 0..2 {
        assert!(render(&limited, small, &profile, &turning_views()) == expected);
        let refused = refusal(&limited, large, &turning_views());
        let RenderError::DeviceMemory { needed_bytes, limit_bytes: 1_000_000 } = refused else {
            panic!("{refused}")
        };
        let each = needed_bytes as f64 / large.gaussians() as f64;
        assert!((60.0..62.0).contains(&each), "{needed_bytes}");
    }
}

fn refusal(backend: &dyn Backend, scene: &Scene, views: &[View]) -> RenderError {
    let profile = RenderProfile::default();
    let mut images: Vec<Vec<u8>> =
        views.iter().map(|view| vec![7; 3 * view.camera.pixels()]).collect();
    let mut targets: Vec<Target<'_>> = (images.iter_mut())
        .map(|image| Target { rgb8: Some(image), ..Target::default() })
        .collect();
    let frame = Frame { scene, profile: &profile, views };
    let refused = backend.render(&frame, &mut targets, &|_, _| {}).unwrap_err();
    assert!(images.iter().flatten().all(|&byte| byte == 7), "something was written");
    refused
}
