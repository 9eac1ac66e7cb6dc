//! How far the gradients of two backends differ, group by group of parameters.

use serde::Serialize;

use crate::gradient::{GaussianImages, Gradients};
use wildcity_scene::chunk::{column, columns};

/// The difference of the derivatives by one group of parameters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GroupError {
    /// `mean`, `ln scale`, `quat`, `opacity`, `sh` or `twist`.
    pub group: &'static str,
    /// The largest difference as a share of the largest derivative; NaN if one is
    /// not finite, or missing.
    pub error: f64,
    /// The cosine between both, as vectors.
    pub cosine: f64,
}

impl GroupError {
    /// Compares derivatives by the same parameters. Equal ones have no error, also if all are 0.
    /// The largest derivative counts as at least `least`.
    pub fn new(group: &'static str, ours: &[f64], theirs: &[f64], least: f64) -> Self {
        Self::within(group, ours, &[theirs], least)
    }

    /// As [`GroupError::new`] with several truths: what lies between them has no error. The cosine
    /// is that to the first.
    fn within(group: &'static str, ours: &[f64], truths: &[&[f64]], least: f64) -> Self {
        let theirs = truths[0];
        let most = largest(theirs).max(least);
        if truths.iter().any(|truth| truth.len() != ours.len()) {
            return Self { group, error: f64::NAN, cosine: f64::NAN };
        }
        let mut off: f64 = 0.0;
        for (i, ours) in ours.iter().enumerate() {
            let of_one = truths.iter().map(|truth| truth[i]);
            let low = of_one.clone().fold(f64::INFINITY, f64::min);
            let high = of_one.fold(f64::NEG_INFINITY, f64::max);
            // A NaN must win, and `max` would drop it.
            let difference = (ours - ours.clamp(low, high)).abs();
            off = if difference > off || difference.is_nan() { difference } else { off };
        }
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let lengths = (dot(ours, ours) * dot(theirs, theirs)).sqrt();
        // Vectors of rounding errors have no direction.
        let is_measured = off != 0.0 && largest(theirs) >= least;
        let cosine = if is_measured { dot(ours, theirs) / lengths } else { 1.0 };
        Self { group, error: if off == 0.0 { 0.0 } else { off / most }, cosine }
    }
}

/// The differences of all groups to one truth or to several, of which the first is the truth itself
/// and the others are those of thresholds that are nudged.
///
/// # Panics
/// If `truths` is empty: there is nothing to compare with.
pub fn group_errors(ours: &Gradients, truths: &[Gradients]) -> Vec<GroupError> {
    let ours = by_group(ours);
    let truths: Vec<_> = truths.iter().map(by_group).collect();
    let theirs = &truths[0];
    // A ball has no derivative by its rotation but the rounding errors of terms as large as those
    // by its size: these count with a hundredth.
    let of_size = theirs.iter().filter(|(group, _)| *group == "ln scale");
    let rotation = of_size.map(|(_, values)| 0.01 * largest(values)).sum();
    let compare = |(index, (group, ours)): (usize, &(&'static str, Vec<f64>))| {
        let least = if *group == "quat" { rotation } else { 0.0 };
        let truths: Vec<&[f64]> = truths.iter().map(|truth| &truth[index].1[..]).collect();
        GroupError::within(group, ours, &truths, least)
    };
    ours.iter().enumerate().map(compare).collect()
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |most, value| most.max(value.abs()))
}

/// All derivatives, by groups of parameters: those by all Gaussians in order of global ids, and
/// those by all twists.
pub fn by_group(gradients: &Gradients) -> Vec<(&'static str, Vec<f64>)> {
    let columns_of_group = |group: &str, sh_degree: u8| match group {
        "mean" => column::MEAN..column::SCALE,
        "ln scale" => column::SCALE..column::QUAT,
        "quat" => column::QUAT..column::LOG2_OPACITY,
        "opacity" => column::LOG2_OPACITY..column::SH,
        _ => column::SH..columns(sh_degree),
    };
    let mut groups = Vec::new();
    for group in ["mean", "ln scale", "quat", "opacity", "sh"] {
        let mut values = Vec::new();
        for chunk in &gradients.chunks {
            let range = columns_of_group(group, chunk.sh_degree());
            for index in 0..chunk.len() {
                values.extend(range.clone().map(|column| f64::from(chunk.value(index, column))));
            }
        }
        groups.push((group, values));
    }
    let twists = gradients.twists.iter().flat_map(|twist| twist.to_array()).collect();
    groups.push(("twist", twists));
    groups
}

/// Derivatives of a loss by images, for comparisons: waves of several lengths, so that no two
/// pixels have the same and their sums do not cancel.
pub fn waves(images: &[GaussianImages]) -> Vec<GaussianImages> {
    let wave = |len: usize, phase: f32| {
        let value = |i: usize| (0.37 * i as f32 + phase).sin() + 0.3 * (0.011 * i as f32).cos();
        (0..len).map(value).collect()
    };
    let of_view = |images: &GaussianImages| GaussianImages {
        rgb: wave(images.rgb.len(), 0.1),
        opacity: wave(images.opacity.len(), 1.3),
        depth_sum_m: wave(images.depth_sum_m.len(), 2.1),
    };
    images.iter().map(of_view).collect()
}
