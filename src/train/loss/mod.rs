//! Losses: plain functions that return a value and its derivatives.
//!
//! | function | of | source |
//! |---|---|---|
//! | [`l1`], [`l2`] | colours | Kerbl et al. 2023, eq. 7 |
//! | [`dssim`] | colours, in windows of 11 x 11 px | Wang et al. 2004 |
//! | [`disparity`], [`metric_depth`] | expected depths at measured pixels | |
//! | [`normals`] | normals of the expected depth | Huang et al. 2024 (2DGS), eq. 14 |
//! | [`opacity`], [`scale`] | all Gaussians | Kheradmand et al. 2024 (3DGS-MCMC), eq. 10 |
//! | [`ground::Terms`] | Gaussians of the ground | the project's paper, section 4.2 |
//!
//! Images are row by row, colours `[height, width, 3]`. A mask has one weight per pixel, and weight
//! 0 leaves a pixel out: of a mean, the weights are part.

mod depth;
mod gaussians;
pub mod ground;
mod normals;
mod pixels;
mod ssim;

pub use depth::{DepthLoss, LEAST_OPACITY, disparity, metric_depth};
pub use gaussians::{opacity, scale};
pub use normals::normals;
pub use pixels::{l1, l2, masked};
pub use ssim::dssim;

use num_traits::Float;

/// A number to compute with: f32 in training, and f64 where the derivatives are judged.
pub trait Real:
    Float + Send + Sync + std::iter::Sum + std::ops::AddAssign + std::fmt::Debug
{
    fn from_f64(value: f64) -> Self;
    fn to_double(self) -> f64;
}

impl Real for f32 {
    fn from_f64(value: f64) -> Self {
        value as Self
    }

    fn to_double(self) -> f64 {
        self.into()
    }
}

impl Real for f64 {
    fn from_f64(value: f64) -> Self {
        value
    }

    fn to_double(self) -> f64 {
        self
    }
}

/// A loss, and its derivatives by the values that it is a function of.
#[derive(Clone, Debug, PartialEq)]
pub struct Loss<T> {
    pub value: f64,
    /// In the order and the number of those values.
    pub by: Vec<T>,
}

impl<T: Real> Loss<T> {
    /// The loss times a weight.
    pub fn scaled(mut self, weight: f64) -> Self {
        self.value *= weight;
        let weight = T::from_f64(weight);
        for value in &mut self.by {
            *value = *value * weight;
        }
        self
    }

    /// The sum with another loss of the same values.
    pub fn plus(mut self, other: &Self) -> Self {
        self.value += other.value;
        for (value, other) in self.by.iter_mut().zip(&other.by) {
            *value += *other;
        }
        self
    }
}
