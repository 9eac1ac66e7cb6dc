//! KID, the distance of two sets of images by the features that a network computes of them.
//!
//! The squared maximum mean discrepancy with the kernel `k(x, y) = (x.y / d + 1)^3`, by its
//! unbiased estimator (Binkowski, Sutherland, Arbel and Gretton 2018). As the authors do, it is the
//! mean over random subsets of at most 1,000 images of each set. It needs no minimal number of
//! images, while FID is biased below some thousands.

use serde::Serialize;

use super::mean::mean;
use wildcity_render::compare::json_numbers::serialize_number;

/// Number of subsets, if the sets are larger than one.
pub(crate) const SUBSETS: usize = 100;

/// Largest number of images of each set in a subset.
pub(crate) const SUBSET_SIZE: usize = 1000;

/// Seed of the choice of the subsets.
pub(crate) const SEED: u64 = 2018;

/// The distance of two sets of images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Kid {
    /// Mean over the subsets. It is unbiased, so it can be below 0.
    #[serde(serialize_with = "serialize_number")]
    pub mean: f64,
    /// Standard deviation over the subsets; 0 if there is one.
    #[serde(serialize_with = "serialize_number")]
    pub standard_deviation: f64,
    pub subsets: usize,
    /// Images of each set in a subset.
    pub subset_size: usize,
    /// Seed of the choice of the subsets.
    pub seed: u64,
}

/// The distances of rendered and of repaired images from the real ones.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KidScores {
    /// Name of the network in its manifest.
    pub network: String,
    /// Distance of the images as they were rendered.
    pub rendered: Kid,
    /// Distance of the repaired images; `None` without a repair.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub repaired: Option<Kid>,
}

/// Why there is no distance.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum KidError {
    /// The estimator divides by the number of pairs.
    #[error("a set of {0} images; KID needs at least 2 of each set")]
    Few(usize),
    /// Feature vectors have different lengths.
    #[error("feature vectors of {0} and of {1} values; one network gives one length")]
    Lengths(usize, usize),
}

impl Kid {
    /// The distance of two sets of feature vectors.
    ///
    /// # Errors
    /// There are too few, or they have different lengths.
    pub fn compare(a: &[Vec<f32>], b: &[Vec<f32>]) -> Result<Self, KidError> {
        Self::compare_subsets(a, b, SUBSETS, SUBSET_SIZE)
    }

    /// The distance by another number and size of subsets. If both sets fit into one subset, all
    /// images are compared.
    ///
    /// # Errors
    /// As [`Kid::compare`].
    pub fn compare_subsets(
        a: &[Vec<f32>],
        b: &[Vec<f32>],
        subsets: usize,
        most: usize,
    ) -> Result<Self, KidError> {
        // The estimator divides by n (n - 1) for each set.
        let fewest = a.len().min(b.len());
        if fewest < 2 {
            return Err(KidError::Few(fewest));
        }
        let length = a[0].len();
        if let Some(other) = a.iter().chain(b).find(|one| one.len() != length) {
            return Err(KidError::Lengths(length, other.len()));
        }
        // Both sets fit: one comparison of all is exact, and there is nothing to choose at random.
        if a.len().max(b.len()) <= most {
            let all = |set: &[Vec<f32>]| (0..set.len()).collect::<Vec<usize>>();
            let mean = squared_mmd(a, &all(a), b, &all(b));
            let subset_size = fewest;
            return Ok(Self { mean, standard_deviation: 0.0, subsets: 1, subset_size, seed: SEED });
        }
        // Subsets of equal size, as the authors take them.
        let subset_size = fewest.min(most);
        // A fixed seed: the same images give the same number.
        let mut random = SplitMix64(SEED);
        let mut values = Vec::with_capacity(subsets);
        for _ in 0..subsets {
            let of_a = random.choose(subset_size, a.len());
            let of_b = random.choose(subset_size, b.len());
            values.push(squared_mmd(a, &of_a, b, &of_b));
        }
        let mean_distance = mean(values.iter().copied());
        // Over the subsets, divided by their number: a population variance.
        let variance = mean(values.iter().map(|value| (value - mean_distance).powi(2)));
        Ok(Self {
            mean: mean_distance,
            standard_deviation: variance.sqrt(),
            subsets,
            subset_size,
            seed: SEED,
        })
    }
}

/// The unbiased estimate: pairs of an image with itself do not count.
fn squared_mmd(a: &[Vec<f32>], of_a: &[usize], b: &[Vec<f32>], of_b: &[usize]) -> f64 {
    let within = |set: &[Vec<f32>], of: &[usize]| {
        let mut sum = 0.0;
        // Each pair once, counted twice below: the kernel is symmetric.
        for (at, &i) in of.iter().enumerate() {
            for &j in &of[at + 1..] {
                sum += kernel(&set[i], &set[j]);
            }
        }
        let count = of.len() as f64;
        // 2 sum / (n (n - 1)) is the mean over ordered pairs of different images.
        2.0 * sum / (count * (count - 1.0))
    };
    let mut between = 0.0;
    for &i in of_a {
        for &j in of_b {
            between += kernel(&a[i], &b[j]);
        }
    }
    // Pairs of one image from each set: none is an image with itself.
    let pairs = of_a.len() as f64 * of_b.len() as f64;
    within(a, of_a) + within(b, of_b) - 2.0 * between / pairs
}

fn kernel(x: &[f32], y: &[f32]) -> f64 {
    // In f64: features of 2,048 values and a third power lose digits in f32.
    let dot: f64 = x.iter().zip(y).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum();
    (dot / x.len() as f64 + 1.0).powi(3)
}

/// SplitMix64 (Steele, Lea and Flood 2014).
struct SplitMix64(u64);

impl SplitMix64 {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Some of the indices below `of`, without repetition: the first of a shuffle (Fisher and
    /// Yates).
    fn choose(&mut self, count: usize, of: usize) -> Vec<usize> {
        let mut indices: Vec<usize> = (0..of).collect();
        // Only the first `count` steps of the shuffle: the rest is not used.
        for at in 0..count {
            // Off from uniform by at most of / 2^64.
            let other = at + (self.next() % (of - at) as u64) as usize;
            indices.swap(at, other);
        }
        indices.truncate(count);
        indices
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(count: usize, length: usize, shift: f32) -> Vec<Vec<f32>> {
        // Multiples of a prime modulo 1,000, from -1 to 1, plus the shift.
        let value = |at: usize| ((at * 7919 + 13) % 1000) as f32 / 500.0 - 1.0 + shift;
        (0..count).map(|i| (0..length).map(|j| value(i * length + j)).collect()).collect()
    }

    #[test]
    fn two_images_of_one_number_are_as_the_formula_says() {
        let a = vec![vec![1.0], vec![2.0]];
        let b = vec![vec![0.0], vec![-1.0]];
        // (1 * 2 + 1)^3 + (0 + 1)^3 - 2 / 4 of (1, 0, 1, -1).
        let between = (1.0 + 0.0 + 1.0 - 1.0) / 2.0;
        let kid = Kid::compare(&a, &b).unwrap();
        assert!((kid.mean - (27.0 + 1.0 - between)).abs() < 1e-12, "{kid:?}");
        assert_eq!((kid.subsets, kid.subset_size), (1, 2));
    }

    #[test]
    fn other_images_are_farther_away_and_subsets_agree_with_all() {
        let a = set(60, 16, 0.0);
        let b = set(50, 16, 0.01);
        let far = set(50, 16, 0.5);
        let near_kid = Kid::compare(&a, &b).unwrap();
        let far_kid = Kid::compare(&a, &far).unwrap();
        assert!(far_kid.mean > near_kid.mean + 0.1, "{near_kid:?} {far_kid:?}");
        let parts = Kid::compare_subsets(&a, &far, 200, 20).unwrap();
        assert_eq!((parts.subsets, parts.subset_size), (200, 20));
        assert!(parts.standard_deviation > 0.0);
        // The standard error of the mean of 200 subsets; five of them are the tolerance.
        let error = parts.standard_deviation / 200.0_f64.sqrt();
        assert!((parts.mean - far_kid.mean).abs() < 5.0 * error, "{parts:?} {far_kid:?}");
        assert_eq!(parts, Kid::compare_subsets(&a, &far, 200, 20).unwrap());
    }

    #[test]
    fn too_few_images_and_other_lengths_are_refused() {
        assert_eq!(Kid::compare(&set(1, 4, 0.0), &set(5, 4, 0.0)), Err(KidError::Few(1)));
        assert_eq!(Kid::compare(&set(3, 4, 0.0), &set(3, 5, 0.0)), Err(KidError::Lengths(4, 5)));
    }

    #[test]
    fn a_choice_has_no_index_twice() {
        let mut chosen = SplitMix64(1).choose(30, 50);
        chosen.sort_unstable();
        chosen.dedup();
        assert_eq!(chosen.len(), 30);
        assert!(chosen.iter().all(|index| *index < 50));
    }
}
