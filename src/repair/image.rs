//! Images, and the maps that a model gets in addition to one.

use crate::error::RepairError;
use crate::limits::MAX_SIDE_PX;

/// An image: rows from the top, RGB, 8 bits, sRGB.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    pub width: usize,
    pub height: usize,
    /// `3 * width * height` bytes.
    pub rgb8: Vec<u8>,
}

impl Image {
    /// BLAKE3 of the bytes, as sessions hash images.
    pub fn hash(&self) -> blake3::Hash {
        blake3::hash(&self.rgb8)
    }
}

/// A rendered image and its maps. A field is needed if the manifest has its role. All have the size
/// of `rendered`; planes are row by row.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The image to repair. Role `rgb` or `luma`.
    pub rendered: &'a Image,
    /// A recorded image from nearby.
    pub reference: Option<&'a Image>,
    /// Recorded images, warped into this view.
    pub reference_warped: Option<&'a Image>,
    /// 1 where `reference_warped` has a value, else 0.
    pub reference_valid: Option<&'a [f32]>,
    /// Distance along the camera's axis in metres; 0 or less means none.
    pub depth_m: Option<&'a [f32]>,
    /// Accumulated opacity, from 0 to 1.
    pub opacity: Option<&'a [f32]>,
    /// Unit vectors in the camera's axes: all x, all y, all z.
    pub normals: Option<&'a [f32]>,
    /// 1 within the field of the lens, 0 outside. The repaired image is black outside.
    pub mask: Option<&'a [f32]>,
    /// Trust of the whole image, from 0 to 1.
    pub trust: Option<f32>,
}

impl<'a> View<'a> {
    /// An image without maps.
    pub fn new(rendered: &'a Image) -> Self {
        View {
            rendered,
            reference: None,
            reference_warped: None,
            reference_valid: None,
            depth_m: None,
            opacity: None,
            normals: None,
            mask: None,
            trust: None,
        }
    }

    /// Checks sizes and values.
    pub(crate) fn check(&self) -> Result<(), RepairError> {
        let width = self.rendered.width;
        let height = self.rendered.height;
        if !(1..=MAX_SIDE_PX).contains(&width) || !(1..=MAX_SIDE_PX).contains(&height) {
            let message = format!("{width} x {height} px; each side must be 1 to {MAX_SIDE_PX}");
            return Err(RepairError::Input { field: "image".to_owned(), message });
        }
        let pixels = width * height;
        let images = [
            ("image", Some(self.rendered)),
            ("reference", self.reference),
            ("reference_warped", self.reference_warped),
        ];
        // Before the maps, whose lengths are compared with the size of the image.
        for (field, image) in images {
            let Some(image) = image else { continue };
            let is_equal = image.width == width && image.height == height;
            if !is_equal || image.rgb8.len() != 3 * pixels {
                let Image { width: w, height: h, rgb8 } = image;
                let message = format!(
                    "{w} x {h} px in {} bytes; {width} x {height} px in {} bytes are needed",
                    rgb8.len(),
                    3 * pixels
                );
                return Err(RepairError::Input { field: field.to_owned(), message });
            }
        }
        let planes = [
            ("reference_valid", self.reference_valid, 1),
            ("depth", self.depth_m, 1),
            ("opacity", self.opacity, 1),
            ("normals", self.normals, 3),
            ("mask", self.mask, 1),
            ("trust", self.trust.as_ref().map(std::slice::from_ref), 0),
        ];
        for (field, values, channels) in planes {
            let Some(values) = values else { continue };
            // 0 stands for a single value.
            let wanted = if channels == 0 { 1 } else { channels * pixels };
            if values.len() != wanted {
                let message = format!("{} values; {wanted} are needed", values.len());
                return Err(RepairError::Input { field: field.to_owned(), message });
            }
            // A NaN would spread over the output, and be reported as the model's own.
            if let Some(at) = values.iter().position(|value| !value.is_finite()) {
                let message = format!("value {at} is {}; give finite values", values[at]);
                return Err(RepairError::Input { field: field.to_owned(), message });
            }
        }
        Ok(())
    }
}
