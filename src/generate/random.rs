//! Seeded randomness: the same numbers on every machine, and no clock.

/// A stream of random numbers, SplitMix64 (Steele, Lea and Flood 2014).
#[derive(Clone, Debug)]
pub(super) struct Random(u64);

impl Random {
    /// The stream of one object: every building, tree and car has its own, so that a change to one does not
    /// change the others.
    pub(super) fn new(seed: u64, what: &str, index: usize) -> Self {
        let named = what.bytes().fold(seed, |hash, byte| mix(hash ^ u64::from(byte)));
        Self(mix(named ^ mix(index as u64)))
    }

    /// A seed for other streams.
    pub(super) fn seed(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GOLDEN);
        mix(self.0)
    }

    /// Uniform in [0, 1), with 53 random bits.
    pub(super) fn unit(&mut self) -> f64 {
        to_unit(self.seed())
    }

    /// Uniform in `[low, high)`.
    pub(super) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// True with this probability.
    pub(super) fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Uniform in `0..count`; `count` is at least one.
    pub(super) fn below(&mut self, count: usize) -> usize {
        ((self.unit() * count as f64) as usize).min(count - 1)
    }

    /// One of the choices; there is at least one.
    pub(super) fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }
}

/// Smooth noise over the plane, in [-1, 1], one lattice cell per unit: hashed corners, blended
/// with `3t² - 2t³`.
pub(super) fn noise(seed: u64, x: f64, y: f64) -> f64 {
    let (column, row) = (x.floor(), y.floor());
    let (tx, ty) = (smooth(x - column), smooth(y - row));
    let corner = |i: f64, j: f64| {
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

/// 2⁶⁴ divided by the golden ratio, odd.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

fn to_unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

fn mix(state: u64) -> u64 {
    let z = state.wrapping_add(GOLDEN);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_repeat_and_differ() {
        let draw = |mut random: Random| [random.unit(), random.unit(), random.unit()];
        let tree = draw(Random::new(1, "tree", 0));
        assert_eq!(tree, draw(Random::new(1, "tree", 0)));
        for other in [(2, "tree", 0), (1, "car", 0), (1, "tree", 1)] {
            assert_ne!(tree, draw(Random::new(other.0, other.1, other.2)));
        }
        let mut random = Random::new(7, "mean", 0);
        let mean = (0..10_000).map(|_| random.unit()).sum::<f64>() / 1e4;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
    }

    #[test]
    fn noise_is_continuous_across_lattice_lines() {
        for i in -5..5 {
            let (x, y) = (f64::from(i), 0.37 * f64::from(i));
            assert!((noise(3, x - 1e-9, y) - noise(3, x + 1e-9, y)).abs() < 1e-6);
            assert!(noise(3, x + 0.3, y).abs() <= 1.0);
        }
        assert_ne!(noise(3, 0.4, 0.4), noise(4, 0.4, 0.4));
    }
}
