//! The reference backend: the image by definition, in f64, without tiles, SIMD or bounds. It is
//! slow and simple.
//!
//! It differentiates the camera numerically and inverts the covariance directly, so that an error
//! in a formula that the other backends derive by hand shows up as a difference.

mod background;
mod blend;
pub mod gradient;
mod lidar;
mod project;
mod rays;

use std::time::Instant;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

pub use project::{Gaussian, Splat, project};

use wildcity_scene::appearance::{Appearance, Exposure};

use super::samples::{SAMPLES, SampledViews};
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use crate::gradient::Differentiate;
use crate::lidar::{LidarView, Sweep};
use wildcity_scene::{Rays, RenderProfile, Scene};

/// The backend in f64, which defines the images of all others.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reference;

impl Backend for Reference {
    fn draws_exact_rays(&self) -> bool {
        true
    }

    fn name(&self) -> &'static str {
        "reference"
    }

    fn as_differentiate(&self) -> Option<&dyn Differentiate> {
        Some(self)
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        on_view_done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        let mut project_ms = 0.0;
        let mut blend_ms = 0.0;
        let mut stats = FrameStats::default();
        let sampled = SampledViews::new(frame);
        let drawn = sampled.frame(frame);
        // One view after the other; rows run in parallel, and keep their order.
        for (index, (view, target)) in frame.views.iter().zip(targets).enumerate() {
            // The view whose pixels are blended: `view`, or that of its samples.
            let drawn = &drawn.views[index];
            // Project and sort.
            let start = Instant::now();
            let scene = &*frame.scene.for_view(index);
            let mut splats = project(scene, frame.profile, drawn);
            project::sort(&mut splats);
            // Splats give order, colour and visibility; exact rays take only the shape from these.
            let gaussians = match frame.profile.rays {
                Rays::Splats => Vec::new(),
                Rays::Exact => rays::gaussians(scene, &splats),
            };
            let views = match frame.profile.rays {
                Rays::Splats => Vec::new(),
                Rays::Exact => rays::relative_views(scene, drawn),
            };
            project_ms += start.elapsed().as_secs_f64() * 1e3;
            stats.visible_pairs += splats.len() as u64;

            // Blend row by row, then add the background, and apply exposure and overlay of the
            // camera.
            let start = Instant::now();
            let width = drawn.camera.width_px as usize;
            let blend = |row: u32| match frame.profile.rays {
                Rays::Splats => blend::row(&splats, row, width, frame.profile),
                Rays::Exact => rays::row(&splats, &gaussians, row, &views, frame.profile),
            };
            let appearance = target.appearance;
            let pixels: Vec<blend::Pixel> = (0..view.camera.height_px)
                .into_par_iter()
                .flat_map_iter(|row| {
                    let mut pixels = if sampled.sampled.contains(index) {
                        blend::means(&blend(SAMPLES * row), &blend(SAMPLES * row + 1))
                    } else {
                        blend(row)
                    };
                    background::add(frame, view, row, &mut pixels);
                    if let Some(appearance) = appearance {
                        apply_appearance(appearance, row, &mut pixels);
                    }
                    pixels
                })
                .collect();
            blend_ms += start.elapsed().as_secs_f64() * 1e3;
            stats.evaluations += drawn.camera.pixels() as u64 * splats.len() as u64;
            write(&pixels, target);
            target.finish(view);
            on_view_done(index, target);
        }
        stats.stages_ms = vec![("project", project_ms), ("rasterize", blend_ms)];
        Ok(stats)
    }

    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        Ok(lidar::sweep(scene, profile, view))
    }
}

/// Applies the camera's exposure, then its overlay, to one row of pixels.
fn apply_appearance(appearance: &Appearance, row: u32, pixels: &mut [blend::Pixel]) {
    let Appearance { exposure, overlay } = appearance;
    for (column, pixel) in pixels.iter_mut().enumerate() {
        if let Some(Exposure { matrix, offset }) = exposure {
            // The matrix is given by rows, and glam has columns.
            let exposed = DMat3::from_cols_array_2d(matrix).transpose() * pixel.rgb;
            pixel.rgb = exposed + DVec3::from_array(*offset);
        }
        if let Some(overlay) = overlay {
            let first = 4 * (row as usize * overlay.size_px()[0] as usize + column);
            let [r, g, b, alpha] =
                [0, 1, 2, 3].map(|c| f64::from(overlay.rgba8()[first + c]) / 255.0);
            pixel.rgb = pixel.rgb.lerp(DVec3::new(r, g, b), alpha);
        }
    }
}

/// Stage resolve: pixels in f64 become the requested images.
fn write(pixels: &[blend::Pixel], target: &mut Target<'_>) {
    for (i, pixel) in pixels.iter().enumerate() {
        let opacity = 1.0 - pixel.transmittance;
        if let Some(rgba) = &mut target.rgba {
            let [r, g, b] = pixel.rgb.to_array();
            // `zip` ends after the four values of this pixel.
            for (value, to) in [r, g, b, opacity].into_iter().zip(&mut rgba[4 * i..]) {
                *to = value as f32;
            }
        }
        if let Some(rgb8) = &mut target.rgb8 {
            for (value, to) in pixel.rgb.to_array().into_iter().zip(&mut rgb8[3 * i..]) {
                *to = (value.clamp(0.0, 1.0) * 255.0).round() as u8;
            }
        }
        if let Some(depth_m) = &mut target.depth_m {
            depth_m[i] = if opacity > 0.0 { (pixel.depth_m / opacity) as f32 } else { 0.0 };
        }
        if let Some(to) = &mut target.opacity {
            to[i] = opacity as f32;
        }
        if let Some(to) = &mut target.instances {
            to[i] = pixel.instance;
        }
        if let Some(to) = &mut target.semantics {
            to[i] = pixel.class.value();
        }
    }
}
