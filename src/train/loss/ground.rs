//! The three terms of the ground (the project's paper, section 4.2): flat, upright, and opaque.
//!
//! - **height**: the ground is cut into slices along the direction of driving, and the standard
//!   deviation of the heights in each, averaged over the slices, is the loss: a slope costs nothing
//!   within a slice of a few metres, and a bump does.
//! - **upright**: `1 - |up · n|` with the shortest axis n of a Gaussian.
//! - **opaque**: `(1 - opacity)²`.
//!
//! The paper measures along the camera's axes, and these tilt with every pitch of the car. Up and
//! forward are arguments here: those of a camera, or those of the drive.

use super::Real;
use super::normals::{dot, scaled};

/// A Gaussian of the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian<T> {
    pub mean_m: [T; 3],
    /// Its shortest axis: a unit vector.
    pub normal: [T; 3],
    pub opacity: T,
}

/// The derivatives of a loss by a Gaussian of the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianGradient<T> {
    pub mean_m: [T; 3],
    /// By the shortest axis, as of three independent numbers.
    pub normal: [T; 3],
    pub opacity: T,
}

/// The axes of the ground, and how each term counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms<T> {
    pub up: [T; 3],
    pub forward: [T; 3],
    /// Length of a slice, in metres.
    pub slice_m: T,
    /// Weights of the terms.
    pub height: T,
    pub upright: T,
    pub opaque: T,
}

/// The weighted sum of the terms.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundLoss<T> {
    /// Each term without its weight: height in metres, upright, opaque.
    pub terms: [f64; 3],
    /// The sum with the weights.
    pub value: f64,
    pub by: Vec<GaussianGradient<T>>,
}

impl<T: Real> Terms<T> {
    /// The loss of some Gaussians of the ground.
    pub fn loss(&self, gaussians: &[Gaussian<T>]) -> GroundLoss<T> {
        let zero =
            GaussianGradient { mean_m: [T::zero(); 3], normal: [T::zero(); 3], opacity: T::zero() };
        let mut loss = GroundLoss { terms: [0.0; 3], value: 0.0, by: vec![zero; gaussians.len()] };
        if gaussians.is_empty() {
            return loss;
        }
        self.add_height(gaussians, &mut loss);
        let share = T::from_f64(1.0 / gaussians.len() as f64);
        let [mut upright, mut opaque] = [0.0; 2];
        for (gaussian, by) in gaussians.iter().zip(&mut loss.by) {
            let cosine = dot(self.up, gaussian.normal);
            upright += (T::one() - cosine.abs()).to_double();
            // The derivative of 1 - |c| by c.
            let sign = if cosine < T::zero() { T::one() } else { -T::one() };
            by.normal = scaled(self.up, sign * self.upright * share);
            let missing = T::one() - gaussian.opacity;
            opaque += (missing * missing).to_double();
            by.opacity = -(missing + missing) * self.opaque * share;
        }
        loss.terms[1] = upright * share.to_double();
        loss.terms[2] = opaque * share.to_double();
        let weights = [self.height, self.upright, self.opaque].map(T::to_double);
        loss.value = loss.terms.iter().zip(weights).map(|(term, weight)| term * weight).sum();
        loss
    }

    /// The mean over the slices of the standard deviation of heights.
    fn add_height(&self, gaussians: &[Gaussian<T>], loss: &mut GroundLoss<T>) {
        // Gaussians of each slice, in order; a slice of one has no deviation.
        let slice = |gaussian: &Gaussian<T>| {
            (dot(self.forward, gaussian.mean_m) / self.slice_m).floor().to_double() as i64
        };
        let mut order: Vec<usize> = (0..gaussians.len()).collect();
        order.sort_by_key(|&i| slice(&gaussians[i]));
        let slices: Vec<&[usize]> =
            order.chunk_by(|&a, &b| slice(&gaussians[a]) == slice(&gaussians[b])).collect();
        let share = 1.0 / slices.len() as f64;
        for slice in slices {
            let count = T::from_f64(slice.len() as f64);
            let height = |i: usize| dot(self.up, gaussians[i].mean_m);
            let mean = slice.iter().map(|&i| height(i)).sum::<T>() / count;
            let variance = slice.iter().map(|&i| (height(i) - mean).powi(2)).sum::<T>() / count;
            let deviation = variance.sqrt();
            loss.terms[0] += deviation.to_double() * share;
            if deviation == T::zero() {
                continue;
            }
            // d sqrt(mean (h - m)²) = (h - m)/(n deviation) dh; that by the mean cancels.
            let factor = self.height * T::from_f64(share) / (count * deviation);
            for &i in slice {
                loss.by[i].mean_m = scaled(self.up, (height(i) - mean) * factor);
            }
        }
    }
}
