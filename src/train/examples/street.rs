//! Retrains the demo street from its own images, and writes the same images and points for another
//! program to train on.
//!
//! ```text
//! cargo run --release -p wildcity-train --example street -- STEPS [SCALE] [CAP] [EXPORT]
//! ```
//!
//! There are 34 keyframes of six cameras, 3 m apart; every eighth keyframe is held out. The sky of
//! the images is learned as a shell of Gaussians, 400 m away.

#![allow(clippy::print_stdout, reason = "its result")]

mod demo_street;

use std::error::Error;
use std::f64::consts::PI;
use std::fs::File;
use std::io::{BufWriter, Write};

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};
use wildcity_train::run::{Line, run};
use wildcity_train::settings::{Growth, PoseMode, Settings, SkyMode};
use wildcity_train::start::{Point, gaussians_from_points};
use wildcity_train::trainer::{Start, Trainer};

use demo_street::{Recorded, Recording, points};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let steps: usize = arguments.first().map_or("1500", String::as_str).parse()?;
    let scale: f64 = arguments.get(1).map_or("0.25", String::as_str).parse()?;
    let cap: usize = arguments.get(2).map_or("150000", String::as_str).parse()?;
    let cpu = Cpu::new(0, Simd::Best)?;
    let street = wildcity_generate::street(&StreetSettings::default())?;
    let truth = Scene::from_gaussians(&street.gaussians);
    let recording = Recording::new(&cpu, &truth, &street.trajectory, scale)?;
    let start = start(&street.gaussians, &recording);
    if let Some(path) = arguments.get(3) {
        export(path, &recording.images, &start)?;
    }

    let growth = Growth { cap, from: 500, until: 24_000, ..Growth::default() };
    let mut settings = Settings { steps, growth, ..Settings::default() };
    settings.poses.mode = PoseMode::Off;
    settings.sky.mode = SkyMode::Off;
    println!("{} images, {} points", recording.images.len(), start.len());
    let mut stages: Vec<(&str, f64)> = Vec::new();
    let mut on_step = |line: &Line, _: &Trainer| {
        for (stage, ms) in &line.stages_ms {
            match stages.iter_mut().find(|(name, _)| name == stage) {
                Some((_, sum)) => *sum += ms,
                None => stages.push((stage, *ms)),
            }
        }
        if let Line { step, l1, gaussians, seconds, held_out_db: Some(db), .. } = line {
            println!(
                "step {step:5}  {db:.2} dB held out  l1 {l1:.4}  {gaussians} Gaussians  {seconds:.1} s"
            );
        }
        true
    };
    let start = Start { gaussians: start, ..Start::default() };
    let mut trainer = Trainer::new(start, RenderProfile::default(), settings)?;
    run(&mut trainer, &recording, &cpu, 250, &mut on_step)?;
    // On one core (`taskset -c 0`) these are times of the processor.
    for (stage, ms) in stages {
        println!("{stage:18} {:.2} ms a step", ms / steps as f64);
    }
    Ok(())
}

/// Points of the street, and the shell of the sky.
fn start(truth: &Gaussians, recording: &Recording) -> Gaussians {
    let mut points = points(truth, recording);
    let poses = recording.images.iter().map(|image| image.view.world_from_camera.position_m);
    let middle = poses.sum::<DVec3>() / recording.images.len() as f64;
    let count = 6_000.0;
    for k in 0..6_000 {
        let z = 1.0 - (f64::from(k) + 0.5) / count;
        // Turns by the golden ratio at even heights cover the sphere evenly.
        let angle = PI * (1.0 + 5.0_f64.sqrt()) * (f64::from(k) + 0.5);
        let across = (1.0 - z * z).sqrt();
        let direction = DVec3::new(across * angle.cos(), across * angle.sin(), z);
        points.push(Point { at_m: middle + 400.0 * direction, rgb: [0.6, 0.7, 0.85] });
    }
    gaussians_from_points(&points)
}

/// Images and points for the prototype of the project's design.
fn export(path: &str, images: &[Recorded], points: &Gaussians) -> Result<(), Box<dyn Error>> {
    let mut file = BufWriter::new(File::create(path)?);
    let mut words = |words: &[u32]| -> std::io::Result<()> {
        words.iter().try_for_each(|word| file.write_all(&word.to_le_bytes()))
    };
    words(&[images.len() as u32, points.len() as u32])?;
    let floats = |values: &[f64]| values.iter().map(|&v| (v as f32).to_bits()).collect::<Vec<_>>();
    let mut parts: Vec<(Vec<u32>, &[u8])> = Vec::new();
    for image in images {
        let camera = &image.view.camera;
        let mut head = vec![camera.width_px, camera.height_px, image.is_held_out.into()];
        let p = camera.pinhole;
        head.extend(floats(&[p.fx, p.fy, p.cx, p.cy]));
        let camera_from_world = image.view.world_from_camera.inverse();
        let rows = camera_from_world.rotation_matrix().transpose().to_cols_array();
        head.extend(floats(&rows));
        head.extend(floats(&camera_from_world.position_m.to_array()));
        parts.push((head, &image.rgb8));
    }
    for (head, pixels) in parts {
        for word in head {
            file.write_all(&word.to_le_bytes())?;
        }
        file.write_all(pixels)?;
    }
    for i in 0..points.len() {
        let rgb = [0, 1, 2].map(|c| 0.5 + sh::C0 * f64::from(points.sh_at(i)[c]));
        let scale_m = f64::from(points.ln_scales[i][0]).exp();
        for word in floats(&[&points.means_m[i][..], &rgb, &[scale_m]].concat()) {
            file.write_all(&word.to_le_bytes())?;
        }
    }
    Ok(())
}
