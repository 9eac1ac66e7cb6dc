//! The transfer function of sRGB (IEC 61966-2-1), between stored values and linear light, both from
//! 0 to 1.

/// Linear light of a stored value.
pub fn linear_from_stored(stored: f64) -> f64 {
    if stored <= 0.04045 { stored / 12.92 } else { ((stored + 0.055) / 1.055).powf(2.4) }
}

/// The stored value of linear light.
pub fn stored_from_linear(linear: f64) -> f64 {
    // A line near 0, because the slope of the power is infinite there.
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Makes an image in 8 bits brighter: twice as much linear light for each stop.
pub fn change_stops(rgb8: &mut [u8], stops: f64) {
    let change = |byte: u8| {
        let linear = stops.exp2() * linear_from_stored(f64::from(byte) / 255.0);
        (255.0 * stored_from_linear(linear.min(1.0))).round() as u8
    };
    // A table of 256 values instead of two powers for each byte.
    let changed: Vec<u8> = (0..=255).map(change).collect();
    rgb8.iter_mut().for_each(|byte| *byte = changed[usize::from(*byte)]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_twice_the_light() {
        let mut rgb8 = [0, 10, 128, 188, 255];
        change_stops(&mut rgb8, -1.0);
        // Half the light of 188 is 137: linear 0.503 becomes 0.252.
        assert_eq!(rgb8, [0, 5, 92, 137, 188]);
        let mut bright = [188, 60, 255];
        change_stops(&mut bright, 1.0);
        assert_eq!(bright, [255, 85, 255]);
    }

    /// Values of the standard's formula: by hand, and the ends.
    #[test]
    fn both_directions_are_the_standard_and_each_other() {
        for (stored, linear) in
            [(0.0, 0.0), (0.5, 0.214_041_140_5), (0.02, 0.02 / 12.92), (1.0, 1.0)]
        {
            assert!((linear_from_stored(stored) - linear).abs() < 1e-9, "{stored}");
        }
        for value in 0..=255 {
            let stored = f64::from(value) / 255.0;
            // The two branches of the standard meet within 1e-6, no closer.
            let again = stored_from_linear(linear_from_stored(stored));
            assert!((again - stored).abs() < 1e-6, "{value}: {again}");
        }
    }
}
