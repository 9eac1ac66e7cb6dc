//! Rendering a view in a test, and comparing images.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use glam::{DQuat, DVec3};
use wildcity::geometry::camera::Pinhole;
use wildcity::geometry::{Camera, Pose};
use wildcity::render::cpu::{Cpu, Simd};
use wildcity::render::{Backend, Frame, RenderError, Target, View};
use wildcity::scene::{RenderProfile, Scene};

/// What a backend says of one view.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Image {
    pub(crate) rgba: Vec<f32>,
    pub(crate) rgb8: Vec<u8>,
    pub(crate) depth_m: Vec<f32>,
    pub(crate) opacity: Vec<f32>,
}

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

/// The same of a backend that may refuse.
pub(crate) fn try_render(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> Result<Vec<Image>, RenderError> {
    // Garbage, so that a pixel that nobody wrote is seen.
    let empty = |view: &View| {
        let pixels = view.camera.pixels();
        Image {
            rgba: vec![f32::NAN; 4 * pixels],
            rgb8: vec![77; 3 * pixels],
            depth_m: vec![f32::NAN; pixels],
            opacity: vec![f32::NAN; pixels],
        }
    };
    let mut images: Vec<Image> = views.iter().map(empty).collect();
    let targets = images.iter_mut().map(|Image { rgba, rgb8, depth_m, opacity }| Target {
        rgba: Some(rgba),
        rgb8: Some(rgb8),
        depth_m: Some(depth_m),
        opacity: Some(opacity),
        appearance: None,
    });
    let mut targets: Vec<Target<'_>> = targets.collect();
    backend.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {})?;
    Ok(images)
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

/// A camera with a centred principal point and square pixels, at `position_m`, that looks along
/// `forward` with `down` on the image's lower side.
pub(crate) fn look(
    size_px: [u32; 2],
    focal_px: f64,
    position_m: DVec3,
    forward: DVec3,
    down: DVec3,
) -> View {
    let z = forward.normalize();
    let x = down.cross(z).normalize();
    let axes = glam::DMat3::from_cols(x, z.cross(x), z);
    let [width_px, height_px] = size_px;
    let pinhole = Pinhole {
        fx: focal_px,
        fy: focal_px,
        cx: 0.5 * f64::from(width_px),
        cy: 0.5 * f64::from(height_px),
    };
    View {
        camera: Camera { width_px, height_px, pinhole },
        world_from_camera: Pose { position_m, rotation: DQuat::from_mat3(&axes).normalize() },
    }
}

/// Peak signal-to-noise ratio in dB, for values whose peak is 1.
pub(crate) fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let mean = a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64;
    -10.0 * mean.log10()
}

/// Largest difference; NaN anywhere gives infinity.
pub(crate) fn max_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |most, (a, b)| {
        let difference = (a - b).abs();
        if difference <= most {
            most
        } else if difference.is_nan() {
            f32::INFINITY
        } else {
            difference
        }
    })
}

/// Whether two backends drew the same image: at least 70 dB, no value off by more than 2/255, and
/// depths within a hundredth, on average 1e-4, where at least half the pixel is covered.
pub(crate) fn agree(image: &Image, truth: &Image) -> Result<f64, String> {
    let db = psnr(&image.rgba, &truth.rgba);
    let off = max_difference(&image.rgba, &truth.rgba);
    let close = db >= 70.0 && off <= 2.0 / 255.0;
    if !close {
        return Err(format!("{db:.1} dB, off by {off:.5}"));
    }
    let bytes = image.rgb8.iter().zip(&truth.rgb8).map(|(a, b)| a.abs_diff(*b)).max();
    if bytes > Some(2) {
        return Err(format!("8-bit colour off by {bytes:?}"));
    }
    // Where one backend blends what the other finds just below alpha_cut, 1/255 of the weight comes
    // from another depth: a hundredth of the depth, if that lies 2.5 times as deep. On average the
    // backends must be far closer.
    let (mut off, mut covered) = (0.0, 0.0);
    for (pixel, (&depth, &truth_m)) in image.depth_m.iter().zip(&truth.depth_m).enumerate() {
        if truth.opacity[pixel] < 0.5 {
            if !depth.is_finite() {
                return Err(format!("pixel {pixel}: depth {depth}"));
            }
            continue;
        }
        let relative = (depth - truth_m).abs() / truth_m;
        let close = relative <= 1e-2;
        if !close {
            return Err(format!("pixel {pixel}: depth {depth} m, truly {truth_m} m"));
        }
        off += f64::from(relative);
        covered += 1.0;
    }
    if off > 1e-4 * covered {
        return Err(format!("depth off by {:.1e} on average", off / covered));
    }
    Ok(db)
}

/// A part of a view's image, as a view of its own.
pub(crate) fn crop(whole: View, [left, top]: [u32; 2], [width_px, height_px]: [u32; 2]) -> View {
    let p = whole.camera.pinhole;
    let pinhole = Pinhole { cx: p.cx - f64::from(left), cy: p.cy - f64::from(top), ..p };
    View { camera: Camera { width_px, height_px, pinhole }, ..whole }
}

/// Largest difference between a crop and the same part of the whole, inside a margin: the slope clamp
/// of the projection follows the image's own edges (gsplat's rule), so a crop draws otherwise what
/// is centred beyond its edges.
pub(crate) fn crop_difference(
    (part, crop): (&Image, View),
    (image, whole): (&Image, View),
    [left, top]: [u32; 2],
    margin: u32,
) -> f32 {
    let Camera { width_px, height_px, .. } = crop.camera;
    let row = |image: &Image, width: u32, x: u32, y: u32| {
        let start = 4 * (y * width + x + margin) as usize;
        image.rgba[start..start + 4 * (width_px - 2 * margin) as usize].to_vec()
    };
    (margin..height_px - margin).fold(0.0, |most, y| {
        let of_whole = row(image, whole.camera.width_px, left, top + y);
        most.max(max_difference(&row(part, width_px, 0, y), &of_whole))
    })
}
