//! Smooth functions as short series.
//!
//! A series is chosen by its Chebyshev terms, whose sizes bound the remainder, and evaluated by
//! powers: half the operations, in two independent chains. The functions here are smooth beyond the
//! ends of their range, so that the coefficients of the powers fall, too, and nothing cancels.

use fearless_simd::{f32x16, prelude::*};

/// Nodes at which a function is sampled.
const NODES: usize = 32;

/// Most terms of a series. Real lenses need 8 to 14, and a fisheye with an image up to 100° off the
/// axis 18 to 22.
const MAX_TERMS: usize = 24;

/// `f(x)/x` from 0 to a limit, as a polynomial of `v = 2x/limit - 1`, which runs from -1 to 1.
#[derive(Clone, Debug)]
pub(super) struct ChebyshevSeries {
    /// Coefficients of an even power and of the odd one above it, from the highest powers to the
    /// lowest.
    pairs: Vec<[f32; 2]>,
    v_per_x: f32,
}

impl ChebyshevSeries {
    /// The fewest terms with a remainder that changes f by less than `max_error`; `None` if that
    /// takes more than [`MAX_TERMS`].
    pub(super) fn fit(limit: f64, max_error: f64, f: &dyn Fn(f64) -> f64) -> Option<Self> {
        // Sample at the Chebyshev nodes, and take the discrete cosine transform.
        let node = |j: usize| std::f64::consts::PI * (j as f64 + 0.5) / NODES as f64;
        let sample = |j: usize| {
            // No node lies at 0, so that f(x)/x is defined at each.
            let x = 0.5 * (node(j).cos() + 1.0) * limit;
            f(x) / x
        };
        let samples: Vec<f64> = (0..NODES).map(sample).collect();
        let term = |k: usize| {
            let term = |(j, g): (usize, &f64)| g * (k as f64 * node(j)).cos();
            let sum: f64 = samples.iter().enumerate().map(term).sum();
            // The transform's weights: 1/N for the mean, 2/N for all other terms.
            sum * if k == 0 { 1.0 } else { 2.0 } / NODES as f64
        };
        let mut terms: Vec<f64> = (0..NODES).map(term).collect();

        // Drop terms from the end while their sum of magnitudes, times x <= limit, stays below the
        // bound.
        let mut dropped = 0.0;
        while let Some(last) = terms.last() {
            dropped += last.abs() * limit;
            // A NaN of the function ends the loop, too, and makes the series unusable.
            let needed = dropped > max_error || dropped.is_nan();
            if needed {
                break;
            }
            terms.pop();
        }
        // `dropped` has the term at which the loop has ended, so it is finite unless a
        // sample is not.
        let usable = (1..=MAX_TERMS).contains(&terms.len()) && dropped.is_finite();
        usable.then(|| {
            let powers = power_series(&terms);
            let odd = |even: usize| powers.get(even + 1).map_or(0.0, |&odd| odd as f32);
            // From the highest pair to the lowest, as Horner's scheme takes them.
            let evens = (0..powers.len()).step_by(2).rev();
            let pairs = evens.map(|even| [powers[even] as f32, odd(even)]).collect();
            Self { pairs, v_per_x: (2.0 / limit) as f32 }
        })
    }

    /// The value of `f(x)/x`, by Horner's scheme in v² for the even powers and for the odd ones.
    #[inline(always)]
    pub(super) fn at<S: Simd>(&self, simd: S, x: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let v = x.mul_add(splat(self.v_per_x), splat(-1.0));
        let vv = v * v;
        let mut even_sum = splat(0.0);
        let mut odd_sum = splat(0.0);
        for &[even, odd] in &self.pairs {
            even_sum = even_sum.mul_add(vv, splat(even));
            odd_sum = odd_sum.mul_add(vv, splat(odd));
        }
        // odd powers are v times a polynomial of v^2.
        odd_sum.mul_add(v, even_sum)
    }
}

/// The coefficients of the powers, from degree 0, of a sum of Chebyshev polynomials: `T₀ = 1`,
/// `T₁ = v` and `Tₖ₊₁ = 2 v Tₖ - Tₖ₋₁`.
fn power_series(terms: &[f64]) -> Vec<f64> {
    let count = terms.len();
    let mut sum = vec![0.0; count];
    let mut before = vec![0.0; count];
    let mut last = vec![0.0; count];
    last[0] = 1.0;
    // `last` has the coefficients of T_k and `before` those of T_(k-1), which is 0 for k = 0.
    for (k, term) in terms.iter().enumerate() {
        for (sum, power) in sum.iter_mut().zip(&last) {
            *sum += term * power;
        }
        let factor = if k == 0 { 1.0 } else { 2.0 };
        let mut next: Vec<f64> = before.iter().map(|power| -power).collect();
        // A product with v moves every coefficient up by one. The highest falls off in the last
        // round only, where it is not needed any more.
        for (next, power) in next[1..].iter_mut().zip(&last) {
            *next += factor * power;
        }
        before = last;
        last = next;
    }
    sum
}
