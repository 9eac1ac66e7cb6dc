//! Masks, depth and images, as PNG.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::FieldMask;

use crate::AugmentError;
use crate::limits::{LEAST_OPACITY, MOST_DEPTH_M};

/// The pixels that count: opaque, and within the lens' field. `opacity` is `[height, width]`, 0 to
/// 1.
///
/// # Errors
/// `opacity` has another size than the camera's image.
pub fn counted(camera: &Camera, opacity: &[f32]) -> Result<Vec<bool>, AugmentError> {
    let pixels = camera.pixels();
    if opacity.len() != pixels {
        return Err(AugmentError::Values { what: "opacity", values: opacity.len(), pixels });
    }
    // A NaN is not opaque.
    let mut counts: Vec<bool> = opacity.iter().map(|opacity| *opacity >= LEAST_OPACITY).collect();
    if let Some(field) = FieldMask::from_camera(camera) {
        field.clear_outside(camera, 1, &mut counts);
    }
    Ok(counts)
}

/// Depth in whole millimetres, 0 without depth: where the pixel does not count, and beyond
/// [`crate::limits::MOST_DEPTH_M`]. `depth_m` is `[height, width]`.
///
/// # Errors
/// The two have different sizes.
pub fn depth_mm(depth_m: &[f32], counts: &[bool]) -> Result<Vec<u16>, AugmentError> {
    if depth_m.len() != counts.len() {
        let values = depth_m.len();
        return Err(AugmentError::Values { what: "depth", values, pixels: counts.len() });
    }
    let mm = |(depth_m, counts): (&f32, &bool)| {
        let is_told = *counts && *depth_m > 0.0 && *depth_m <= MOST_DEPTH_M;
        // 65,000 at most: the cast drops nothing.
        if is_told { (f64::from(*depth_m) * 1e3).round() as u16 } else { 0 }
    };
    Ok(depth_m.iter().zip(counts).map(mm).collect())
}

/// A grey PNG: 255 where pixels count.
///
/// # Errors
/// [`AugmentError::Png`].
pub fn mask_png(counts: &[bool], size_px: [u32; 2]) -> Result<Vec<u8>, AugmentError> {
    let bytes: Vec<u8> = counts.iter().map(|counts| if *counts { 255 } else { 0 }).collect();
    png(&bytes, size_px, ExtendedColorType::L8)
}

/// A grey PNG of 16 bits.
///
/// # Errors
/// [`AugmentError::Png`].
pub fn millimetres_png(depth_mm: &[u16], size_px: [u32; 2]) -> Result<Vec<u8>, AugmentError> {
    // In the machine's order, as the encoder expects it; it writes big-endian.
    let bytes: Vec<u8> = depth_mm.iter().flat_map(|mm| mm.to_ne_bytes()).collect();
    png(&bytes, size_px, ExtendedColorType::L16)
}

/// A PNG of `[height, width, 3]` values.
///
/// # Errors
/// [`AugmentError::Png`].
pub fn rgb_png(rgb8: &[u8], size_px: [u32; 2]) -> Result<Vec<u8>, AugmentError> {
    png(rgb8, size_px, ExtendedColorType::Rgb8)
}

fn png(bytes: &[u8], size_px: [u32; 2], color: ExtendedColorType) -> Result<Vec<u8>, AugmentError> {
    let [width, height] = size_px;
    let expected = u64::from(width) * u64::from(height) * u64::from(color.bits_per_pixel() / 8);
    if bytes.len() as u64 != expected {
        let pixels = width as usize * height as usize;
        return Err(AugmentError::Values { what: "an image", values: bytes.len(), pixels });
    }
    let mut file = Vec::new();
    // Fast: a round may have a million images.
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .map_err(|error| AugmentError::Png(error.to_string()))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole};

    use super::*;

    fn camera() -> Camera {
        Camera::from_pinhole(3, 2, Pinhole { fx: 2.0, fy: 2.0, cx: 1.5, cy: 1.0 })
    }

    #[test]
    fn opaque_pixels_count_and_have_depth_up_to_65_m() {
        // 0.499 is just below the limit, 0.5 on it.
        let counts = counted(&camera(), &[0.0, 0.499, 0.5, 1.0, 1.0, 1.0]).unwrap();
        assert_eq!(counts, [false, false, true, true, true, true]);
        // The first two pixels do not count, the fifth is beyond 65 m, the last has no depth.
        let mm = depth_mm(&[9.0, 9.0, 12.3456, 65.0, 65.01, 0.0], &counts).unwrap();
        assert_eq!(mm, [0, 0, 12_346, 65_000, 0, 0]);
        let read = image::load_from_memory(&millimetres_png(&mm, [3, 2]).unwrap()).unwrap();
        assert_eq!(read.into_luma16().into_raw(), mm);
        let read = image::load_from_memory(&mask_png(&counts, [3, 2]).unwrap()).unwrap();
        assert_eq!(read.into_luma8().into_raw(), [0, 0, 255, 255, 255, 255]);
    }

    #[test]
    fn pixels_outside_of_the_field_do_not_count() {
        let pinhole = Pinhole { fx: 20.0, fy: 20.0, cx: 20.0, cy: 20.0 };
        let mut camera = Camera::from_pinhole(40, 40, pinhole);
        camera.lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(0.9)));
        let counts = counted(&camera, &[1.0; 1600]).unwrap();
        // A disc of 0.9 x 20 px.
        let inside = counts.iter().filter(|counts| **counts).count() as f64;
        assert!((inside / (std::f64::consts::PI * 18.0 * 18.0) - 1.0).abs() < 0.02, "{inside}");
    }

    #[test]
    fn sizes_that_differ_are_refused() {
        let said = counted(&camera(), &[1.0]).unwrap_err().to_string();
        assert_eq!(said, "opacity has 1 values, but the image has 6 pixels");
        assert!(depth_mm(&[1.0], &[true, true]).is_err());
        assert!(rgb_png(&[0; 17], [3, 2]).is_err());
    }
}
