//! Files of real images and of masks.

use std::path::{Component, Path, PathBuf};

use anyhow::{Context, bail, ensure};
use image::{DynamicImage, ImageReader, Limits};

use wildcity_scene::geometry::Camera;

/// Largest difference of an image's two scales to its camera's, as a share: rounding of sides to
/// pixels.
const SAME_SHAPE: f64 = 0.01;

/// Reads a real image, in 8 bits, with its camera at the image's size. Where it is transparent,
/// `background` shows.
///
/// # Errors
/// The file cannot be read, or has another shape than the camera.
pub fn real(
    file: &Path,
    camera: &Camera,
    background: [f64; 3],
) -> anyhow::Result<(Vec<u8>, Camera)> {
    let image = read(file)?;
    let camera = fitted(camera, [image.width(), image.height()])
        .with_context(|| format!("{}", file.display()))?;
    if !image.color().has_alpha() {
        return Ok((image.into_rgb8().into_raw(), camera));
    }
    let blend = |pixel: &[u8]| {
        let opacity = f64::from(pixel[3]) / 255.0;
        [0, 1, 2].map(|c| {
            let behind = 255.0 * background[c] * (1.0 - opacity);
            (opacity * f64::from(pixel[c]) + behind).round() as u8
        })
    };
    Ok((image.into_rgba8().as_raw().chunks_exact(4).flat_map(blend).collect(), camera))
}

/// Reads a mask: the pixels that count. Pixels darker than half do not.
///
/// # Errors
/// The file cannot be read, or has another size than the image.
pub fn mask(file: &Path, size_px: [u32; 2]) -> anyhow::Result<Vec<bool>> {
    let mask = read(file)?.into_luma8();
    let own_px = [mask.width(), mask.height()];
    ensure!(
        own_px == size_px,
        "the mask {} has {} x {} px, but its image {} x {}: a mask has the size of its image",
        file.display(),
        own_px[0],
        own_px[1],
        size_px[0],
        size_px[1]
    );
    Ok(mask.as_raw().iter().map(|value| *value >= 128).collect())
}

/// Reads a depth: a grey PNG of 16 bits in thousandths of the scene's unit, millimetres if that is
/// metres, with 0 where there is none.
///
/// # Errors
/// The file cannot be read, is no grey image of 16 bits, or has another size than the image.
pub fn depth_m(file: &Path, size_px: [u32; 2]) -> anyhow::Result<Vec<f32>> {
    let name = file.display();
    let DynamicImage::ImageLuma16(depth) = read(file)? else {
        bail!("the depth {name} is no grey PNG of 16 bits, which holds millimetres");
    };
    let own_px = [depth.width(), depth.height()];
    ensure!(
        own_px == size_px,
        "the depth {name} has {own_px:?} px, but its image {size_px:?}: a depth has the size of its image"
    );
    Ok(depth.as_raw().iter().map(|&mm| f32::from(mm) * 1e-3).collect())
}

/// A name as a path that stays within a folder.
pub fn inside(name: &str) -> PathBuf {
    Path::new(name).components().filter(|part| matches!(part, Component::Normal(_))).collect()
}

/// The camera at the size of the image. A scene that was trained on smaller images has them as its
/// native ones.
fn fitted(camera: &Camera, [width, height]: [u32; 2]) -> anyhow::Result<Camera> {
    let own = [camera.width_px, camera.height_px];
    if own == [width, height] {
        return Ok(*camera);
    }
    let across = f64::from(width) / f64::from(own[0]);
    let down = f64::from(height) / f64::from(own[1]);
    // Sides are rounded to pixels.
    let slack = SAME_SHAPE.max(1.0 / f64::from(width.min(height)));
    ensure!(
        (across / down - 1.0).abs() <= slack,
        "the image has {width} x {height} px, but its camera {} x {}: give images as they were calibrated, or scaled evenly",
        own[0],
        own[1]
    );
    let scaled = camera.scaled(width.into(), height.into())?;
    Ok(Camera { native_size_px: None, ..scaled })
}

fn read(file: &Path) -> anyhow::Result<DynamicImage> {
    let cannot = || format!("cannot read {}", file.display());
    let mut reader =
        ImageReader::open(file).with_context(cannot)?.with_guessed_format().with_context(cannot)?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(Camera::MAX_SIDE_PX);
    limits.max_image_height = Some(Camera::MAX_SIDE_PX);
    reader.limits(limits);
    reader.decode().with_context(cannot)
}
