//! How a camera's image differs from the scene: its exposure, and an overlay of its own vehicle.
//!
//! An overlay is part of the rig, as a PNG in the rig's JSON. So messages, manifests and recordings
//! contain it without any extra mechanism, and it is cropped and scaled together with its camera.

use std::io::Cursor;
use std::sync::Arc;

use data_encoding::BASE64;
use image::codecs::png::PngEncoder;
use image::imageops::{FilterType, resize};
use image::{ExtendedColorType, ImageEncoder, ImageFormat, ImageReader, Rgba, Rgba32FImage};
use wildcity_options::camera;

/// Per-camera changes to a rendered image: first the exposure, then the overlay.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Appearance {
    /// Affine colour transform; `None` leaves colours unchanged.
    pub exposure: Option<Exposure>,
    /// Image drawn over everything, such as the hood of the own vehicle.
    pub overlay: Option<Arc<Overlay>>,
}

/// An affine colour transform, `matrix * rgb + offset`, on linear red, green, blue. It is applied
/// after the sky and before the overlay. Street reconstructions train one per camera.
///
/// JSON: `{"matrix": [[..], [..], [..]], "offset": [..]}`, or `{"gain": [..], "offset": [..]}` for
/// a diagonal matrix. `offset` defaults to 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// 3 x 3, row by row.
    pub matrix: [[f64; 3]; 3],
    /// Added to each channel.
    pub offset: [f64; 3],
}

/// An image of the camera's size that is blended over the rendered image. JSON holds it as a PNG
/// with an alpha channel: `"data:image/png;base64,.."`.
#[derive(Clone, PartialEq, Eq)]
pub struct Overlay {
    width_px: u32,
    rgba8: Vec<u8>,
    /// The PNG as it was read, so that writing does not compress the pixels again.
    png: Vec<u8>,
}

/// An overlay whose header was read, and none of its pixels.
#[derive(Debug)]
pub struct UnreadOverlay {
    size_px: [u32; 2],
    png: Vec<u8>,
}

/// Why an appearance was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AppearanceError {
    /// An exposure coefficient outside -100 to 100.
    #[error("exposure.{field} is {value:?}; it must be a number from -100 to 100")]
    Exposure {
        /// The field: `matrix` or `offset`.
        field: &'static str,
        value: f64,
    },
    /// An exposure with both a matrix and a gain, or with neither.
    #[error("an exposure has either a matrix or a gain")]
    MatrixOrGain,
    /// The overlay and the camera's image differ in size.
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
    /// The overlay cannot be decoded, or has too many pixels.
    #[error("the overlay cannot be read: {reason}")]
    Overlay {
        /// The error in the overlay.
        reason: String,
    },
}

impl Exposure {
    /// An exposure from a matrix, or from a gain per channel.
    ///
    /// # Errors
    /// [`AppearanceError::MatrixOrGain`] if both a matrix and a gain are given, or neither.
    pub fn new(
        matrix: Option<[[f64; 3]; 3]>,
        gain: Option<[f64; 3]>,
        offset: [f64; 3],
    ) -> Result<Self, AppearanceError> {
        let matrix = match (matrix, gain) {
            (Some(matrix), None) => matrix,
            // Only a matrix is kept, so backends know one form of an exposure.
            (None, Some([r, g, b])) => [[r, 0.0, 0.0], [0.0, g, 0.0], [0.0, 0.0, b]],
            _ => return Err(AppearanceError::MatrixOrGain),
        };
        Ok(Self { matrix, offset })
    }

    /// Changes an image, `[height, width, 3]` in 8 bits, as the renderer changes its colours.
    pub fn change_rgb8(&self, rgb8: &mut [u8]) {
        for pixel in rgb8.chunks_exact_mut(3) {
            let before = [0, 1, 2].map(|channel| f64::from(pixel[channel]) / 255.0);
            for (channel, out) in pixel.iter_mut().enumerate() {
                let [r, g, b] = self.matrix[channel];
                let value = r * before[0] + g * before[1] + b * before[2] + self.offset[channel];
                *out = (255.0 * value.clamp(0.0, 1.0)).round() as u8;
            }
        }
    }
}

impl AppearanceError {
    /// The camera field at fault: `exposure` or `overlay`.
    pub fn field(&self) -> &'static str {
        match self {
            Self::Exposure { .. } | Self::MatrixOrGain => "exposure",
            Self::Size { .. } | Self::Overlay { .. } => "overlay",
        }
    }
}

impl Appearance {
    /// An appearance from an exposure and the data URI of an overlay.
    ///
    /// # Errors
    /// As [`Overlay::from_data_uri`].
    pub fn new(
        exposure: Option<camera::Exposure>,
        overlay: Option<&str>,
        camera_px: [u32; 2],
    ) -> Result<Self, AppearanceError> {
        let exposure = exposure.map(Exposure::try_from).transpose()?;
        let overlay = overlay.map(|text| Overlay::from_data_uri(text, camera_px)).transpose()?;
        Ok(Self { exposure, overlay: overlay.map(Arc::new) })
    }

    /// Whether images stay unchanged: neither exposure nor overlay.
    pub fn is_identity(&self) -> bool {
        self.exposure.is_none() && self.overlay.is_none()
    }

    /// Checks the appearance for a camera whose image has this width and height.
    ///
    /// # Errors
    /// An exposure coefficient is out of range, or the size of the overlay differs from that of the
    /// image.
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
    /// Limit of the pixels of all overlays of a rig together. 67 MB in memory: two 4K images, or
    /// twice the pixels of six surround cameras of 1440 x 928 px.
    pub const MAX_PIXELS: u64 = 1 << 24;

    /// Decodes a PNG for a camera's image of this width and height. The size in the PNG's header is
    /// compared before any pixel is decompressed.
    ///
    /// # Errors
    /// [`AppearanceError::Size`], [`AppearanceError::Overlay`].
    pub fn from_png(png: Vec<u8>, camera_px: [u32; 2]) -> Result<Self, AppearanceError> {
        UnreadOverlay::from_png(png, camera_px)?.decode()
    }

    /// Decodes `"data:image/png;base64,.."`, as [`Overlay::from_png`].
    ///
    /// # Errors
    /// As [`Overlay::from_png`].
    pub fn from_data_uri(text: &str, camera_px: [u32; 2]) -> Result<Self, AppearanceError> {
        UnreadOverlay::from_data_uri(text, camera_px)?.decode()
    }

    /// An overlay from pixels `[height, width, 4]`: red, green, blue (not premultiplied) and alpha.
    ///
    /// # Errors
    /// [`AppearanceError::Overlay`] if the bytes are not a whole number of rows, or too many.
    pub fn new(width_px: u32, rgba8: Vec<u8>) -> Result<Self, AppearanceError> {
        let row = 4 * width_px as usize;
        if rgba8.is_empty() || row == 0 || !rgba8.len().is_multiple_of(row) {
            return Err(refused("it is not a whole number of rows"));
        }
        check_pixels(rgba8.len() as u64 / 4)?;
        let mut png = Vec::new();
        let height_px = (rgba8.len() / row) as u32;
        PngEncoder::new(&mut png)
            .write_image(&rgba8, width_px, height_px, ExtendedColorType::Rgba8)
            .map_err(|error| refused(&error.to_string()))?;
        Ok(Self { width_px, rgba8, png })
    }

    /// The part of the overlay whose first column and row are `at_px`, resized to `size_px`.
    /// Shrinking filters with a triangle two output pixels wide, weighted by alpha. Sizes are
    /// `[width, height]`.
    ///
    /// # Errors
    /// [`AppearanceError::Overlay`] if the part is not within the overlay, or the result is too
    /// large.
    pub fn cropped_and_resized(
        &self,
        at_px: [u32; 2],
        part_px: [u32; 2],
        size_px: [u32; 2],
    ) -> Result<Self, AppearanceError> {
        let [left, top] = at_px;
        let [width, height] = self.size_px();
        let [part_width, part_height] = part_px;
        // Subtracts instead of adding: `from + part` could overflow for values near u32::MAX.
        let within = |from: u32, part: u32, of: u32| part > 0 && from <= of && part <= of - from;
        if !within(left, part_width, width) || !within(top, part_height, height) {
            let reason = "the part is not within the overlay";
            return Err(refused(&format!("{part_px:?} px at {left}, {top}: {reason}")));
        }
        let [to_width, to_height] = size_px;
        check_pixels(u64::from(to_width) * u64::from(to_height))?;
        // Without a change of size the bytes stay as they are: filtering would round colours of
        // half transparent pixels.
        if size_px == part_px {
            let row = |y: u32| {
                let at = 4 * ((top + y) as usize * width as usize + left as usize);
                &self.rgba8[at..at + 4 * part_width as usize]
            };
            return Self::new(to_width, (0..part_height).flat_map(row).copied().collect());
        }
        // Filter premultiplied colours: otherwise colours of transparent pixels leak into opaque
        // ones.
        let premultiplied = Rgba32FImage::from_fn(part_width, part_height, |x, y| {
            let at = 4 * ((top + y) as usize * width as usize + (left + x) as usize);
            let [r, g, b, a] = [0, 1, 2, 3].map(|c| f32::from(self.rgba8[at + c]) / 255.0);
            Rgba([r * a, g * a, b * a, a])
        });
        let resized = resize(&premultiplied, to_width, to_height, FilterType::Triangle);
        let unpremultiplied = |&Rgba([r, g, b, a]): &Rgba<f32>| {
            // A transparent pixel shows nothing, so its colour may be black.
            let scale = if a > 0.0 { 1.0 / a } else { 0.0 };
            let rgba = [r * scale, g * scale, b * scale, a];
            rgba.map(|value| (255.0 * value.clamp(0.0, 1.0)).round() as u8)
        };
        Self::new(to_width, resized.pixels().flat_map(unpremultiplied).collect())
    }

    /// Width and height, in pixels.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, (self.rgba8.len() / (4 * self.width_px as usize)) as u32]
    }

    /// The pixels, `[height, width, 4]`: red, green, blue (not premultiplied) and alpha.
    pub fn rgba8(&self) -> &[u8] {
        &self.rgba8
    }

    /// Memory of the pixels and the PNG, in bytes.
    pub fn bytes(&self) -> u64 {
        (self.rgba8.len() + self.png.len()) as u64
    }

    /// The PNG as `data:image/png;base64,..`, the form in JSON.
    pub fn to_data_uri(&self) -> String {
        format!("{DATA_URI}{}", BASE64.encode(&self.png))
    }
}

impl UnreadOverlay {
    /// Reads the header of a PNG for a camera's image of this width and height.
    ///
    /// # Errors
    /// As [`Overlay::from_png`], except for what is wrong with the pixels.
    pub fn from_png(png: Vec<u8>, camera_px: [u32; 2]) -> Result<Self, AppearanceError> {
        let reader = ImageReader::with_format(Cursor::new(&png[..]), ImageFormat::Png);
        let dimensions = reader.into_dimensions().map_err(|error| refused(&error.to_string()))?;
        let overlay_px = dimensions.into();
        if overlay_px != camera_px {
            return Err(AppearanceError::Size { overlay_px, camera_px });
        }
        check_pixels(pixels(overlay_px))?;
        Ok(Self { size_px: overlay_px, png })
    }

    /// Reads the header of `"data:image/png;base64,.."`.
    ///
    /// # Errors
    /// The text is no such URI, or as [`Self::from_png`].
    pub fn from_data_uri(text: &str, camera_px: [u32; 2]) -> Result<Self, AppearanceError> {
        let encoded = text
            .strip_prefix(DATA_URI)
            .ok_or_else(|| refused("it does not begin with data:image/png;base64,"))?;
        let png = BASE64.decode(encoded.as_bytes()).map_err(|_| refused("it is not base64"))?;
        Self::from_png(png, camera_px)
    }

    /// The number of its pixels.
    pub fn pixels(&self) -> u64 {
        pixels(self.size_px)
    }

    /// The most memory that decoding takes, in bytes: the file, its pixels of 8 bytes at most, and
    /// those of the overlay.
    pub fn decoding_bytes(&self) -> u64 {
        self.png.len() as u64 + 12 * self.pixels()
    }

    /// Decodes its pixels, which takes [`Self::decoding_bytes`].
    ///
    /// # Errors
    /// [`AppearanceError::Overlay`].
    pub fn decode(self) -> Result<Overlay, AppearanceError> {
        let Self { size_px: [width_px, _], png } = self;
        let reader = ImageReader::with_format(Cursor::new(&png[..]), ImageFormat::Png);
        let decoded = reader.decode().map_err(|error| refused(&error.to_string()))?;
        Ok(Overlay { width_px, rgba8: decoded.into_rgba8().into_raw(), png })
    }
}

fn pixels([width_px, height_px]: [u32; 2]) -> u64 {
    u64::from(width_px) * u64::from(height_px)
}

fn refused(reason: &str) -> AppearanceError {
    AppearanceError::Overlay { reason: reason.to_owned() }
}

fn check_pixels(pixels: u64) -> Result<(), AppearanceError> {
    let limit = Overlay::MAX_PIXELS;
    if pixels <= limit {
        Ok(())
    } else {
        Err(refused(&format!("it has {pixels} pixels; at most {limit} are accepted")))
    }
}

impl std::fmt::Debug for Overlay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Overlay").field("size_px", &self.size_px()).finish_non_exhaustive()
    }
}

impl TryFrom<camera::Exposure> for Exposure {
    type Error = AppearanceError;

    fn try_from(fields: camera::Exposure) -> Result<Self, AppearanceError> {
        Self::new(fields.matrix, fields.gain, fields.offset)
    }
}

impl From<Exposure> for camera::Exposure {
    fn from(Exposure { matrix, offset }: Exposure) -> Self {
        // A gain was made a matrix as it was read, so answers and files always have the matrix.
        Self { matrix: Some(matrix), gain: None, offset }
    }
}

/// Prefix of an overlay in JSON.
const DATA_URI: &str = "data:image/png;base64,";

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_options::strict;

    #[test]
    fn an_exposure_changes_the_colours_of_an_image() {
        let swap = Exposure {
            matrix: [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]],
            offset: [0.2, 0.0, 0.0],
        };
        let mut rgb8 = [10, 100, 60, 0, 255, 200];
        swap.change_rgb8(&mut rgb8);
        // Red of the first pixel: 100 + 0.2 * 255 = 151. Its blue: 2 * 60 = 120. Red of the second:
        // 255 + 51 is clamped to 255; its blue: 400 is, too.
        assert_eq!(rgb8, [151, 10, 120, 255, 0, 255]);
    }

    #[test]
    fn json_round_trips() {
        let overlay = Overlay::new(3, (0..24).collect()).unwrap();
        let text = overlay.to_data_uri();
        assert!(text.starts_with("data:image/png;base64,iVBOR"), "{text}");
        assert_eq!(Overlay::from_data_uri(&text, [3, 2]).unwrap(), overlay);
        let gain = r#"{"gain": [2, 3, 4]}"#;
        let exposure = read(gain).unwrap();
        assert_eq!(exposure.matrix, [[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]]);
        assert_eq!(exposure.offset, [0.0; 3]);
        let text = serde_json::to_string(&camera::Exposure::from(exposure)).unwrap();
        assert_eq!(read(&text), Ok(exposure));
    }

    /// An exposure of a rig file.
    fn read(text: &str) -> Result<Exposure, String> {
        let fields = strict::deserialize(&mut serde_json::Deserializer::from_str(text));
        let fields: camera::Exposure = fields.map_err(|error| error.to_string())?;
        Exposure::try_from(fields).map_err(|error| error.to_string())
    }

    #[test]
    fn invalid_appearances_are_refused() {
        for exposure in [r#"{"offset": [1, 2, 3]}"#, r#"{"gain": [1, 1]}"#, r#"{"gamma": 2}"#] {
            assert!(read(exposure).is_err(), "{exposure}");
        }
        // Even an unknown field that says nothing is refused, and a known one is not.
        assert!(read(r#"{"gain": [1, 1, 1], "matrix": null}"#).is_ok());
        for absent in ["null", "[]", "{}"] {
            let error = read(&format!(r#"{{"gain": [1, 1, 1], "gamma": {absent}}}"#)).unwrap_err();
            assert!(error.contains("unknown field `gamma`"), "{error}");
        }
        let both = r#"{"gain": [1, 1, 1], "matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"#;
        let error = read(both).unwrap_err();
        assert!(error.contains("either a matrix or a gain"), "{error}");
        for (overlay, wanted) in [
            ("hood.png", "does not begin with data:image/png;base64,"),
            ("data:image/png;base64,%%%", "it is not base64"),
            ("data:image/png;base64,aGVsbG8=", "the overlay cannot be read"),
        ] {
            let error = Overlay::from_data_uri(overlay, [3, 2]).unwrap_err().to_string();
            assert!(error.contains(wanted), "{error}");
        }
        let small = Overlay::new(3, vec![9; 24]).unwrap().to_data_uri();
        let size = AppearanceError::Size { overlay_px: [3, 2], camera_px: [2, 3] };
        assert_eq!(Overlay::from_data_uri(&small, [2, 3]), Err(size));
        // A PNG whose header declares 100,000 x 100,000 pixels.
        let mut png = Overlay::new(1, vec![0; 4]).unwrap().png;
        // Bytes 16 to 23 of a PNG are width and height in the IHDR chunk, most significant byte
        // first: 0x000186A0 is 100,000.
        png[16..24].copy_from_slice(&[0, 1, 0x86, 0xA0, 0, 1, 0x86, 0xA0]);
        assert!(Overlay::from_png(png, [100_000; 2]).is_err());
    }

    #[test]
    fn a_crop_keeps_its_pixels_and_shrinking_is_weighted_by_alpha() {
        // Four columns: transparent, half transparent, and two opaque ones; all rows are the same.
        let row = [[200, 0, 0, 0], [0, 100, 0, 128], [10, 20, 30, 255], [50, 60, 70, 255]];
        let overlay = Overlay::new(4, [row; 4].as_flattened().as_flattened().to_vec()).unwrap();
        assert_eq!(overlay.cropped_and_resized([0, 0], [4, 4], [4, 4]).unwrap(), overlay);
        let right = overlay.cropped_and_resized([2, 1], [2, 3], [2, 3]).unwrap();
        assert_eq!(right.size_px(), [2, 3]);
        assert_eq!(right.rgba8()[..8], [10, 20, 30, 255, 50, 60, 70, 255]);
        // The colour of the transparent column does not show.
        let small = overlay.cropped_and_resized([0, 0], [4, 4], [2, 2]).unwrap();
        for pixel in small.rgba8().chunks(4).step_by(2) {
            assert!(pixel[0] <= 5 && pixel[1] > 50 && (30..120).contains(&pixel[3]), "{pixel:?}");
        }
        for (at, part) in [([3, 0], [2, 1]), ([0, 0], [0, 1]), ([u32::MAX, 0], [1, 1])] {
            assert!(overlay.cropped_and_resized(at, part, [1, 1]).is_err(), "{at:?} {part:?}");
        }
        assert!(
            overlay.cropped_and_resized([0, 0], [1, 1], [1 << 13, 1 << 12]).is_err(),
            "too large"
        );
    }
}
