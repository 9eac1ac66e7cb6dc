//! What happens to an image as soon as it is drawn: hashed, and made a JPEG or PNG.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// How colour images travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// JPEG, 4:2:0, of a quality from 1 to 100.
    Jpeg(u8),
    /// PNG.
    Png,
    /// Pixels as they are.
    Raw,
}

/// One image as the worker thread left it.
pub(super) struct Drawn {
    /// BLAKE3 of its pixels.
    pub(super) hash: blake3::Hash,
    /// The file, unless the pixels are in the buffer already.
    pub(super) file: Vec<u8>,
    /// CPU time that this took.
    pub(super) took: Duration,
}

/// Hashes the pixels of an image, and encodes them. Runs on a render thread, while other images
/// are still drawn.
pub(super) fn encode(
    rgb8: &[u8],
    width: u32,
    height: u32,
    encoding: Encoding,
) -> Result<Drawn, String> {
    let started = Instant::now();
    let hash = blake3::hash(rgb8);
    let mut file = Vec::new();
    match encoding {
        Encoding::Raw => {}
        Encoding::Jpeg(quality) => {
            let side = |px| u16::try_from(px).map_err(|_| format!("{px} px is beyond JPEG"));
            // An eighth of the pixel bytes is what street scenes take at quality 90.
            file.reserve(rgb8.len() / 8);
            let mut encoder = jpeg_encoder::Encoder::new(&mut file, quality);
            encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
            encoder
                .encode(rgb8, side(width)?, side(height)?, jpeg_encoder::ColorType::Rgb)
                .map_err(|error| error.to_string())?;
        }
        Encoding::Png => {
            use image::ImageEncoder as _;
            use image::codecs::png::{CompressionType, FilterType, PngEncoder};
            // `Fast` takes 13 ms for 1440x928, the default 30 times as long for 5 % less.
            PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
                .write_image(rgb8, width, height, image::ExtendedColorType::Rgb8)
                .map_err(|error| error.to_string())?;
        }
    }
    Ok(Drawn { hash, file, took: started.elapsed() })
}
