//! The pictures of a page.

use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{ExtendedColorType, ImageEncoder, RgbImage};

use super::error::PageError;

/// The distance of the last colour of a depth, in metres.
pub(super) const FAR_M: f32 = 80.0;

/// Four pictures stand side by side on a page of 1,160 px.
const MOST_PX: u32 = 560;

const QUALITY: u8 = 88;

/// An image as JPEG, at a width that a page shows.
pub(super) fn jpeg(size_px: [u32; 2], rgb8: &[u8]) -> Result<Vec<u8>, PageError> {
    let [width, height] = size_px;
    let made = RgbImage::from_raw(width, height, rgb8.to_vec());
    let image = made.ok_or(PageError::Size(width, height))?;
    let shown = if width > MOST_PX {
        let shown_height = (height * MOST_PX).div_ceil(width);
        imageops::resize(&image, MOST_PX, shown_height, FilterType::Triangle)
    } else {
        image
    };
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, QUALITY);
    encoder.write_image(&shown, shown.width(), shown.height(), ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

/// Depths in colours from red over yellow, green and cyan to blue; black where there is none. The
/// root spreads what is near.
pub(super) fn depth(depth_m: &[f32]) -> Vec<u8> {
    let color = |&depth_m: &f32| {
        if depth_m <= 0.0 {
            return [0; 3];
        }
        // 0 is red, 1 yellow, 2 green, 3 cyan and 4 blue: a channel is full within 1 of its own
        // hue.
        let hue = 4.0 * (depth_m / FAR_M).clamp(0.0, 1.0).sqrt();
        [0.0_f32, 2.0, 4.0]
            .map(|middle| (255.0 * (2.0 - (hue - middle).abs()).clamp(0.0, 1.0)) as u8)
    };
    depth_m.iter().flat_map(color).collect()
}

/// Normals in colours: red to the right, green upwards, blue towards the camera.
pub(super) fn normals(normals: &[f32]) -> Vec<u8> {
    let color = |&[x, y, z]: &[f32; 3]| {
        if [x, y, z] == [0.0; 3] {
            return [0; 3];
        }
        // The camera's y is down, and its z ahead.
        [x, -y, -z].map(|value| (127.5 * (1.0 + value)).round() as u8)
    };
    normals.as_chunks().0.iter().flat_map(color).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_tell_near_from_far_and_the_road_from_a_wall() {
        assert_eq!(depth(&[0.0, 1e-6, 20.0, 80.0, 500.0])[..3], [0, 0, 0]);
        assert_eq!(depth(&[1e-6, 20.0, 80.0]), [255, 0, 0, 0, 255, 0, 0, 0, 255]);
        assert_eq!(normals(&[0.0, 0.0, 0.0]), [0, 0, 0]);
        assert_eq!(normals(&[0.0, -1.0, 0.0, 0.0, 0.0, -1.0]), [128, 255, 128, 128, 128, 255]);
    }

    #[test]
    fn a_wide_image_is_shown_smaller() {
        let bytes = jpeg([1_120, 10], &[100; 3 * 11_200]).unwrap();
        let image = image::load_from_memory(&bytes).unwrap();
        assert_eq!([image.width(), image.height()], [560, 5]);
    }
}
