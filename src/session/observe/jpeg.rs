//! JPEG files.
//!
//! Two encoders: the crate jpeg-encoder, which is always available, and libjpeg-turbo, with the
//! feature `turbojpeg`. Both write baseline JPEG, 4:2:0, with the quantisation tables of annex K
//! scaled by the quality as the Independent JPEG Group does, so that sizes and errors are alike;
//! the bytes are not. With either one the same pixels give the same bytes.

/// A JPEG file, 4:2:0, of `[height, width, 3]` pixels.
///
/// # Errors
/// A side has no pixel, or more than JPEG's 65,535, or `rgb8` has another length.
pub fn jpeg(rgb8: &[u8], width: u32, height: u32, quality: u8) -> Result<Vec<u8>, String> {
    let side = |px: u32| {
        let within = u16::try_from(px).ok().filter(|px| *px > 0);
        within.ok_or_else(|| format!("a JPEG has sides of 1 to 65535 px, not {px}"))
    };
    let size_px = [side(width)?, side(height)?];
    // Both sides are below 2¹⁶ here, so that the product does not overflow.
    if rgb8.len() as u64 != 3 * u64::from(width) * u64::from(height) {
        let bytes = rgb8.len();
        return Err(format!("{bytes} bytes are not {width} x {height} pixels of 3 bytes"));
    }
    compress(rgb8, size_px, quality)
}

#[cfg(not(feature = "turbojpeg"))]
fn compress(rgb8: &[u8], [width, height]: [u16; 2], quality: u8) -> Result<Vec<u8>, String> {
    // Street scenes take an eighth of the pixels' bytes at quality 90.
    let mut file = Vec::with_capacity(rgb8.len() / 8);
    let mut encoder = jpeg_encoder::Encoder::new(&mut file, quality);
    encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
    let encoded = encoder.encode(rgb8, width, height, jpeg_encoder::ColorType::Rgb);
    encoded.map_err(|error| error.to_string())?;
    Ok(file)
}

#[cfg(feature = "turbojpeg")]
fn compress(rgb8: &[u8], size_px: [u16; 2], quality: u8) -> Result<Vec<u8>, String> {
    let [width, height] = size_px.map(usize::from);
    let image = turbojpeg::Image {
        pixels: rgb8,
        width,
        pitch: 3 * width,
        height,
        format: turbojpeg::PixelFormat::RGB,
    };
    let file = turbojpeg::compress(image, i32::from(quality), turbojpeg::Subsamp::Sub2x2);
    Ok(file.map_err(|error| error.to_string())?.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gradient with a bright square: smooth areas, and an edge.
    fn picture(width: u32, height: u32) -> Vec<u8> {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
        pixels
            .flat_map(|[x, y]| {
                let inside = x > width / 3 && x < width / 2 && y > height / 3 && y < height / 2;
                if inside { [250, 240, 230] } else { [(x % 256) as u8, (y % 256) as u8, 96] }
            })
            .collect()
    }

    #[test]
    fn a_jpeg_shows_the_image_again_and_repeats_its_bytes() {
        // Whole blocks of 16 x 16 px, parts of blocks, and a single pixel.
        for [width, height] in [[160, 96], [33, 17], [1, 1]] {
            let rgb8 = picture(width, height);
            let file = jpeg(&rgb8, width, height, 90).unwrap();
            assert_eq!(file, jpeg(&rgb8, width, height, 90).unwrap());
            let read = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg);
            let read = read.unwrap().to_rgb8();
            assert_eq!(read.dimensions(), (width, height));
            let squares =
                read.as_raw().iter().zip(&rgb8).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
            let mean = squares.sum::<f64>() / rgb8.len() as f64;
            // 30 is a signal-to-noise ratio of 10 log10(255² / 30) = 33 dB.
            assert!(mean < 30.0, "{width} x {height}: mean squared error {mean}");
        }
    }

    #[test]
    fn a_higher_quality_takes_more_bytes() {
        let rgb8 = picture(160, 96);
        let bytes = [50, 75, 90, 98].map(|quality| jpeg(&rgb8, 160, 96, quality).unwrap().len());
        assert!(bytes.is_sorted_by(|a, b| a < b), "{bytes:?}");
    }

    #[test]
    fn what_is_no_image_is_an_error() {
        // A byte too few, a byte too many, no pixel, and a side that is too long.
        for (bytes, width, height) in [(11, 2, 2), (13, 2, 2), (0, 0, 0), (3 * 65_536, 65_536, 1)] {
            assert!(
                jpeg(&vec![0; bytes], width, height, 90).is_err(),
                "{bytes}, {width} x {height}"
            );
        }
    }
}
