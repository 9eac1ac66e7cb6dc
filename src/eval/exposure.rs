//! The affine change of each colour channel that brings a rendered image closest to the real one.
//!
//! A camera chooses its exposure and white balance anew for each image. A scene that was trained
//! with a change for each image has none for a held-out one, and is then compared after the best
//! change. These numbers are always better, so report them in addition to the others and not in
//! place of them.

use serde::Serialize;

use super::pair::Pair;

/// `real = gain * rendered + offset`, for each of red, green and blue, with values from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Exposure {
    /// Factor of each channel.
    pub gain: [f64; 3],
    /// Offset of each channel.
    pub offset: [f64; 3],
}

impl Exposure {
    /// The least-squares fit over the pixels that count. A channel of one value only is moved, not
    /// scaled; without pixels nothing changes.
    pub(super) fn fit(pair: &Pair) -> Self {
        let count = pair.counted().count() as f64;
        let mut mean_from = [0.0; 3];
        let mut mean_to = [0.0; 3];
        for (from, to) in pair.counted() {
            for c in 0..3 {
                // Divided one by one: a sum of millions of values stays near 1.
                mean_from[c] += from[c] / count;
                mean_to[c] += to[c] / count;
            }
        }
        // Around the means, so that nothing cancels.
        let mut variance = [0.0; 3];
        let mut covariance = [0.0; 3];
        for (from, to) in pair.counted() {
            for c in 0..3 {
                variance[c] += (from[c] - mean_from[c]).powi(2);
                covariance[c] += (from[c] - mean_from[c]) * (to[c] - mean_to[c]);
            }
        }
        // A variance of 1e-12 is far below (1/255)² = 1.5e-5, the square of one step of 8 bits.
        let is_flat = |c: usize| variance[c] <= 1e-12 * count;
        let gain = [0, 1, 2].map(|c| if is_flat(c) { 1.0 } else { covariance[c] / variance[c] });
        // The line goes through both means.
        let offset = [0, 1, 2].map(|c: usize| mean_to[c] - gain[c] * mean_from[c]);
        Self { gain, offset }
    }

    /// A colour after the change, clamped to what a display shows.
    pub(super) fn apply(&self, rgb: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|c| (self.gain[c] * rgb[c] + self.offset[c]).clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(change: impl Fn(usize, u8) -> u8) -> Pair {
        // Values up to 100, so that twice the value plus 20 is within 8 bits.
        let rendered: Vec<u8> = (0..300).map(|i| (i * 37 % 101) as u8).collect();
        let truth = rendered.iter().enumerate().map(|(i, &value)| change(i % 3, value)).collect();
        Pair::new([10, 10], truth, rendered, None).unwrap()
    }

    #[test]
    fn a_known_change_is_found() {
        let fit = Exposure::fit(&pair(|c, value| 2 * value + 10 * c as u8));
        for c in 0..3 {
            assert!((fit.gain[c] - 2.0).abs() < 1e-12, "{fit:?}");
            assert!((fit.offset[c] - 10.0 * c as f64 / 255.0).abs() < 1e-12, "{fit:?}");
        }
    }

    #[test]
    fn one_colour_is_moved_and_no_pixel_changes_nothing() {
        let flat = Pair::new([2, 1], vec![200; 6], vec![100; 6], None).unwrap();
        let fit = Exposure::fit(&flat);
        assert_eq!(fit.gain, [1.0; 3]);
        assert!((fit.apply([100.0 / 255.0; 3])[0] - 200.0 / 255.0).abs() < 1e-12, "{fit:?}");
        let hidden = Pair::new([1, 1], vec![9; 3], vec![0; 3], Some(vec![false])).unwrap();
        // No pixel counts: the identity.
        assert_eq!(Exposure::fit(&hidden), Exposure { gain: [1.0; 3], offset: [0.0; 3] });
        let bright = Exposure { gain: [2.0; 3], offset: [-0.2; 3] };
        assert_eq!(bright.apply([0.05, 0.9, 0.5]), [0.0, 1.0, 0.8]);
    }
}
