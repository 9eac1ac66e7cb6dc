//! The size in which a model sees an image: padded, resampled, or as it is.

use crate::error::RepairError;
use crate::limits::MAX_SIDE_PX;
use crate::manifest::{Dtype, Fit, Size};
use crate::planes::{Planes, Rect};
use crate::resample::{Kernel, resample};

/// The size in which the model sees an image.
pub(crate) struct Fitted {
    /// The size that the model gets.
    pub(crate) height: usize,
    pub(crate) width: usize,
    /// The part of it that is the image; the rest is padding.
    pub(crate) content: Rect,
    is_resized: bool,
}

impl Fitted {
    /// The size for an image of a height and a width.
    pub(crate) fn new(size: &Size, [height, width]: [usize; 2]) -> Result<Fitted, RepairError> {
        let fixed = size.fixed.map(|sides| sides.map(|side| side as usize));
        let multiple = size.multiple();
        if size.fit == Fit::Resize {
            let [height, width] = fixed.unwrap_or_else(|| {
                // `check_size` has made sure that there is a number.
                let pixels = f64::from(size.pixels.unwrap_or(1));
                resized([height, width], pixels, multiple)
            });
            let content = Rect { top: 0, left: 0, height, width };
            return Ok(Fitted { height, width, content, is_resized: true });
        }
        let up = |side: usize| side.next_multiple_of(multiple);
        let padded = match (fixed, size.fit) {
            // Tiles have the fixed size, so the image must have at least that.
            (Some([h, w]), Fit::Tile) => [height.max(h), width.max(w)],
            (Some([h, w]), _) if height > h || width > w => {
                let message = format!(
                    "{width} x {height} px; size.fixed with \"fit\": \"pad\" takes at most {w} x {h}; use \"tile\" or \
                     \"resize\""
                );
                return Err(RepairError::Input { field: "image".to_owned(), message });
            }
            (Some(sides), _) => sides,
            (None, _) => [up(height), up(width)],
        };
        let content = Rect { top: 0, left: 0, height, width };
        Ok(Fitted { height: padded[0], width: padded[1], content, is_resized: false })
    }

    /// Planes of the image as the model gets them.
    pub(crate) fn fit(&self, planes: Planes, dtype: Dtype) -> Planes {
        let fitted = if self.is_resized {
            resample(&planes, self.height, self.width, Kernel::Lanczos3)
        } else {
            planes.padded(self.height, self.width)
        };
        // Rounded here, so that a residual is relative to the values that the model got.
        if dtype == Dtype::F16 { fitted.rounded_to_f16() } else { fitted }
    }
}

/// The multiples of `multiple` nearest to an image's aspect ratio, with about `pixels` pixels.
fn resized([height, width]: [usize; 2], pixels: f64, multiple: usize) -> [usize; 2] {
    // By how much both sides are scaled: pixels = (ratio height)(ratio width).
    let ratio = (pixels / (height as f64 * width as f64)).sqrt();
    // At least 64 multiples, since a multiple is at most 256 px.
    let largest = MAX_SIDE_PX / multiple;
    [height, width].map(|side| {
        let multiples = (side as f64 * ratio / multiple as f64).round() as usize;
        // A very long and low image keeps at least one multiple in height, and then has
        // another ratio.
        multiples.clamp(1, largest) * multiple
    })
}
