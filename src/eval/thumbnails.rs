//! Small pictures of a pair for the page: the real image, the rendered one, and the map of their
//! errors.

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{ImageFormat, RgbImage};

use super::pair::Pair;
use wildcity_render::compare::heat::{HEAT_RGB, heat_rgb};

/// Largest width of a picture on the page, in pixels. Three of them and their gaps are a page wide.
const WIDTH_PX: u32 = 480;
/// JPEG quality of the pictures on the page.
const JPEG_QUALITY: u8 = 88;

/// Colour of pixels that do not count, in maps of errors.
const UNCOUNTED_RGB: [u8; 3] = [120, 120, 120];

/// JPEG files of at most 480 px of width.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Thumbnails {
    /// The real image, the rendered one, and the map of their errors.
    pub files: [Vec<u8>; 3],
    /// The repaired image, and the map of its errors, if there is one.
    pub repaired: Option<[Vec<u8>; 2]>,
}

impl Thumbnails {
    /// Shrinks and encodes the pictures of a pair.
    ///
    /// # Errors
    /// The encoder's message.
    pub fn from_pair(pair: &Pair, error_map: &[f32]) -> Result<Self, String> {
        let size_px = pair.size_px();
        let files = [
            jpeg(pair.truth(), size_px)?,
            jpeg(pair.rendered(), size_px)?,
            jpeg(&colors(pair, error_map), size_px)?,
        ];
        Ok(Self { files, repaired: None })
    }

    /// Adds the pictures of the repaired image, which is in its own pair.
    ///
    /// # Errors
    /// The encoder's message.
    pub fn with_repaired(mut self, pair: &Pair, error_map: &[f32]) -> Result<Self, String> {
        let size_px = pair.size_px();
        let errors = jpeg(&colors(pair, error_map), size_px)?;
        self.repaired = Some([jpeg(pair.rendered(), size_px)?, errors]);
        Ok(self)
    }
}

/// A picture, `[height, width, 3]`, as a JPEG file of at most 480 px of width.
///
/// # Errors
/// The encoder's message.
pub fn jpeg(rgb8: &[u8], size_px: [u32; 2]) -> Result<Vec<u8>, String> {
    let picture = picture(rgb8.to_vec(), size_px)?;
    let small = if picture.width() > WIDTH_PX {
        // Rounded up, so that a very wide picture has a height of at least 1.
        let height = (picture.height() * WIDTH_PX).div_ceil(picture.width());
        imageops::resize(&picture, WIDTH_PX, height, FilterType::Triangle)
    } else {
        picture
    };
    let mut file = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY);
    small.write_with_encoder(encoder).map_err(|error| error.to_string())?;
    Ok(file)
}

/// The map of a pair's errors as a PNG file in full size.
///
/// # Errors
/// The encoder's message.
pub fn error_png(pair: &Pair, error_map: &[f32]) -> Result<Vec<u8>, String> {
    let mut file = Cursor::new(Vec::new());
    let picture = picture(colors(pair, error_map), pair.size_px())?;
    picture.write_to(&mut file, ImageFormat::Png).map_err(|error| error.to_string())?;
    Ok(file.into_inner())
}

/// Errors from 0 to 1 as colours; grey where pixels do not count.
fn colors(pair: &Pair, error_map: &[f32]) -> Vec<u8> {
    // `heat_rgb` takes a position in the table of colours.
    let last = (HEAT_RGB.len() - 1) as f32;
    let color = |(pixel, error): (usize, &f32)| {
        if pair.is_counted(pixel) { heat_rgb(last * error) } else { UNCOUNTED_RGB }
    };
    error_map.iter().enumerate().flat_map(color).collect()
}

fn picture(rgb8: Vec<u8>, [width, height]: [u32; 2]) -> Result<RgbImage, String> {
    RgbImage::from_raw(width, height, rgb8).ok_or_else(|| "the picture has another size".to_owned())
}
