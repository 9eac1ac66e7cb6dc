//! Rendering a view in a test, and comparing images.

#![allow(dead_code, unused_imports, reason = "every test binary uses another part of it")]

use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, View};
use wildcity_scene::{RenderProfile, Scene};

pub(crate) use wildcity_render::compare::images::{
    RenderedImage as Image, agree, max_difference, render_images as try_render, view_along,
};

/// The cpu backend on all cores.
pub(crate) fn cpu() -> Cpu {
    Cpu::new(0, Simd::Best).unwrap()
}

/// Renders all views in one frame, with every output.
pub(crate) fn render(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> Vec<Image> {
    try_render(backend, scene, profile, views).unwrap()
}

/// The image of one view.
pub(crate) fn render_one(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    view: View,
) -> Image {
    render(backend, scene, profile, &[view]).remove(0)
}

/// Peak signal-to-noise ratio in dB, for values whose peak is 1.
pub(crate) fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let mean = a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64;
    -10.0 * mean.log10()
}
