//! A real image and the rendered one.

/// A real image and the rendered one, both of sRGB in 8 bits, `[height, width, 3]`.
#[derive(Clone, Debug)]
pub struct Pair {
    size_px: [u32; 2],
    truth: Vec<u8>,
    rendered: Vec<u8>,
    counts: Option<Vec<bool>>,
}

/// Why two images cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PairError {
    /// The number of values of an image does not match its size.
    #[error("the {what} has {values} values, but {width} x {height} px have {expected}")]
    Size {
        /// `real image`, `rendered image` or `mask`.
        what: &'static str,
        /// Its number of values.
        values: usize,
        width: u32,
        height: u32,
        /// The number that it should have.
        expected: usize,
    },
}

impl Pair {
    /// Combines two images of one size. `counts` marks the pixels that are compared; all without
    /// it.
    ///
    /// # Errors
    /// [`PairError::Size`].
    pub fn new(
        size_px: [u32; 2],
        truth: Vec<u8>,
        rendered: Vec<u8>,
        counts: Option<Vec<bool>>,
    ) -> Result<Self, PairError> {
        let [width, height] = size_px;
        let pixels = width as usize * height as usize;
        // No mask has the right size by definition.
        let masked = counts.as_ref().map_or(pixels, Vec::len);
        for (what, values, expected) in [
            ("real image", truth.len(), 3 * pixels),
            ("rendered image", rendered.len(), 3 * pixels),
            ("mask", masked, pixels),
        ] {
            if values != expected {
                return Err(PairError::Size { what, values, width, height, expected });
            }
        }
        // A mask that hides no pixel is dropped.
        let counts = counts.filter(|counts| counts.contains(&false));
        Ok(Self { size_px, truth, rendered, counts })
    }

    /// Width and height, in pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// The real image, `[height, width, 3]`.
    pub fn truth(&self) -> &[u8] {
        &self.truth
    }

    /// The rendered image, `[height, width, 3]`.
    pub fn rendered(&self) -> &[u8] {
        &self.rendered
    }

    /// The pixels that count; `None` if all do.
    pub(super) fn counts(&self) -> Option<&[bool]> {
        self.counts.as_deref()
    }

    /// Whether a pixel counts.
    pub(super) fn is_counted(&self, pixel: usize) -> bool {
        self.counts.as_ref().is_none_or(|counts| counts[pixel])
    }

    /// Share of the pixels that count, from 0 to 1.
    pub(super) fn counted_share(&self) -> f64 {
        let share = |counts: &Vec<bool>| {
            counts.iter().filter(|counts| **counts).count() as f64 / counts.len() as f64
        };
        self.counts.as_ref().map_or(1.0, share)
    }

    /// Values from 0 to 1 of the pixels that count, as (rendered, real).
    pub(super) fn counted(&self) -> impl Iterator<Item = ([f64; 3], [f64; 3])> {
        let unit = |rgb: &[u8]| [rgb[0], rgb[1], rgb[2]].map(|byte| f64::from(byte) / 255.0);
        let pixels = self.rendered.chunks_exact(3).zip(self.truth.chunks_exact(3)).enumerate();
        // A filter and not a copy: an image of 4K has 25 million values.
        pixels
            .filter(|(pixel, _)| self.is_counted(*pixel))
            .map(move |(_, (rendered, truth))| (unit(rendered), unit(truth)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_checked_and_a_mask_that_hides_nothing_is_none() {
        let pair = |truth: usize, rendered: usize, mask: Option<Vec<bool>>| {
            Pair::new([2, 1], vec![0; truth], vec![51; rendered], mask)
        };
        for (given, what) in [
            (pair(3, 6, None), "the real image has 3 values, but 2 x 1 px have 6"),
            (pair(6, 7, None), "the rendered image has 7"),
            (pair(6, 6, Some(vec![true])), "the mask has 1 values"),
        ] {
            let message = given.unwrap_err().to_string();
            assert!(message.starts_with(what), "{message}");
        }
        assert!(pair(6, 6, Some(vec![true; 2])).unwrap().counts().is_none());
        let half = pair(6, 6, Some(vec![false, true])).unwrap();
        assert_eq!(half.counted_share(), 0.5);
        assert_eq!(half.counted().collect::<Vec<_>>(), [([0.2; 3], [0.0; 3])]);
    }
}
