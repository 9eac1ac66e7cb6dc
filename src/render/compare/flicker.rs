//! Flicker: the change from one image to the next where both show the same surface.

/// Mean absolute difference of an image and the previous one, which was warped into its view, from
/// 0 to 1: over the channels of the pixels where the warped image is valid. `None` if no pixel is
/// valid.
///
/// `now` and `previous_warped` are `[height, width, 3]` in 8 bits. `valid` is `[height, width]`,
/// above 0 where both images show the same surface.
pub fn flicker(now: &[u8], previous_warped: &[u8], valid: &[f32]) -> Option<f64> {
    let mut sum = 0_u64;
    // Integer sums are exact, so that the result does not depend on an order.
    let mut count = 0_u64;
    let pixels = now.chunks_exact(3).zip(previous_warped.chunks_exact(3));
    for ((now, previous), _) in pixels.zip(valid).filter(|(_, valid)| **valid > 0.0) {
        sum += now.iter().zip(previous).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
        count += 3;
    }
    (count > 0).then(|| sum as f64 / (255.0 * count as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_mean_of_the_valid_pixels() {
        let now = [10, 20, 30, 255, 255, 255, 0, 0, 0];
        let previous = [40, 20, 0, 0, 0, 0, 51, 51, 51];
        // The middle pixel differs by 255, but is not valid.
        let mean = flicker(&now, &previous, &[1.0, 0.0, 1.0]).unwrap();
        assert!((mean - (30.0 + 0.0 + 30.0 + 3.0 * 51.0) / 6.0 / 255.0).abs() < 1e-15, "{mean}");
        assert_eq!(flicker(&now, &previous, &[0.0; 3]), None);
        assert_eq!(flicker(&now, &now, &[1.0; 3]), Some(0.0));
    }
}
