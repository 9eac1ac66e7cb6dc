//! The data of each role: planes of a view in the range of the model.

use crate::error::RepairError;
use crate::image::{Image, View};
use crate::manifest::{Input, InputRole, Unit};
use crate::planes::Planes;

/// The planes of an input that has pixels, in the range of the model.
pub(crate) fn planes(view: &View<'_>, input: &Input) -> Result<Planes, RepairError> {
    let missing = || RepairError::Input {
        field: input.role.name().to_owned(),
        message: "missing; the manifest has this role".to_owned(),
    };
    let size = [view.rendered.height, view.rendered.width];
    let raw = |values: Option<&[f32]>, channels| plain(values.ok_or_else(missing)?, channels, size);
    match input.role {
        InputRole::Rgb => Ok(in_range(rgb(view.rendered), input.range)),
        InputRole::Luma => Ok(in_range(luma(&rgb(view.rendered)), input.range)),
        InputRole::Reference => Ok(in_range(rgb(view.reference.ok_or_else(missing)?), input.range)),
        InputRole::ReferenceWarped => {
            Ok(in_range(rgb(view.reference_warped.ok_or_else(missing)?), input.range))
        }
        InputRole::ReferenceValid => raw(view.reference_valid, 1),
        InputRole::Opacity => raw(view.opacity, 1),
        InputRole::Normals => raw(view.normals, 3),
        InputRole::Mask => raw(view.mask, 1),
        InputRole::Depth => Ok(depth(raw(view.depth_m, 1)?, input.unit)),
        InputRole::Trust | InputRole::Constant => Ok(Planes::zeros(0, size[0], size[1])),
    }
}

/// The value of an input without pixels.
pub(crate) fn scalar(view: &View<'_>, input: &Input) -> Result<f32, RepairError> {
    match input.role {
        InputRole::Trust => view.trust.ok_or_else(|| RepairError::Input {
            field: "trust".to_owned(),
            message: "missing; the manifest has this role".to_owned(),
        }),
        _ => Ok(input.value.unwrap_or_default() as f32),
    }
}

/// Planes of 0 to 255.
pub(crate) fn rgb(image: &Image) -> Planes {
    let mut planes = Planes::zeros(3, image.height, image.width);
    let pixels = image.width * image.height;
    for (at, pixel) in image.rgb8.chunks_exact(3).enumerate() {
        for (channel, &value) in pixel.iter().enumerate() {
            // From interleaved to planar.
            planes.values[channel * pixels + at] = f32::from(value);
        }
    }
    planes
}

/// Luma of RGB: 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601).
pub(crate) fn luma(rgb: &Planes) -> Planes {
    let pixels = rgb.width * rgb.height;
    let mut luma = Planes::zeros(1, rgb.height, rgb.width);
    for (at, value) in luma.values.iter_mut().enumerate() {
        let [r, g, b] = [0, 1, 2].map(|channel| rgb.values[channel * pixels + at]);
        *value = 0.299 * r + 0.587 * g + 0.114 * b;
    }
    luma
}

/// Converts 0 to 255 to the model's range.
pub(crate) fn in_range(planes: Planes, [black, white]: [f32; 2]) -> Planes {
    // 0 becomes black and 255 white; black may be the larger one.
    planes.map(|value| black + value / 255.0 * (white - black))
}

/// Converts the model's range to 0 to 255.
pub(crate) fn out_of_range(planes: Planes, [black, white]: [f32; 2]) -> Planes {
    planes.map(|value| (value - black) / (white - black) * 255.0)
}

fn plain(
    values: &[f32],
    channels: usize,
    [height, width]: [usize; 2],
) -> Result<Planes, RepairError> {
    Ok(Planes { channels, height, width, values: values.to_vec() })
}

/// The depth where there is one, else 0.
fn depth(metres: Planes, unit: Unit) -> Planes {
    match unit {
        Unit::Metre => metres.map(|depth| depth.max(0.0)),
        // 0 stands for no surface, which is also that of an infinite distance.
        Unit::Inverse => metres.map(|depth| if depth > 0.0 { depth.recip() } else { 0.0 }),
    }
}
