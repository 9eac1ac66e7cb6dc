//! What a camera makes of the light, and what of its own car it sees.

use std::io::Cursor;
use std::sync::Arc;

use data_encoding::BASE64;
use image::{ExtendedColorType, ImageEncoder, ImageFormat, ImageReader};
use serde::{Deserialize, Serialize};

/// How a camera's image differs from what is there.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Appearance {
    /// What it makes of colours; nothing else than they are if absent.
    pub exposure: Option<Exposure>,
    /// What is before everything: its own car's hood.
    pub overlay: Option<Arc<Overlay>>,
}

/// Colours as they are recorded: `matrix * rgb + offset`, linear red, green, blue. It follows the sky and
/// precedes the overlay, and is what street reconstructions train per camera.
///
/// In JSON `{"matrix": [[..], [..], [..]], "offset": [..]}`, or `{"gain": [..], "offset": [..]}` if its
/// matrix is diagonal; an offset of 0 may be left away.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "ExposureFields", into = "ExposureFields")]
pub struct Exposure {
    /// Row by row.
    pub matrix: [[f64; 3]; 3],
    /// Added to each channel.
    pub offset: [f64; 3],
}

/// An image of the camera's own size that is laid over it. In JSON it is a PNG with opacity, as
/// `"data:image/png;base64,.."`.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Overlay {
    width_px: u32,
    rgba8: Vec<u8>,
}

/// Why an appearance was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AppearanceError {
    /// A number that leaves nothing of an image.
    #[error("exposure.{field} is {value:?}; a number from -100 to 100 is")]
    Exposure {
        /// `matrix` or `offset`.
        field: &'static str,
        /// The number.
        value: f64,
    },
    /// The overlay is of another size than the image.
    #[error(
        "the overlay is {} x {} pixels, and the camera's image {} x {}",
        overlay_px[0], overlay_px[1], camera_px[0], camera_px[1]
    )]
    Size {
        /// Width and height of the overlay.
        overlay_px: [u32; 2],
        /// Width and height of the image.
        camera_px: [u32; 2],
    },
    /// The overlay is no image that can be read.
    #[error("the overlay cannot be read: {reason}")]
    Overlay {
        /// What is wrong with it.
        reason: String,
    },
}

impl Appearance {
    /// Whether it changes nothing.
    pub fn is_plain(&self) -> bool {
        self.exposure.is_none() && self.overlay.is_none()
    }

    /// # Errors
    /// A number is out of range, or the overlay is not of the image's size.
    pub fn check(&self, camera_px: [u32; 2]) -> Result<(), AppearanceError> {
        if let Some(Exposure { matrix, offset }) = &self.exposure {
            for (field, values) in [("matrix", matrix.as_flattened()), ("offset", offset)] {
                let is_bad = |value: &&f64| !(-100.0..=100.0).contains(*value);
                if let Some(&value) = values.iter().find(is_bad) {
                    return Err(AppearanceError::Exposure { field, value });
                }
            }
        }
        match &self.overlay {
            Some(overlay) if overlay.size_px() != camera_px => {
                Err(AppearanceError::Size { overlay_px: overlay.size_px(), camera_px })
            }
            _ => Ok(()),
        }
    }
}

impl Overlay {
    /// Most pixels: four times those of a 4K camera's image would be 33 million; a decoded overlay takes
    /// 67 MB at most.
    pub const MAX_PIXELS: u64 = 1 << 24;

    /// From a PNG.
    ///
    /// # Errors
    /// [`AppearanceError::Overlay`].
    pub fn from_png(png: &[u8]) -> Result<Self, AppearanceError> {
        let refused = |reason: String| AppearanceError::Overlay { reason };
        let reader = || ImageReader::with_format(Cursor::new(png), ImageFormat::Png);
        let size = reader().into_dimensions().map_err(|error| refused(error.to_string()))?;
        let pixels = u64::from(size.0) * u64::from(size.1);
        if pixels > Self::MAX_PIXELS {
            let limit = Self::MAX_PIXELS;
            return Err(refused(format!("it has {pixels} pixels; at most {limit} are read")));
        }
        let image = reader().decode().map_err(|error| refused(error.to_string()))?.into_rgba8();
        let width_px = image.width();
        Self::new(width_px, image.into_raw()).ok_or_else(|| refused("it is empty".to_owned()))
    }

    /// From `[height, width, 4]` of red, green, blue, not premultiplied, and opacity. `None` if that is
    /// not a whole number of rows.
    pub fn new(width_px: u32, rgba8: Vec<u8>) -> Option<Self> {
        let row = 4 * width_px as usize;
        (row > 0 && rgba8.len().is_multiple_of(row)).then_some(Self { width_px, rgba8 })
    }

    /// Width and height.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, (self.rgba8.len() / (4 * self.width_px as usize)) as u32]
    }

    /// `[height, width, 4]`.
    pub fn rgba8(&self) -> &[u8] {
        &self.rgba8
    }
}

impl std::fmt::Debug for Overlay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Overlay").field("size_px", &self.size_px()).finish_non_exhaustive()
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ExposureFields {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    matrix: Option<[[f64; 3]; 3]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    gain: Option<[f64; 3]>,
    #[serde(default)]
    offset: [f64; 3],
}

impl TryFrom<ExposureFields> for Exposure {
    type Error = &'static str;

    fn try_from(fields: ExposureFields) -> Result<Self, Self::Error> {
        let ExposureFields { matrix, gain, offset } = fields;
        let matrix = match (matrix, gain) {
            (Some(matrix), None) => matrix,
            (None, Some([r, g, b])) => [[r, 0.0, 0.0], [0.0, g, 0.0], [0.0, 0.0, b]],
            _ => return Err("an exposure has either a matrix or a gain"),
        };
        Ok(Self { matrix, offset })
    }
}

impl From<Exposure> for ExposureFields {
    fn from(Exposure { matrix, offset }: Exposure) -> Self {
        Self { matrix: Some(matrix), gain: None, offset }
    }
}

/// What stands before an overlay's bytes in JSON.
const DATA_URI: &str = "data:image/png;base64,";

impl TryFrom<String> for Overlay {
    type Error = AppearanceError;

    fn try_from(text: String) -> Result<Self, AppearanceError> {
        let refused = |reason: &str| AppearanceError::Overlay { reason: reason.to_owned() };
        let bytes = text.strip_prefix(DATA_URI);
        let bytes = bytes.ok_or_else(|| refused("it does not begin as data:image/png;base64,"))?;
        let png = BASE64.decode(bytes.as_bytes()).map_err(|_| refused("it is not base64"))?;
        Self::from_png(&png)
    }
}

impl From<Overlay> for String {
    fn from(overlay: Overlay) -> Self {
        let mut png = Vec::new();
        let [width, height] = overlay.size_px();
        let encoder = image::codecs::png::PngEncoder::new(&mut png);
        // Into memory, of a size that was checked: it cannot fail.
        let _ = encoder.write_image(&overlay.rgba8, width, height, ExtendedColorType::Rgba8);
        format!("{DATA_URI}{}", BASE64.encode(&png))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_and_back() {
        let overlay = Overlay::new(3, (0..24).collect()).unwrap();
        let text = serde_json::to_string(&overlay).unwrap();
        assert!(text.starts_with("\"data:image/png;base64,iVBOR"), "{text}");
        assert_eq!(serde_json::from_str::<Overlay>(&text).unwrap(), overlay);
        let gain = r#"{"gain": [2, 3, 4]}"#;
        let exposure: Exposure = serde_json::from_str(gain).unwrap();
        assert_eq!(exposure.matrix, [[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]]);
        assert_eq!(exposure.offset, [0.0; 3]);
        let text = serde_json::to_string(&exposure).unwrap();
        assert_eq!(serde_json::from_str::<Exposure>(&text).unwrap(), exposure);
    }

    #[test]
    fn what_is_no_appearance_is_refused() {
        for exposure in [r#"{"offset": [1, 2, 3]}"#, r#"{"gain": [1, 1]}"#, r#"{"gamma": 2}"#] {
            assert!(serde_json::from_str::<Exposure>(exposure).is_err(), "{exposure}");
        }
        let both = r#"{"gain": [1, 1, 1], "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"#;
        let error = serde_json::from_str::<Exposure>(both).unwrap_err().to_string();
        assert!(error.contains("either a matrix or a gain"), "{error}");
        for (overlay, wanted) in [
            ("hood.png", "does not begin as data:image/png;base64,"),
            ("data:image/png;base64,%%%", "it is not base64"),
            ("data:image/png;base64,aGVsbG8=", "the overlay cannot be read"),
        ] {
            let error = Overlay::try_from(overlay.to_owned()).unwrap_err().to_string();
            assert!(error.contains(wanted), "{error}");
        }
        // A PNG of 100,000 x 100,000 pixels that says so in its first bytes.
        let mut png = Vec::new();
        let encoder = image::codecs::png::PngEncoder::new(&mut png);
        encoder.write_image(&[0; 4], 1, 1, ExtendedColorType::Rgba8).unwrap();
        png[16..24].copy_from_slice(&[0, 1, 0x86, 0xA0, 0, 1, 0x86, 0xA0]);
        assert!(Overlay::from_png(&png).is_err());
    }
}
