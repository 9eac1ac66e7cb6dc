//! The time of a LiDAR sweep of 128 x 2,048 beams on the demo street, and that of six cameras with
//! as many pixels together, in turn:
//! `cargo run --release -p wildcity-render --example lidar_cost [ROUNDS [cpu|gpu]]`.

use std::f64::consts::TAU;
use std::sync::Arc;
use std::time::Instant;

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_options::{LidarBeams, LidarColumns};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::lidar::LidarView;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::{RenderProfile, Rig, Scene, Shrink};

#[allow(clippy::print_stdout, reason = "the output of the example")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let rounds: usize = std::env::args().nth(1).map_or(Ok(10), |count| count.parse())?;
    let settings = StreetSettings { seed: 7, length_m: 350.0, crossing_m: 180.0, density: 1.0 };
    let street = wildcity_generate::street(&settings)?;
    let scene = Scene::from_gaussians(&street.gaussians);
    // A pixel has one sample, as a beam is one ray: small images have four otherwise.
    let profile = RenderProfile { shrink: Shrink::Filter, ..RenderProfile::default() };
    let frames = &street.trajectory.keyframes;
    let at = frames[frames.len() / 2].world_from_rig;
    let backend: Box<dyn Backend> = match std::env::args().nth(2).as_deref() {
        None | Some("cpu") => Box::new(Cpu::new(0, Simd::Best)?),
        Some("gpu") => Box::new(Gpu::new(&AdapterChoice::Best, 0)?),
        Some(other) => return Err(format!("there is no backend {other:?}: cpu or gpu").into()),
    };

    let row = |row: u32| (10.0 - 40.0 * f64::from(row) / 127.0).to_radians();
    let lidar = Lidar::from_options(&LidarBeams {
        row_elevations_rad: (0..128).map(row).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(LidarColumns {
            count: 2048,
            first_rad: 0.0,
            last_rad: -TAU * 2047.0 / 2048.0,
        }),
        duration_us: 100_000,
        min_range_m: None,
        max_range_m: None,
    })?;
    let top = Pose { position_m: at.position_m + DVec3::Z * 1.9, ..at };
    // At 30 m/s, a beam starts up to 3 m behind the last one.
    let first = Pose { position_m: top.position_m - top.rotation * DVec3::X * 3.0, ..top };
    let lidar =
        LidarView { lidar: Arc::new(lidar), world_from_lidar: top, world_from_lidar_first: first };
    // 6 x 264 x 165 pixels are 261,360; the sweep has 262,144 beams.
    let cameras = Rig::preset("vehicle6").ok_or("no vehicle6")?.cameras;
    let cameras: Result<Vec<_>, _> = cameras.iter().map(|camera| camera.scaled(264, 165)).collect();
    let views = View::from_rig(&cameras?, at);
    let mut images: Vec<Vec<u8>> =
        views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();

    let mut sweeps_ms = Vec::new();
    let mut frames_ms = Vec::new();
    for _ in 0..rounds {
        let begun = Instant::now();
        let sweep = backend.sweep(&scene, &profile, &lidar)?;
        sweeps_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        let returns = sweep.range_m.iter().filter(|range_m| **range_m > 0.0).count();
        let mut targets: Vec<Target<'_>> = images
            .iter_mut()
            .map(|rgb8| Target { rgb8: Some(rgb8), ..Target::default() })
            .collect();
        let begun = Instant::now();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        backend.render(&frame, &mut targets, &|_, _| {})?;
        frames_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        println!(
            "sweep {:.1} ms ({returns} returns), cameras {:.1} ms",
            sweeps_ms[sweeps_ms.len() - 1],
            frames_ms[frames_ms.len() - 1]
        );
    }
    let median = |times: &mut Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let sweep = median(&mut sweeps_ms);
    let frame = median(&mut frames_ms);
    println!("medians: sweep {sweep:.1} ms, cameras {frame:.1} ms, ratio {:.2}", sweep / frame);
    Ok(())
}
