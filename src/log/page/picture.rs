//! An image with LiDAR points on it.

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};

use crate::check::SampledImage;
use crate::error::LogError;

/// The distance of the last colour, in metres.
const FAR_M: f32 = 80.0;

const QUALITY: u8 = 85;

/// The image with a square of 2 px for each point, the nearest on top.
pub(super) fn jpeg(sample: &SampledImage) -> Result<Vec<u8>, LogError> {
    let mut rgb8 = sample.rgb8.clone();
    let mut points = sample.points.clone();
    points.sort_by(|a, b| b[2].total_cmp(&a[2]));
    let [width, height] = sample.size_px.map(|side| side as usize);
    for [x, y, range_m] in points {
        let column = x as usize;
        let row = y as usize;
        let square = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(c, r)| (column + c, row + r));
        for (column, row) in square.into_iter().filter(|(c, r)| *c < width && *r < height) {
            rgb8[3 * (row * width + column)..][..3].copy_from_slice(&color(range_m));
        }
    }
    let mut jpeg = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
    let [width, height] = sample.size_px;
    let encoded = encoder.write_image(&rgb8, width, height, ExtendedColorType::Rgb8);
    encoded.map_err(|error| LogError::malformed(sample.image.file.as_ref(), error))?;
    Ok(jpeg)
}

/// From red over yellow, green and cyan to blue; the root spreads what is near.
fn color(range_m: f32) -> [u8; 3] {
    let hue = 4.0 * (range_m / FAR_M).clamp(0.0, 1.0).sqrt();
    // On this scale red is 0, green 2 and blue 4: a channel is full within 1 of its own place and
    // falls to nothing at 2, as around the circle of hues.
    let ramp = |middle: f32| (255.0 * (2.0 - (hue - middle).abs()).clamp(0.0, 1.0)) as u8;
    [ramp(0.0), ramp(2.0), ramp(4.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_red_and_far_is_blue() {
        assert_eq!([0.0, 80.0, 500.0].map(color), [[255, 0, 0], [0, 0, 255], [0, 0, 255]]);
        assert_eq!(color(20.0), [0, 255, 0]);
    }
}
