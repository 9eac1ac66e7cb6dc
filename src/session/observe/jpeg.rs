//! JPEG files.
//!
//! A GPU draws the images of a step sooner than one thread encodes the largest of them, so these
//! are encoded in strips of 64 rows, in parallel ([`jpeg_in_strips`]). A strip ends with a restart
//! marker, after which the entropy coding starts anew (ITU-T T.81, B.2.1), so the strips of a file
//! can be encoded one by one. The file has the coefficients of [`jpeg`]'s, and the same bytes for
//! any number of threads.
//!
//! Two encoders: the crate jpeg-encoder, which is always available, and libjpeg-turbo, with the
//! feature `turbojpeg`. Both write baseline JPEG, 4:2:0, with the quantisation tables of annex K
//! scaled by the quality as the Independent JPEG Group does, so that sizes and errors are alike;
//! the bytes are not. With either one the same pixels give the same bytes.

use rayon::prelude::*;

/// Rows of a strip: four rows of units of 16 x 16 px.
const STRIP_ROWS: usize = 64;

/// A JPEG file, 4:2:0, of `[height, width, 3]` pixels.
///
/// # Errors
/// A side has no pixel, or more than JPEG's 65,535, or `rgb8` has another length.
pub fn jpeg(rgb8: &[u8], width: u32, height: u32, quality: u8) -> Result<Vec<u8>, String> {
    compress(rgb8, checked_size(rgb8, width, height)?, quality)
}

/// As [`jpeg`], with a restart marker after every 64 rows, encoded by all threads of the pool.
///
/// # Errors
/// As [`jpeg`].
pub(crate) fn jpeg_in_strips(
    rgb8: &[u8],
    width: u32,
    height: u32,
    quality: u8,
) -> Result<Vec<u8>, String> {
    let size_px = checked_size(rgb8, width, height)?;
    let row_bytes = 3 * width as usize;
    let strips: Result<Vec<Vec<u8>>, String> = rgb8
        .par_chunks(STRIP_ROWS * row_bytes)
        .map(|strip| {
            // At most the rows of the image.
            let rows = (strip.len() / row_bytes) as u16;
            compress(strip, [size_px[0], rows], quality)
        })
        .collect();
    join(&strips?, size_px)
}

/// One file of the files of strips.
fn join(strips: &[Vec<u8>], [width, height]: [u16; 2]) -> Result<Vec<u8>, String> {
    let (first, rest) = strips.split_first().ok_or("an image without rows")?;
    let head = Head::find(first).ok_or(NO_SCAN)?;
    let bytes = strips.iter().map(Vec::len).sum();
    let mut file = Vec::with_capacity(bytes);
    file.extend_from_slice(&first[..head.scan]);
    // The number of rows follows the frame header's length and its precision.
    file[head.frame + 5..head.frame + 7].copy_from_slice(&height.to_be_bytes());
    let units = width.div_ceil(16) * (STRIP_ROWS as u16 / 16);
    file.extend_from_slice(&[0xFF, 0xDD, 0, 4]);
    file.extend_from_slice(&units.to_be_bytes());
    file.extend_from_slice(&first[head.scan..first.len() - 2]);
    for (number, strip) in rest.iter().enumerate() {
        let head = Head::find(strip).ok_or(NO_SCAN)?;
        file.extend_from_slice(&[0xFF, 0xD0 + (number % 8) as u8]);
        file.extend_from_slice(&strip[head.data..strip.len() - 2]);
    }
    file.extend_from_slice(&[0xFF, 0xD9]);
    Ok(file)
}

/// The error of a file in which [`Head::find`] finds nothing.
const NO_SCAN: &str = "the encoder's file has no scan";

/// Where the segments of a file start.
#[derive(Clone, Copy, Debug)]
struct Head {
    /// The frame header, which has the size in pixels: the marker `SOF0`.
    frame: usize,
    /// The scan header, which lists the colour channels: the marker `SOS`.
    scan: usize,
    /// The entropy-coded data, which end with the file's last marker.
    data: usize,
}

impl Head {
    /// `None` for a file without a frame header and a scan behind it, or without an end.
    fn find(file: &[u8]) -> Option<Self> {
        if !file.ends_with(&[0xFF, 0xD9]) {
            return None;
        }
        let mut frame = None;
        let mut at = 2;
        while let &[0xFF, marker, high, low, ..] = file.get(at..)? {
            // The length of a segment counts its own two bytes, and not the marker's.
            let next = at + 2 + usize::from(u16::from_be_bytes([high, low]));
            match marker {
                0xC0 => frame = Some(at),
                0xDA => return Some(Self { frame: frame?, scan: at, data: next }),
                _ => {}
            }
            at = next;
        }
        None
    }
}

/// The sides of an image that a JPEG can have.
fn checked_size(rgb8: &[u8], width: u32, height: u32) -> Result<[u16; 2], String> {
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
    Ok(size_px)
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
            let read = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg)
                .unwrap()
                .to_rgb8();
            assert_eq!(read.dimensions(), (width, height));
            let squares =
                read.as_raw().iter().zip(&rgb8).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
            let mean = squares.sum::<f64>() / rgb8.len() as f64;
            // 30 is a signal-to-noise ratio of 10 log10(255² / 30) = 33 dB.
            assert!(mean < 30.0, "{width} x {height}: mean squared error {mean}");
        }
    }

    #[test]
    fn strips_show_the_same_image_with_any_number_of_threads() {
        let pixels = |file: &[u8]| {
            let read = image::load_from_memory_with_format(file, image::ImageFormat::Jpeg);
            read.unwrap().to_rgb8().into_raw()
        };
        // One strip; whole strips; more than eight, the last one of a single row; and narrow ones.
        for [width, height] in [[160, 40], [160, 128], [333, 641], [1, 200]] {
            let rgb8 = picture(width, height);
            let whole = pixels(&jpeg(&rgb8, width, height, 90).unwrap());
            let files = [1, 3].map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| jpeg_in_strips(&rgb8, width, height, 90).unwrap())
            });
            assert_eq!(files[0], files[1]);
            assert_eq!(pixels(&files[0]), whole, "{width} x {height}");
            let markers = files[0].windows(2).filter(|two| two[0] == 0xFF && two[1] & 0xF8 == 0xD0);
            assert_eq!(markers.count() as u32, height.div_ceil(64) - 1);
        }
        assert!(jpeg_in_strips(&[0; 11], 2, 2, 90).is_err());
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
