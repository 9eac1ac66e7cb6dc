//! WebP images with numbers as pixels.

use std::io::Cursor;

use image_webp::WebPDecoder;

use crate::ingest::IngestError;
use crate::ingest::unpack_budget::UnpackBudget;
use wildcity_scene::sh;

use super::{FORMAT, body};

/// A file of the scene, which is named in errors.
pub(super) struct NamedFile {
    pub(super) name: String,
    pub(super) bytes: Vec<u8>,
}

/// The pixels of a decoded WebP file, row by row.
pub(super) struct Image {
    bytes: Vec<u8>,
    /// Bytes of a pixel: 3, or 4 with alpha.
    channels: usize,
    size_px: [usize; 2],
}

impl Image {
    /// Decodes a named image of at least `count` pixels.
    pub(super) fn decode(
        NamedFile { name, bytes: file }: NamedFile,
        count: usize,
        budget: &mut UnpackBudget,
    ) -> Result<Self, IngestError> {
        // The decoder would accept a truncated file.
        let promised = match file.as_slice() {
            [b'R', b'I', b'F', b'F', a, b, c, d, ..] => {
                8 + u64::from(u32::from_le_bytes([*a, *b, *c, *d]))
            }
            _ => 0,
        };
        let held = file.len() as u64;
        if promised > held {
            let reason = format!("it has {held} of {promised} bytes: it is truncated");
            return Err(body(&name, reason));
        }
        let damaged = |e| body(&name, format!("is a damaged WebP image: {e}; copy it again"));
        let mut decoder = WebPDecoder::new(Cursor::new(file)).map_err(damaged)?;
        if decoder.is_lossy() {
            return Err(body(
                &name,
                "is lossy, which would change the numbers; encode it lossless".into(),
            ));
        }
        let (width_px, height_px) = decoder.dimensions();
        let size_px = [width_px as usize, height_px as usize];
        let pixels = u128::from(width_px) * u128::from(height_px);
        if pixels < count as u128 {
            let reason = format!("{width_px}x{height_px} pixels for {count} Gaussians");
            return Err(body(&name, reason));
        }
        // The decoder uses four bytes per pixel, with or without alpha.
        budget.unpack(FORMAT, &name, 4 * pixels)?;
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut bytes = vec![0; channels * size_px[0] * size_px[1]];
        decoder.read_image(&mut bytes).map_err(damaged)?;
        Ok(Self { bytes, channels, size_px })
    }

    /// The first `count` pixels.
    pub(super) fn pixels(&self, count: usize) -> impl Iterator<Item = [u8; 4]> {
        self.bytes.chunks_exact(self.channels).take(count).map(|pixel| {
            let alpha = pixel.get(3).copied().unwrap_or(255);
            [pixel[0], pixel[1], pixel[2], alpha]
        })
    }
}

/// The palette of higher SH degrees. Labels are indices of its entries.
pub(super) struct Palette {
    image: Image,
    pub(super) sh_degree: u8,
    /// Pixels of an entry: one per coefficient above degree 0.
    coefficients: usize,
    entries: usize,
}

/// Entries in a row of the image.
const ENTRIES_PER_ROW: usize = 64;

impl Palette {
    /// Decodes an image, and checks its number of entries and its degree where they are known. Its
    /// width implies the degree, too.
    pub(super) fn decode(
        file: NamedFile,
        entries: Option<u64>,
        bands: Option<u8>,
        budget: &mut UnpackBudget,
    ) -> Result<Self, IngestError> {
        let name = file.name.clone();
        // Its pixels are entries and not Gaussians: their number is checked below.
        let image = Image::decode(file, 0, budget)?;
        let [width_px, height_px] = image.size_px;
        let wide = |d: &u8| ENTRIES_PER_ROW * (sh::coefficients(*d) - 1) == width_px;
        let degree = (1..=sh::MAX_DEGREE).find(wide).filter(|d| bands.is_none_or(|b| b == *d));
        let Some(sh_degree) = degree else {
            let bands = bands.map_or(String::new(), |bands| format!(" for {bands} bands"));
            let reason =
                format!("is {width_px} pixels wide{bands}; 1, 2, 3 bands have 192, 512, 960");
            return Err(body(&name, reason));
        };
        let held = ENTRIES_PER_ROW * height_px;
        let entries = entries.unwrap_or(held as u64);
        if entries > held as u64 {
            return Err(body(&name, format!("has room for {held} entries, not for {entries}")));
        }
        let coefficients = sh::coefficients(sh_degree) - 1;
        Ok(Self { image, sh_degree, coefficients, entries: entries as usize })
    }

    /// The bytes of an entry: coefficient-major, then red, green, blue.
    pub(super) fn entry(&self, label: u16) -> Option<impl Iterator<Item = u8>> {
        let label = usize::from(label);
        let stride = self.image.channels;
        if label >= self.entries {
            return None;
        }
        // 64 entries fill a row exactly, so that each entry is one run of pixels.
        let start = label * self.coefficients * stride;
        let pixels = &self.image.bytes[start..start + self.coefficients * stride];
        Some(pixels.chunks_exact(stride).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]))
    }
}
