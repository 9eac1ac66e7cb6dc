//! Peak signal-to-noise ratio.

/// Least PSNR at which an image of one backend counts as that of another, in dB.
pub const MIN_PSNR_DB: f64 = 60.0;

/// Peak signal-to-noise ratio in dB, of differences of values with peak 1:
/// `-10 log10(mean of squares)`. Infinite if all differences are 0; NaN if one is a NaN, or if
/// there are none.
pub fn psnr_db(differences: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) =
        differences.fold((0.0, 0_u64), |(sum, count), off| (sum + off * off, count + 1));
    -10.0 * (sum / count as f64).log10()
}

/// The PSNR of two images in 8 bits.
pub fn psnr_db_u8<'a>(pairs: impl Iterator<Item = (&'a u8, &'a u8)>) -> f64 {
    psnr_db(pairs.map(|(a, b)| f64::from(a.abs_diff(*b)) / 255.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decibels_of_known_differences() {
        assert!((psnr_db([0.1, -0.1].into_iter()) - 20.0).abs() < 1e-9);
        assert!((psnr_db_u8([0].iter().zip(&[255])) - 0.0).abs() < 1e-9);
        assert_eq!(psnr_db([0.0; 3].into_iter()), f64::INFINITY);
        assert!(psnr_db([f64::NAN, 0.0].into_iter()).is_nan());
        assert!(psnr_db(std::iter::empty()).is_nan());
    }
}
