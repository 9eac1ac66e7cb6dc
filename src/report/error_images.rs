//! A rendered window, the reference, and a map of the error between them, as PNG files.

use super::error::ReportError;
use wildcity_render::compare::errors::Image;
use wildcity_render::compare::heat::{HEAT_RGB, heat_rgb};

/// The window in which a setting has its largest error.
#[derive(Clone, Debug, Default)]
pub struct ErrorImages {
    /// Name of the sample point.
    pub sample_point: String,
    /// Width and height of each image, in pixels.
    pub size_px: [u32; 2],
    /// PNG files: as rendered, the reference, and the error map.
    pub files: [Vec<u8>; 3],
}

/// Errors that have the colours of [`HEAT_RGB`], in colour values from 0 to 1: below the first it
/// is black, from the last on white. Steps of a factor of four, from a quarter of a step of 8 bits.
pub(super) const HEAT_STEPS: [f32; 6] = [1e-3, 4e-3, 1.6e-2, 6.4e-2, 0.256, 1.0];

impl ErrorImages {
    /// Encodes an image and its reference, which has the same size, with the map of their error.
    ///
    /// # Errors
    /// A PNG file cannot be encoded.
    pub(super) fn new(
        sample_point: String,
        image: &Image,
        reference: &Image,
    ) -> Result<Self, ReportError> {
        let [width, height] = image.size_px;
        let png = |rgb8: Vec<u8>| {
            let file = wildcity_session::png(&rgb8, width, height);
            file.map_err(|reason| ReportError::Encode { reason })
        };
        // The images are displayed ones, clamped to 0 to 1 already.
        let rgb8_of = |image: &Image| -> Vec<u8> {
            image.rgb.iter().map(|value| (255.0 * value).round() as u8).collect()
        };
        // The error of a pixel is the largest of its three channels.
        let pixels = image.rgb.chunks_exact(3).zip(reference.rgb.chunks_exact(3));
        let error_map = pixels.flat_map(|(own, expected)| {
            let errors = own.iter().zip(expected).map(|(a, b)| (a - b).abs());
            heat(errors.fold(0.0, f32::max))
        });
        let files = [png(rgb8_of(image))?, png(rgb8_of(reference))?, png(error_map.collect())?];
        Ok(Self { sample_point, size_px: image.size_px, files })
    }
}

/// The colour of an error: interpolated between [`HEAT_RGB`] by the error's logarithm.
fn heat(error: f32) -> [u8; 3] {
    // The last step that the error reaches. A NaN reaches none, and is black.
    let Some(low) = HEAT_STEPS.iter().rposition(|step| error >= *step) else { return HEAT_RGB[0] };
    let Some(next_step) = HEAT_STEPS.get(low + 1) else { return HEAT_RGB[low] };
    // The steps are powers of four, so that the colour is linear in the logarithm within each.
    let share = (error / HEAT_STEPS[low]).ln() / (next_step / HEAT_STEPS[low]).ln();
    heat_rgb(low as f32 + share)
}
