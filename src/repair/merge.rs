//! Converts the output of the model to an image of 8 bits.

use crate::image::{Image, View};
use crate::manifest::{Manifest, Merge, OutputRole};
use crate::planes::Planes;
use crate::resample::{Kernel, resample};
use crate::roles;

/// The image. `seen` is the image that the model got, and `output` what it returned; both are free
/// of padding, and smaller or larger than the image if the fit is `resize`.
pub(crate) fn merge(manifest: &Manifest, view: &View<'_>, seen: Planes, output: Planes) -> Image {
    let role = manifest.output().role;
    let scale = manifest.output().scale as usize;
    let range = manifest.output().range;
    let height = view.rendered.height * scale;
    let width = view.rendered.width * scale;
    // From here on values are 0 to 255 in f32, whatever the range of the model.
    let rendered = roles::rgb(view.rendered);
    let merged = if manifest.merge == Merge::Residual {
        let difference = match role {
            // A difference has no black: it is scaled and not shifted.
            OutputRole::Residual => output.map(|value| value / (range[1] - range[0]) * 255.0),
            OutputRole::Rgb | OutputRole::Luma => {
                let mut difference = roles::out_of_range(output, range);
                let seen = roles::out_of_range(seen, manifest.image_input().range);
                // Both have the size that the model saw. The difference is taken before it is
                // resampled, so that a model that changes nothing adds exact zeros.
                let values = difference.values.iter_mut().zip(&seen.values);
                values.for_each(|(value, seen)| *value -= seen);
                difference
            }
        };
        added(&rendered, &resample(&difference, height, width, Kernel::Lanczos3))
    } else {
        let output = resample(&roles::out_of_range(output, range), height, width, Kernel::Lanczos3);
        match role {
            OutputRole::Luma => {
                // Chroma as colour minus luma: that is linear, so it can be resampled without a
                // matrix.
                let mut chroma = rendered.clone();
                let luma = roles::luma(&rendered);
                for channel in 0..3 {
                    for y in 0..chroma.height {
                        let values = chroma.row_mut(channel, y).iter_mut().zip(luma.row(0, y));
                        values.for_each(|(value, luma)| *value -= luma);
                    }
                }
                added(&resample(&chroma, height, width, Kernel::Bicubic), &output)
            }
            OutputRole::Rgb | OutputRole::Residual => output,
        }
    };
    image(&merged, view.mask, scale)
}

/// The sum; planes of one channel are added to each.
fn added(planes: &Planes, more: &Planes) -> Planes {
    let mut sum = planes.clone();
    for channel in 0..sum.channels {
        for y in 0..sum.height {
            // A plane of one channel is its own last channel.
            let more = more.row(channel.min(more.channels - 1), y);
            sum.row_mut(channel, y).iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
        }
    }
    sum
}

/// 0 to 255, clamped and rounded; black outside the mask.
fn image(planes: &Planes, mask: Option<&[f32]>, scale: usize) -> Image {
    let mut rgb8 = Vec::with_capacity(3 * planes.height * planes.width);
    let source_width = planes.width / scale;
    for y in 0..planes.height {
        for x in 0..planes.width {
            let is_inside =
                // The mask has the size of the rendered image, and the output `scale` times that.
                mask.is_none_or(|mask| mask[y / scale * source_width + x / scale] > 0.0);
            for channel in 0..3 {
                let value = if is_inside { planes.at(channel, y, x) } else { 0.0 };
                // The cast saturates: this is the clamp to 0 to 255.
                rgb8.push(value.round() as u8);
            }
        }
    }
    Image { width: planes.width, height: planes.height, rgb8 }
}
