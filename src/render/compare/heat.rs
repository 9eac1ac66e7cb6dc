//! Colours of error maps: dark to light, so that they also read without colour vision.

/// Evenly spaced colours from the smallest error to the largest.
pub const HEAT_RGB: [[u8; 3]; 6] =
    [[0, 0, 0], [52, 15, 92], [140, 32, 110], [215, 76, 60], [250, 160, 40], [252, 253, 191]];

/// The colour at a place from 0 (the first of [`HEAT_RGB`]) to 5 (the last), interpolated; clamped
/// to them. NaN has the colour of 0.
pub fn heat_rgb(place: f32) -> [u8; 3] {
    let last = HEAT_RGB.len() - 1;
    let place = place.clamp(0.0, last as f32);
    // The last colour is the upper end of the last interval. A cast of NaN gives 0.
    let low = (place as usize).min(last - 1);
    let share = if place.is_nan() { 0.0 } else { place - low as f32 };
    [0, 1, 2].map(|channel| {
        let from = f32::from(HEAT_RGB[low][channel]);
        let to = f32::from(HEAT_RGB[low + 1][channel]);
        (from + share * (to - from)).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_interpolated_and_clamped() {
        assert_eq!([0.0, 3.0, 5.0, 9.0].map(heat_rgb), [0, 3, 5, 5].map(|step| HEAT_RGB[step]));
        assert_eq!([-1.0, f32::NAN].map(heat_rgb), [HEAT_RGB[0]; 2]);
        assert_eq!(heat_rgb(0.5), [26, 8, 46]);
    }
}
