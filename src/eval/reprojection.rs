//! Reprojection: an off-trajectory view, warped back onto the real image that it was moved from.
//!
//! Off the trajectory there is no real image. But most surfaces in such a view were seen from the
//! drive, and must have the same colours. Specular surfaces and errors of the depth make a
//! difference even in a perfect view, so use this number only to compare methods on the same views.

use serde::Serialize;

use super::pair::{Pair, PairError};
use super::scores::PairScores;
use wildcity_render::compare::json_numbers::serialize_number;

/// The error of a view that was warped back, against the real image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Reprojection {
    /// PSNR over the pixels that came back, in dB.
    #[serde(serialize_with = "serialize_number")]
    pub psnr_db: f64,
    /// Mean LDR-FLIP of these pixels.
    #[serde(serialize_with = "serialize_number")]
    pub flip: f64,
    /// Share of the real image's pixels that came back, from 0 to 1.
    pub share: f64,
}

impl Reprojection {
    /// Compares the view `back` with the real image `truth`. Both are `[height, width, 3]` in 8
    /// bits. `valid` is `[height, width]`, above 0 where `back` has a value. `counts` marks the
    /// pixels of the real image that count; all count without it.
    ///
    /// # Errors
    /// [`PairError::Size`].
    pub fn compare(
        size_px: [u32; 2],
        truth: &[u8],
        back: &[u8],
        valid: &[f32],
        counts: Option<&[bool]>,
    ) -> Result<Self, PairError> {
        let counted = valid.iter().enumerate().map(|(pixel, valid)| {
            *valid > 0.0 && counts.is_none_or(|counts| counts.get(pixel) == Some(&true))
        });
        // Lengths that disagree give a `counted` of another length, which `Pair::new` names as the
        // mask.
        let pair = Pair::new(size_px, truth.to_vec(), back.to_vec(), Some(counted.collect()))?;
        // Without the aligned scores, which this comparison does not report.
        let scores = PairScores::compare(&pair, false).scores;
        Ok(Self { psnr_db: scores.psnr_db, flip: scores.flip, share: scores.counted })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_that_do_not_come_back_or_do_not_count_are_left_out() {
        let truth = vec![100; 3 * 16];
        let mut back = vec![110; 3 * 16];
        back[..3].fill(0);
        back[3 * 15..].fill(255);
        let mut valid = vec![1.0; 16];
        valid[0] = 0.0;
        let mut counts = [true; 16];
        counts[15] = false;
        let of = |counts| Reprojection::compare([4, 4], &truth, &back, &valid, counts).unwrap();
        let found = of(Some(&counts[..]));
        // 110 against 100: 20 log10(255 / 10).
        assert!((found.psnr_db - 20.0 * 25.5_f64.log10()).abs() < 1e-12, "{found:?}");
        assert_eq!(found.share, 14.0 / 16.0);
        // 255 against 100 raises the error of one pixel far above that of the others.
        assert!(of(None).psnr_db < found.psnr_db - 3.0, "the last pixel counts then");
        let error = Reprojection::compare([4, 4], &truth, &back, &valid[1..], None).unwrap_err();
        assert!(error.to_string().starts_with("the mask has 15 values"), "{error}");
    }
}
