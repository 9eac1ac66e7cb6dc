//! An image, what it should be, and a map of how far off it is, as PNG.

use super::ReportError;
use wildcity_render::compare::errors::Image;

/// Where a setting is worst.
#[derive(Clone, Debug, Default)]
pub struct ErrorImages {
    /// The place.
    pub place: String,
    /// Width and height of each picture, in pixels.
    pub size_px: [u32; 2],
    /// PNG files: what was drawn, what it should be, and the error.
    pub files: [Vec<u8>; 3],
}

/// Errors at the colours of [`heat`]: black below the first, white from the last. Steps of four, from a
/// quarter of a step of 8 bits.
pub(super) const HEAT_STEPS: [f32; 6] = [1e-3, 4e-3, 1.6e-2, 6.4e-2, 0.256, 1.0];

/// From dark to light, so that it reads without colours too.
pub(super) const HEAT_RGB: [[u8; 3]; 6] =
    [[0, 0, 0], [52, 15, 92], [140, 32, 110], [215, 76, 60], [250, 160, 40], [252, 253, 191]];

/// # Errors
/// A picture cannot be encoded.
pub(super) fn of(place: String, image: &Image, truth: &Image) -> Result<ErrorImages, ReportError> {
    let [width, height] = image.size_px;
    let png = |rgb8: Vec<u8>| {
        wildcity_session::png(&rgb8, width, height).map_err(|reason| ReportError::Encode { reason })
    };
    let bytes = |image: &Image| image.rgb.iter().map(|v| (255.0 * v).round() as u8).collect();
    let off = image.rgb.chunks_exact(3).zip(truth.rgb.chunks_exact(3)).flat_map(|(a, b)| {
        let off = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        heat(off.fold(0.0, f32::max))
    });
    let files = [png(bytes(image))?, png(bytes(truth))?, png(off.collect())?];
    Ok(ErrorImages { place, size_px: image.size_px, files })
}

/// The colour of an error.
fn heat(off: f32) -> [u8; 3] {
    let above = HEAT_STEPS.iter().rposition(|step| off >= *step);
    let Some(below) = above else { return HEAT_RGB[0] };
    let Some(next) = HEAT_STEPS.get(below + 1) else { return HEAT_RGB[below] };
    let share = (off / HEAT_STEPS[below]).ln() / (next / HEAT_STEPS[below]).ln();
    let mix = |c: usize| {
        let (low, high) = (f32::from(HEAT_RGB[below][c]), f32::from(HEAT_RGB[below + 1][c]));
        (low + share * (high - low)).round() as u8
    };
    [0, 1, 2].map(mix)
}
