//! Smooth functions as a few Chebyshev terms.

use fearless_simd::{f32x16, prelude::*};

/// Nodes at which a function is sampled, and most terms of its series: real lenses need 8 to 14,
/// and a fisheye whose image ends at 100° off the axis 18 to 22.
const NODES: usize = 32;
const TERMS: usize = 24;

/// `f(x)/x` from 0 to a limit.
#[derive(Clone, Debug)]
pub(super) struct Series {
    /// Of Chebyshev polynomials of `x per_limit - 1`, which runs from -1 to 1.
    terms: Vec<f32>,
    per_limit: f32,
}

impl Series {
    /// As many terms as leave less than `left` of f; `None` if those are too many.
    pub(super) fn fit(limit: f64, left: f64, f: &dyn Fn(f64) -> f64) -> Option<Self> {
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
        let mut cut = 0.0;
        while let Some(last) = terms.last() {
            cut += last.abs() * limit;
            let needed = cut > left || cut.is_nan();
            if needed {
                break;
            }
            terms.pop();
        }
        let usable = (1..=TERMS).contains(&terms.len()) && cut.is_finite();
        let terms = terms.iter().map(|&term| term as f32).collect();
        usable.then_some(Self { terms, per_limit: (2.0 / limit) as f32 })
    }

    /// By Clenshaw's recurrence.
    #[inline(always)]
    pub(super) fn at<S: Simd>(&self, simd: S, x: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let v = x.mul_add(splat(self.per_limit), splat(-1.0));
        let twice = v + v;
        let (mut last, mut before) = (splat(0.0), splat(0.0));
        for term in self.terms[1..].iter().rev() {
            let next = twice.mul_add(last, splat(*term)) - before;
            (before, last) = (last, next);
        }
        v.mul_add(last, splat(self.terms[0])) - before
    }
}
