//! The time of gradients against that of images, in one run.

use std::f64::consts::TAU;
use std::time::Instant;

use glam::{DMat3, DQuat, DVec3};
use serde::Serialize;
use wildcity_render::gradient::{Differentiate, GaussianImages, GradientError, Gradients};
use wildcity_render::{Frame, FrameStats, Target, View};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

/// The times of one size, each the least of some runs in turn.
#[derive(Clone, Debug, Serialize)]
pub struct Time {
    pub backend: &'static str,
    pub gaussians: usize,
    /// Width and height of each view.
    pub size_px: [u32; 2],
    pub views: usize,
    pub visible_pairs: u64,
    /// An image as it is rendered without gradients.
    pub image_ms: f64,
    /// The images with what the way back needs of them: what a training step draws.
    pub forward_ms: f64,
    /// All stages after the loss.
    pub backward_ms: f64,
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// The times of a backend for one view of 720 x 464 px and six full views of a street with these
/// numbers of Gaussians.
///
/// # Errors
/// The backend does not compute gradients of such frames.
pub fn times(
    backend: &dyn Differentiate,
    counts: &[usize],
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Time>, GradientError> {
    let mut rows = Vec::new();
    for &gaussians in counts {
        let scene = Scene::from_gaussians(&street(gaussians));
        for (size_px, views) in [([720, 464], 1), ([1440, 928], 6)] {
            progress(&format!("{gaussians} Gaussians, {views} x {} x {}", size_px[0], size_px[1]));
            rows.push(time(backend, &scene, size_px, views)?);
        }
    }
    Ok(rows)
}

fn time(
    backend: &dyn Differentiate,
    scene: &Scene,
    size_px: [u32; 2],
    count: usize,
) -> Result<Time, GradientError> {
    const RUNS: usize = 3;
    let views: Vec<View> = (0..count).map(|k| view(size_px, TAU * k as f64 / 6.0)).collect();
    let profile = RenderProfile::default();
    let frame = Frame { scene, profile: &profile, views: &views };
    let pixels = views.iter().map(|view| view.camera.pixels());
    let mut images: Vec<Vec<f32>> = pixels.map(|pixels| vec![0.0; 4 * pixels]).collect();
    let mut gradients = Gradients::default();
    let mut image_ms = f64::INFINITY;
    let mut forward_ms = f64::INFINITY;
    let mut backward_ms = f64::INFINITY;
    let mut stats = FrameStats::default();
    // Other work on the machine only adds time, so the least of the runs is closest to the truth.
    for _ in 0..RUNS {
        let mut targets: Vec<Target<'_>> = images
            .iter_mut()
            .map(|rgba| Target { rgba: Some(rgba), ..Target::default() })
            .collect();
        let start = Instant::now();
        backend.render(&frame, &mut targets, &|_, _| {})?;
        image_ms = image_ms.min(start.elapsed().as_secs_f64() * 1e3);
        // The derivatives of half the sum of squares are the images themselves.
        let mut loss = |images: &[GaussianImages]| images.to_vec();
        let run = backend.differentiate(&frame, false, &mut loss, &mut gradients)?;
        let loss = run.stages_ms.iter().position(|(stage, _)| *stage == "loss").unwrap_or(0);
        let sum = |stages: &[(&str, f64)]| stages.iter().map(|(_, ms)| ms).sum::<f64>();
        // Stages are in the order in which they ran, and the loss lies between the two ways.
        forward_ms = forward_ms.min(sum(&run.stages_ms[..loss]));
        let ms = sum(&run.stages_ms[loss + 1..]);
        if ms < backward_ms {
            backward_ms = ms;
            stats = run;
        }
    }
    Ok(Time {
        backend: backend.name(),
        gaussians: scene.gaussians(),
        size_px,
        views: count,
        visible_pairs: stats.visible_pairs,
        image_ms,
        forward_ms,
        backward_ms,
        stages_ms: stats.stages_ms,
    })
}

/// A camera in the street, 1.6 m above it.
fn view([width, height]: [u32; 2], yaw: f64) -> View {
    let focal_px = 0.55 * f64::from(width);
    let center_px = [width, height].map(|size| 0.5 * f64::from(size));
    let pinhole = Pinhole { fx: focal_px, fy: focal_px, cx: center_px[0], cy: center_px[1] };
    // The world has x ahead, y to the left and z up; a camera has x to the right, y down and z
    // ahead.
    let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let rotation = DQuat::from_rotation_z(yaw) * DQuat::from_mat3(&axes);
    let pose = Pose { position_m: DVec3::new(50.0, 0.0, 1.6), rotation };
    View::new(Camera::from_pinhole(width, height, pinhole), pose)
}

/// A road and two facades of 100 m, covered evenly whatever the number of Gaussians.
fn street(count: usize) -> Gaussians {
    let mut random = Random::new(1, "times", 0);
    let mut gaussians = Gaussians::with_capacity(1, count);
    // The area is 3,600 m²; each Gaussian covers its share twice.
    let sigma_m = 0.5 * (3_600.0 / count as f64).sqrt();
    for _ in 0..count {
        let side = if random.chance(0.5) { 1.0 } else { -1.0 };
        let (mean_m, normal) = if random.chance(0.4) {
            ([random.range(0.0, 100.0), random.range(-8.0, 8.0), 0.0], DVec3::Z)
        } else {
            ([random.range(0.0, 100.0), 8.0 * side, random.range(0.0, 10.0)], DVec3::Y)
        };
        gaussians.means_m.push(mean_m);
        let DQuat { x, y, z, w } = DQuat::from_rotation_arc(DVec3::Z, normal);
        gaussians.quats_wxyz.push([w, x, y, z].map(|q| q as f32));
        let mut ln = |sigma_m: f64| (sigma_m * random.range(0.5, 1.5)).ln() as f32;
        gaussians.ln_scales.push([ln(sigma_m), ln(sigma_m), ln(0.01)]);
        gaussians.logit_opacities.push(random.range(-1.0, 3.0) as f32);
        gaussians.sh.extend((0..12).map(|_| random.range(-0.5, 0.5) as f32));
    }
    gaussians
}
