//! Flicker: what changes from one view to the next where the surface is the same.

/// Mean absolute difference of a view and the view before it, brought into it by depth.
///
/// `now` and `before_in_now` are `[height, width, 3]` in 8 bits, `valid` is `[height, width]`: above 0 where the depths of
/// both agree. Values from 0 to 1, over the three channels; NaN without a valid pixel.
pub fn flicker(now: &[u8], before_in_now: &[u8], valid: &[f32]) -> f64 {
    let pixels = now.chunks_exact(3).zip(before_in_now.chunks_exact(3)).zip(valid);
    let (mut sum, mut count) = (0_u64, 0_u64);
    for ((now, before), valid) in pixels {
        if *valid > 0.0 {
            sum += now.iter().zip(before).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
            count += 3;
        }
    }
    sum as f64 / 255.0 / count as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_mean_of_the_valid_pixels() {
        let now = [10, 20, 30, 255, 255, 255, 0, 0, 0];
        let before = [40, 20, 0, 0, 0, 0, 51, 51, 51];
        let mean = flicker(&now, &before, &[1.0, 0.0, 1.0]);
        assert!((mean - (30.0 + 0.0 + 30.0 + 3.0 * 51.0) / 6.0 / 255.0).abs() < 1e-15, "{mean}");
        assert!(flicker(&now, &before, &[0.0; 3]).is_nan());
        assert_eq!(flicker(&now, &now, &[1.0; 3]), 0.0);
    }
}
