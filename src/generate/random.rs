//! Noise from hashed numbers. Streams of random numbers are [`Random`].

pub(super) use wildcity_scene::random::Random;
use wildcity_scene::random::{mix, to_unit};

/// Smooth noise over the plane, in [-1, 1], one lattice cell per unit: hashed corners, blended
/// with `3t² - 2t³`.
pub(super) fn noise(seed: u64, x: f64, y: f64) -> f64 {
    let column = x.floor();
    let row = y.floor();
    let tx = smooth(x - column);
    let ty = smooth(y - row);
    let corner = |i: f64, j: f64| {
        // Two rounds of the hash, or points of one diagonal would share their value.
        let key = mix(seed ^ ((column + i) as i64 as u64)) ^ ((row + j) as i64 as u64);
        2.0 * to_unit(mix(key)) - 1.0
    };
    let below = corner(0.0, 0.0) + tx * (corner(1.0, 0.0) - corner(0.0, 0.0));
    let above = corner(0.0, 1.0) + tx * (corner(1.0, 1.0) - corner(0.0, 1.0));
    below + ty * (above - below)
}

/// `3t² - 2t³` of `t` clamped to [0, 1].
pub(super) fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_across_lattice_lines() {
        for i in -5..5 {
            let x = f64::from(i);
            let y = 0.37 * f64::from(i);
            assert!((noise(3, x - 1e-9, y) - noise(3, x + 1e-9, y)).abs() < 1e-6);
            assert!(noise(3, x + 0.3, y).abs() <= 1.0);
        }
        assert_ne!(noise(3, 0.4, 0.4), noise(4, 0.4, 0.4));
    }
}
