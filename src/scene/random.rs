//! Seeded randomness: the same numbers on every machine, and no clock.

/// A stream of random numbers, SplitMix64 (Steele, Lea and Flood 2014).
///
/// Each object has its own stream, so that a change to one object does not change the others.
#[derive(Clone, Debug, PartialEq)]
pub struct Random(u64);

impl Random {
    /// The stream of one object, by the seed, a name and an index.
    pub fn new(seed: u64, name: &str, index: usize) -> Self {
        let named = name.bytes().fold(seed, |hash, byte| mix(hash ^ u64::from(byte)));
        Self(mix(named ^ mix(index as u64)))
    }

    /// A seed for other streams.
    pub fn seed(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GOLDEN);
        mix(self.0)
    }

    /// Uniform in [0, 1), with 53 random bits.
    pub fn unit(&mut self) -> f64 {
        to_unit(self.seed())
    }

    /// Uniform in `[low, high)`.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Uniform in `0..count`; `count` is at least one.
    pub fn below(&mut self, count: usize) -> usize {
        // The product may round up to `count` itself.
        ((self.unit() * count as f64) as usize).min(count - 1)
    }

    /// One of the choices; there is at least one.
    pub fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }
}

/// The 53 highest of 64 random bits, as a number in [0, 1).
pub fn to_unit(bits: u64) -> f64 {
    // The upper 53 bits, as many as the mantissa of an f64 has: every result is exact, and 1 is
    // never reached.
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

/// SplitMix64's mix of a state: every bit of the result depends on every bit of the state.
pub fn mix(state: u64) -> u64 {
    let z = state.wrapping_add(GOLDEN);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// 2⁶⁴ divided by the golden ratio, odd.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

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
        // The standard error of the mean of 10,000 uniform numbers is 0.29 / 100 = 0.003; 0.02 is
        // seven times that.
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
    }
}
