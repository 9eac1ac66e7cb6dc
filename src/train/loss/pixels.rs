//! Losses of single pixels.

use rayon::prelude::*;

use super::{Loss, Real};

/// The mean of the absolute differences of colours, of pixels by their weights.
pub fn l1<T: Real>(image: &[T], target: &[T], weights: Option<&[T]>) -> Loss<T> {
    pixel_mean(image, target, weights, |off| (off.abs(), signum(off)))
}

/// The mean of the squared differences of colours, of pixels by their weights.
pub fn l2<T: Real>(image: &[T], target: &[T], weights: Option<&[T]>) -> Loss<T> {
    pixel_mean(image, target, weights, |off| (off * off, off + off))
}

/// A copy of an image with its pixels times their weights: what a loss of windows, such as
/// [`dssim`](super::dssim), takes on both sides, so that a masked pixel is equal in both.
pub fn masked<T: Real>(image: &[T], weights: &[T]) -> Vec<T> {
    let mut masked = image.to_vec();
    for (rgb, &weight) in masked.chunks_exact_mut(3).zip(weights) {
        for value in rgb {
            *value = weighted(*value, weight);
        }
    }
    masked
}

/// A value times its weight: 0 for a weight of 0, whatever the value.
fn weighted<T: Real>(value: T, weight: T) -> T {
    if weight == T::zero() { weight } else { value * weight }
}

/// -1, 0 or 1: the derivative of the absolute value, with none at 0.
pub(super) fn signum<T: Real>(value: T) -> T {
    if value == T::zero() { value } else { value.signum() }
}

/// The weighted mean of `f` of the differences, which returns its derivative, too.
fn pixel_mean<T: Real>(
    image: &[T],
    target: &[T],
    weights: Option<&[T]>,
    f: impl Fn(T) -> (T, T) + Sync,
) -> Loss<T> {
    // Pixels of a part of the image, so that its sum is the same at any number of threads.
    const PART: usize = 3 << 12;
    let total = match weights {
        // The weight of a pixel counts for each of its three channels.
        Some(weights) => weights.iter().map(|weight| weight.to_double()).sum::<f64>() * 3.0,
        None => image.len() as f64,
    };
    // Without any weight there is no loss.
    let share = T::from_f64(if total > 0.0 { 1.0 / total } else { 0.0 });
    let mut by = vec![T::zero(); image.len()];
    let parts: Vec<f64> = by
        .par_chunks_mut(PART)
        .enumerate()
        .map(|(part, by)| {
            let first = part * PART;
            let mut sum = 0.0;
            for (k, by) in by.iter_mut().enumerate() {
                let i = first + k;
                let weight = weights.map_or(T::one(), |weights| weights[i / 3]);
                let (value, derivative) = f(image[i] - target[i]);
                sum += weighted(value, weight).to_double();
                *by = weighted(derivative, weight) * share;
            }
            sum
        })
        .collect();
    Loss { value: parts.iter().sum::<f64>() * share.to_double(), by }
}
