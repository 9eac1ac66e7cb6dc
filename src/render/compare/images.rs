//! What a backend draws of a view, every value of it, and whether two drawings are of one thing.

use glam::{DMat3, DQuat, DVec3};

use crate::compare::psnr::psnr_db;
use crate::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{RenderProfile, Scene};

/// What a backend says of one view, row by row from the top; the shapes are those of [`Target`].
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedImage {
    /// `[height, width, 4]`: linear premultiplied colour on black, and opacity.
    pub rgba: Vec<f32>,
    /// `[height, width, 3]`: the colour in 8 bit.
    pub rgb8: Vec<u8>,
    /// `[height, width]`: expected camera z in metres, 0 where opacity is 0.
    pub depth_m: Vec<f32>,
    /// `[height, width]`.
    pub opacity: Vec<f32>,
}

/// Draws all views in one frame, with every output.
///
/// # Errors
/// As [`Backend::render`].
pub fn render_images(
    backend: &dyn Backend,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> Result<Vec<RenderedImage>, RenderError> {
    // Garbage, so that a pixel that nobody wrote is seen.
    let empty = |view: &View| {
        let pixels = view.camera.pixels();
        RenderedImage {
            rgba: vec![f32::NAN; 4 * pixels],
            rgb8: vec![77; 3 * pixels],
            depth_m: vec![f32::NAN; pixels],
            opacity: vec![f32::NAN; pixels],
        }
    };
    let mut drawings: Vec<RenderedImage> = views.iter().map(empty).collect();
    let targets =
        drawings.iter_mut().map(|RenderedImage { rgba, rgb8, depth_m, opacity }| Target {
            rgba: Some(rgba),
            rgb8: Some(rgb8),
            depth_m: Some(depth_m),
            opacity: Some(opacity),
            ..Target::default()
        });
    let mut targets: Vec<Target<'_>> = targets.collect();
    backend.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {})?;
    Ok(drawings)
}

/// A camera with a centred principal point and square pixels, at `position_m`, that looks along
/// `forward` with `down` on the image's lower side.
pub fn view_along(
    size_px: [u32; 2],
    focal_px: f64,
    position_m: DVec3,
    forward: DVec3,
    down: DVec3,
) -> View {
    let z = forward.normalize();
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

/// A part of a view's image, as a view of its own. It may begin before the image, and reach beyond.
pub fn crop_view(whole: View, [left, top]: [i32; 2], [width_px, height_px]: [u32; 2]) -> View {
    let mut camera = Camera { width_px, height_px, ..whole.camera };
    camera.pinhole.cx -= f64::from(left);
    camera.pinhole.cy -= f64::from(top);
    View { camera, ..whole }
}

/// The colours and opacities of a part of a drawing that is `width_px` wide, row by row.
///
/// # Panics
/// If the part is not within the drawing.
pub fn crop_rgba(
    drawing: &RenderedImage,
    width_px: u32,
    [left, top]: [u32; 2],
    [columns, rows]: [u32; 2],
) -> Vec<f32> {
    assert!(left + columns <= width_px, "{left} and {columns} columns of {width_px}");
    let row = |y: u32| {
        let start = 4 * (y as usize * width_px as usize + left as usize);
        &drawing.rgba[start..start + 4 * columns as usize]
    };
    (top..top + rows).flat_map(row).copied().collect()
}

/// Largest difference; NaN anywhere, or another length, gives infinity.
pub fn max_difference(a: &[f32], b: &[f32]) -> f32 {
    if a.len() != b.len() {
        return f32::INFINITY;
    }
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

/// Least PSNR at which two drawings agree, in dB.
pub const AGREEMENT_DB: f64 = 70.0;

/// Whether two backends drew the same thing: at least [`AGREEMENT_DB`], no value off by more than 2/255,
/// and depths within a hundredth, on average 1e-4, where at least half the pixel is covered. Gives the
/// PSNR in dB.
///
/// # Errors
/// Says what is off, and by how much.
pub fn agree(drawing: &RenderedImage, truth: &RenderedImage) -> Result<f64, String> {
    let pairs = drawing.rgba.iter().zip(&truth.rgba);
    let db = psnr_db(pairs.map(|(a, b)| f64::from(a - b)));
    let off = max_difference(&drawing.rgba, &truth.rgba);
    let close = db >= AGREEMENT_DB && off <= 2.0 / 255.0;
    if !close {
        return Err(format!("{db:.1} dB, off by {off:.5}"));
    }
    let bytes = drawing.rgb8.iter().zip(&truth.rgb8).map(|(a, b)| a.abs_diff(*b)).max();
    if bytes > Some(2) {
        return Err(format!("8-bit colour off by {bytes:?}"));
    }
    // Where one backend blends what the other finds just below alpha_cut, 1/255 of the weight comes
    // from another depth: a hundredth of the depth, if that lies 2.5 times as deep. On average the
    // backends must be far closer.
    let (mut off, mut covered) = (0.0, 0.0);
    for (pixel, (&depth, &truth_m)) in drawing.depth_m.iter().zip(&truth.depth_m).enumerate() {
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
