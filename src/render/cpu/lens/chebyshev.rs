//! Smooth functions as short Chebyshev series.

use fearless_simd::{f32x16, prelude::*};

/// Nodes at which a function is sampled.
const NODES: usize = 32;

/// Most terms of a series. Real lenses need 8 to 14, and a fisheye with an image up to 100° off the axis 18
/// to 22.
const MAX_TERMS: usize = 24;

/// `f(x)/x` from 0 to a limit, as a sum of Chebyshev polynomials of `v = 2x/limit - 1`, which runs from -1
/// to 1.
#[derive(Clone, Debug)]
pub(super) struct ChebyshevSeries {
    /// Coefficients, from degree 0.
    terms: Vec<f32>,
    /// `2/limit`.
    v_per_x: f32,
}

impl ChebyshevSeries {
    /// The fewest terms with a remainder that changes f by less than `max_error`; `None` if that takes more
    /// than [`MAX_TERMS`].
    pub(super) fn fit(limit: f64, max_error: f64, f: &dyn Fn(f64) -> f64) -> Option<Self> {
        // Sample at the Chebyshev nodes, and take the discrete cosine transform.
        let node = |j: usize| std::f64::consts::PI * (j as f64 + 0.5) / NODES as f64;
        let sample = |j: usize| {
            let x = 0.5 * (node(j).cos() + 1.0) * limit;
            f(x) / x
        };
        let samples: Vec<f64> = (0..NODES).map(sample).collect();
        let term = |k: usize| {
            let term = |(j, g): (usize, &f64)| g * (k as f64 * node(j)).cos();
            let sum: f64 = samples.iter().enumerate().map(term).sum();
            sum * if k == 0 { 1.0 } else { 2.0 } / NODES as f64
        };
        let mut terms: Vec<f64> = (0..NODES).map(term).collect();

        // Drop terms from the end while their sum of magnitudes, times x <= limit, stays below the bound.
        let mut dropped = 0.0;
        while let Some(last) = terms.last() {
            dropped += last.abs() * limit;
            let needed = dropped > max_error || dropped.is_nan();
            if needed {
                break;
            }
            terms.pop();
        }
        let usable = (1..=MAX_TERMS).contains(&terms.len()) && dropped.is_finite();
        let terms = terms.iter().map(|&term| term as f32).collect();
        usable.then_some(Self { terms, v_per_x: (2.0 / limit) as f32 })
    }

    /// The value of `f(x)/x`, by Clenshaw's recurrence (1955).
    #[inline(always)]
    pub(super) fn at<S: Simd>(&self, simd: S, x: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let v = x.mul_add(splat(self.v_per_x), splat(-1.0));
        let twice = v + v;
        let mut last = splat(0.0);
        let mut before = splat(0.0);
        for term in self.terms[1..].iter().rev() {
            let next = twice.mul_add(last, splat(*term)) - before;
            before = last;
            last = next;
        }
        v.mul_add(last, splat(self.terms[0])) - before
    }
}
