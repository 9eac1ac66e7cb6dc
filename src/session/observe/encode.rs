//! Hashing and encoding of an image, as soon as it is rendered.

use std::time::{Duration, Instant};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde::{Deserialize, Serialize};

use wildcity_options::{Encoding, Outputs};

use super::jpeg::{jpeg, jpeg_in_strips};
use super::trust::Trust;
use crate::limits;
use crate::repair::status::ImageRepair;

/// How colour images travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageEncoding {
    /// JPEG, 4:2:0, of a quality from 1 to 100.
    Jpeg(u8),
    Png,
    /// Pixels as they are.
    Raw,
}

impl ImageEncoding {
    /// The encoding that a session asks for.
    pub fn new(outputs: &Outputs) -> Self {
        match outputs.encoding {
            Encoding::Jpeg => Self::Jpeg(outputs.quality.unwrap_or(limits::JPEG_QUALITY)),
            Encoding::Png => Self::Png,
            Encoding::Raw => Self::Raw,
        }
    }
}

/// Per-pixel maps of an image in addition to its colour; all but `instances` and `semantics` are
/// f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelMaps {
    /// Expected depth in metres, `[height, width]`.
    pub depth: bool,
    /// Accumulated opacity, `[height, width]`.
    pub opacity: bool,
    /// Unit normals in the camera's axes, `[height, width, 3]`.
    pub normals: bool,
    /// Whose Gaussian each pixel shows, u16 `[height, width]`: 0 none, 1 the twin, and actor k is k
    /// + 2.
    pub instances: bool,
    /// The class of the Gaussian that each pixel shows, u8 `[height, width]`, as
    /// [`SemanticClass`](wildcity_scene::SemanticClass).
    pub semantics: bool,
}

impl PixelMaps {
    /// The maps that a session asks for.
    pub fn new(outputs: &Outputs) -> Self {
        Self {
            depth: outputs.depth,
            opacity: outputs.opacity,
            normals: outputs.normals.unwrap_or(false),
            instances: outputs.instances.unwrap_or(false),
            semantics: outputs.semantics.unwrap_or(false),
        }
    }

    /// f32 values per pixel, all f32 maps together.
    pub(crate) fn values(self) -> usize {
        usize::from(self.depth) + usize::from(self.opacity) + 3 * usize::from(self.normals)
    }
}

/// An image after hashing and encoding.
pub(crate) struct EncodedImage {
    /// BLAKE3 of its pixels.
    pub(crate) hash: blake3::Hash,
    /// The JPEG or PNG file; for raw images, a copy of the pixels if a later observation shows
    /// them.
    pub(crate) file: Vec<u8>,
    /// Its trust, if the session's images come with one.
    pub(crate) trust: Option<Trust>,
    /// Result of the repair, if the session asked for repair.
    pub(crate) repair: Option<ImageRepair>,
    /// Changes by the camera's effects, if there are any.
    pub(crate) effects: Option<AppliedEffects>,
    /// The pixels after these effects, of raw images.
    pub(crate) changed: Vec<u8>,
    /// How long hashing and encoding took on its thread.
    pub(crate) took: Duration,
}

/// Changes of an image by the effects of its camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AppliedEffects {
    /// BLAKE3 of the pixels before the effects.
    pub(crate) clean_hash: blake3::Hash,
    /// Offset of the exposure, in stops; only with a drift.
    pub(crate) stops: Option<f64>,
}

impl EncodedImage {
    /// An image with nothing but a hash.
    fn from_hash(hash: blake3::Hash) -> Self {
        Self {
            hash,
            file: Vec::new(),
            trust: None,
            repair: None,
            effects: None,
            changed: Vec::new(),
            took: Duration::ZERO,
        }
    }
}

/// Hashes and encodes the pixels of an image. Runs on a render thread while other images are still
/// rendered. With `in_parallel`, the other threads of its pool help.
pub(crate) fn encode(
    rgb8: &[u8],
    width: u32,
    height: u32,
    encoding: ImageEncoding,
    in_parallel: bool,
) -> Result<EncodedImage, String> {
    let started = Instant::now();
    let file = || match encoding {
        // Raw pixels are in the answer already.
        ImageEncoding::Raw => Ok(Vec::new()),
        ImageEncoding::Jpeg(quality) if in_parallel => jpeg_in_strips(rgb8, width, height, quality),
        ImageEncoding::Jpeg(quality) => jpeg(rgb8, width, height, quality),
        ImageEncoding::Png => png(rgb8, width, height),
    };
    // Both read all pixels, and neither needs the other.
    let (hash, file) = if in_parallel {
        rayon::join(|| blake3::hash(rgb8), file)
    } else {
        (blake3::hash(rgb8), file())
    };
    let file = file?;
    Ok(EncodedImage { file, took: started.elapsed(), ..EncodedImage::from_hash(hash) })
}

/// An image that is hashed and not encoded yet.
pub(crate) fn hashed(rgb8: &[u8]) -> EncodedImage {
    let started = Instant::now();
    let hash = blake3::hash(rgb8);
    EncodedImage { took: started.elapsed(), ..EncodedImage::from_hash(hash) }
}

/// A PNG file of `[height, width, 3]` pixels.
///
/// # Errors
/// `rgb8` has another length.
pub fn png(rgb8: &[u8], width: u32, height: u32) -> Result<Vec<u8>, String> {
    let mut file = Vec::new();
    // `Fast` takes 13 ms for 1440x928; the default takes 30 times as long and saves 5 %.
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
        .write_image(rgb8, width, height, ExtendedColorType::Rgb8)
        .map_err(|error| error.to_string())?;
    Ok(file)
}
