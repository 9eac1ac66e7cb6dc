//! All images of a view by a backend, parts of images, and whether the images of two backends
//! agree.

use glam::{DMat3, DQuat, DVec3};

use crate::compare::psnr::psnr_db;
use crate::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{RenderProfile, Scene};

/// All images of one view, row by row from the top. Their shapes are those of [`Target`].
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedImage {
    /// `[height, width, 4]`: linear colour, and opacity.
    pub rgba: Vec<f32>,
    /// `[height, width, 3]`: the colour in 8 bits.
    pub rgb8: Vec<u8>,
    /// `[height, width]`: expected depth in metres, 0 where opacity is 0.
    pub depth_m: Vec<f32>,
    /// `[height, width]`: accumulated opacity.
    pub opacity: Vec<f32>,
}

/// Renders all views in one frame, with every image but normals.
///
/// # Errors
/// As [`Backend::render`].
pub fn render_images(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> Result<Vec<RenderedImage>, RenderError> {
    // The buffers are filled with other values first, so that a pixel that is not written shows up.
    let empty = |view: &View| {
        let pixels = view.camera.pixels();
        RenderedImage {
            rgba: vec![f32::NAN; 4 * pixels],
            rgb8: vec![77; 3 * pixels],
            depth_m: vec![f32::NAN; pixels],
            opacity: vec![f32::NAN; pixels],
        }
    };
    let mut images: Vec<RenderedImage> = views.iter().map(empty).collect();
    let targets = images.iter_mut().map(|RenderedImage { rgba, rgb8, depth_m, opacity }| Target {
        rgba: Some(rgba),
        rgb8: Some(rgb8),
        depth_m: Some(depth_m),
        opacity: Some(opacity),
        ..Target::default()
    });
    let mut targets: Vec<Target<'_>> = targets.collect();
    backend.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {})?;
    Ok(images)
}

/// A pinhole camera with a centred principal point and square pixels, at `position_m`, that looks
/// along `forward`; `down` points to the image's lower edge.
pub fn view_along(
    size_px: [u32; 2],
    focal_px: f64,
    position_m: DVec3,
    forward: DVec3,
    down: DVec3,
) -> View {
    let z = forward.normalize();
    // x to the right, y down, z ahead: x = y x z. The given `down` need not be normal to z.
    let x = down.cross(z).normalize();
    let axes = DMat3::from_cols(x, z.cross(x), z);
    let [width_px, height_px] = size_px;
    let pinhole = Pinhole {
        fx: focal_px,
        fy: focal_px,
        cx: 0.5 * f64::from(width_px),
        cy: 0.5 * f64::from(height_px),
    };
    let world_from_camera = Pose { position_m, rotation: DQuat::from_mat3(&axes).normalize() };
    View::new(Camera::from_pinhole(width_px, height_px, pinhole), world_from_camera)
}

/// A view with an image that is a part of another view's image. The part may reach beyond the
/// image's edges.
pub fn crop_view(whole: View, [left, top]: [i32; 2], [width_px, height_px]: [u32; 2]) -> View {
    let mut camera = Camera { width_px, height_px, ..whole.camera };
    camera.pinhole.cx -= f64::from(left);
    camera.pinhole.cy -= f64::from(top);
    View { camera, ..whole }
}

/// The colours and opacities (`rgba`) of a part of an image that is `width_px` wide, row by row.
///
/// # Panics
/// If the part does not lie within the image.
pub fn crop_rgba(
    image: &RenderedImage,
    width_px: u32,
    [left, top]: [u32; 2],
    [columns, rows]: [u32; 2],
) -> Vec<f32> {
    assert!(left + columns <= width_px, "{left} and {columns} columns of {width_px}");
    let row = |y: u32| {
        let start = 4 * (y as usize * width_px as usize + left as usize);
        &image.rgba[start..start + 4 * columns as usize]
    };
    (top..top + rows).flat_map(row).copied().collect()
}

/// The largest difference of two values; infinity if one is a NaN, or if the lengths differ.
pub fn max_difference(a: &[f32], b: &[f32]) -> f32 {
    if a.len() != b.len() {
        return f32::INFINITY;
    }
    // Not `f32::max`, which ignores a NaN.
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

/// Least PSNR at which two images agree, in dB.
pub const AGREEMENT_DB: f64 = 70.0;

/// Whether two backends drew the same: a PSNR of at least [`AGREEMENT_DB`], no value off by more
/// than 2/255, and depths within a hundredth, on average 1e-4, where opacity is at least 1/2.
/// Returns the PSNR in dB.
///
/// # Errors
/// Describes the difference and its size.
pub fn agree(image: &RenderedImage, truth: &RenderedImage) -> Result<f64, String> {
    let pairs = image.rgba.iter().zip(&truth.rgba);
    let db = psnr_db(pairs.map(|(a, b)| f64::from(a - b)));
    // Written so that a NaN fails: no comparison with it holds.
    let off = max_difference(&image.rgba, &truth.rgba);
    let close = db >= AGREEMENT_DB && off <= 2.0 / 255.0;
    if !close {
        return Err(format!("{db:.1} dB, off by {off:.5}"));
    }
    let bytes = image.rgb8.iter().zip(&truth.rgb8).map(|(a, b)| a.abs_diff(*b)).max();
    if bytes > Some(2) {
        return Err(format!("8-bit colour off by {bytes:?}"));
    }
    // Where one backend blends a splat that the other finds just below alpha_cut, 1/255 of the
    // weight comes from another depth: a hundredth of the depth, if the splat lies 2.5 times as
    // deep. On average the backends must be far closer.
    let mut off = 0.0;
    let mut covered = 0.0;
    for (pixel, (&depth, &truth_m)) in image.depth_m.iter().zip(&truth.depth_m).enumerate() {
        // A faint pixel's depth is a quotient of two small sums; it has to be a number, no more.
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
