//! One step of Adam on a lane group, with the terms that keep Gaussians small and transparent, and
//! the noise that lets transparent ones find a place.

use glam::{Quat, Vec3};
use wildcity_scene::chunk::{LANES, Lanes, column, columns};
use wildcity_scene::random::{mix, to_unit};
use wildcity_scene::sh;

use crate::settings::Settings;

/// Columns of the parameters: those of a chunk, with logarithms of the scales, quaternions of any
/// length, and logits.
pub(super) const LN_SCALE: usize = column::SCALE;
pub(super) const LOGIT: usize = column::LOG2_OPACITY;

/// What one step of Adam needs beside the derivatives.
#[derive(Clone, Debug)]
pub(crate) struct AdamStep {
    /// The learning rate of each column.
    pub(crate) rates: Vec<f32>,
    /// `1 - decay^step` of both moments.
    pub(crate) corrections: [f32; 2],
    /// Derivatives of the mean opacity by an opacity, and of the mean scale by a scale.
    pub(crate) regularisers: [f32; 2],
    /// Noise of the means, in metres by a variance of 1 m².
    pub(crate) noise: f32,
    /// Opacity below which the noise begins.
    pub(crate) least_opacity: f32,
    /// Of the noise of this step.
    pub(crate) seed: u64,
}

/// Decays of Adam's moments.
const DECAYS: [f32; 2] = [0.9, 0.999];

/// Added to the root of the second moment. A derivative by a parameter of one of a million
/// Gaussians is small in all, and 1e-8 would hold it back (gsplat, INRIA).
const EPSILON: f32 = 1e-15;

impl AdamStep {
    /// Moves the visible Gaussians of a lane group, given the activated ones.
    #[inline(always)]
    pub(super) fn apply(
        &self,
        values: &mut [Lanes],
        activated: &[Lanes],
        moments: [&mut [Lanes]; 2],
        by: &[Lanes],
        visible: u16,
    ) {
        let [first, second] = moments;
        let derivatives = self.raw(values, activated, by);
        let shown: [bool; LANES] = std::array::from_fn(|lane| visible >> lane & 1 == 1);
        for (column, Lanes(derivatives)) in derivatives.iter().enumerate().take(values.len()) {
            let rate = self.rates[column] / self.corrections[0];
            let values = &mut values[column].0;
            let means = &mut first[column].0;
            let squares = &mut second[column].0;
            // All lanes, and then a choice: the compiler makes vector instructions of it.
            for lane in 0..LANES {
                let by = derivatives[lane];
                let mean = DECAYS[0] * means[lane] + (1.0 - DECAYS[0]) * by;
                let square = DECAYS[1] * squares[lane] + (1.0 - DECAYS[1]) * by * by;
                let value =
                    values[lane] - rate * mean / ((square / self.corrections[1]).sqrt() + EPSILON);
                means[lane] = if shown[lane] { mean } else { means[lane] };
                squares[lane] = if shown[lane] { square } else { squares[lane] };
                values[lane] = if shown[lane] { value } else { values[lane] };
            }
        }
    }

    /// The derivatives by parameters before activation, with those of the regularisers.
    #[inline(always)]
    fn raw(&self, values: &[Lanes], activated: &[Lanes], by: &[Lanes]) -> [Lanes; MAX_COLUMNS] {
        let mut raw = [Lanes([0.0; LANES]); MAX_COLUMNS];
        raw[..by.len()].copy_from_slice(by);
        let lengths = quat_lengths(values);
        for Lanes(by) in &mut raw[column::QUAT..column::LOG2_OPACITY] {
            for (by, length) in by.iter_mut().zip(lengths) {
                // The derivatives are by the unit quaternion: a longer one turns less by the same
                // step.
                *by /= length;
            }
        }
        let [by_opacity, by_scale] = self.regularisers;
        for (by, logit) in raw[LOGIT].0.iter_mut().zip(values[LOGIT].0) {
            let opacity = sigmoid(logit);
            let by_log2 = *by * std::f32::consts::LOG2_E;
            // By the logit, log2 o has the derivative (1 - o)/ln 2, and o has o (1 - o).
            *by = (1.0 - opacity) * (by_log2 + by_opacity * opacity);
        }
        for k in 0..3 {
            let Lanes(scales) = activated[column::SCALE + k];
            for (by, scale) in raw[LN_SCALE + k].0.iter_mut().zip(scales) {
                // The derivative of a scale by its logarithm is the scale.
                *by += by_scale * scale;
            }
        }
        raw
    }

    /// Moves visible Gaussians that are nearly transparent at random, along their own shape, so
    /// that they find a place where they show something. (Its authors move all, visible or not.
    /// Those that no view shows any more become transparent by no derivative either, and stay.)
    #[inline(always)]
    pub(super) fn add_noise(&self, values: &mut [Lanes], visible: u16, first_index: usize) {
        if self.noise == 0.0 {
            return;
        }
        for lane in (0..LANES).filter(|lane| visible >> lane & 1 == 1) {
            let value = |column: usize| values[column].0[lane];
            let opacity = sigmoid(value(LOGIT));
            // A half at the least opacity, and 1e-4 at 0.09 above it.
            let gate = sigmoid(-100.0 * (opacity - self.least_opacity));
            if gate < 1e-4 {
                continue;
            }
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| value(column::QUAT + k));
            let rotation = Quat::from_xyzw(x, y, z, w).normalize();
            let variance = Vec3::from_array([0, 1, 2].map(|k| (2.0 * value(LN_SCALE + k)).exp()));
            let random = normals(self.seed, first_index + lane);
            let moved = rotation * (variance * (rotation.inverse() * random));
            for (axis, moved) in (moved * gate * self.noise).to_array().into_iter().enumerate() {
                values[column::MEAN + axis].0[lane] += moved;
            }
        }
    }
}

/// The first visible lane with a derivative that is not finite, or whose square is not.
#[inline(always)]
pub(super) fn not_finite(by: &[Lanes], visible: u16) -> Option<usize> {
    let mut sums = [0.0; LANES];
    for Lanes(by) in by {
        for (sum, by) in sums.iter_mut().zip(by) {
            // 0 for a finite number, and a NaN for every other.
            *sum += by * by * 0.0;
        }
    }
    (0..LANES).find(|&lane| visible >> lane & 1 == 1 && sums[lane] != 0.0)
}

/// The length of the quaternion of each lane.
#[inline(always)]
pub(super) fn quat_lengths(values: &[Lanes]) -> [f32; LANES] {
    let mut squares = [0.0; LANES];
    for Lanes(quats) in &values[column::QUAT..column::QUAT + 4] {
        for (square, quat) in squares.iter_mut().zip(quats) {
            *square += quat * quat;
        }
    }
    squares.map(f32::sqrt)
}

/// Columns at the largest degree.
const MAX_COLUMNS: usize = columns(sh::MAX_DEGREE);

/// Three numbers of a normal distribution, by a seed and a Gaussian (Box and Muller 1958).
#[inline(always)]
fn normals(seed: u64, index: usize) -> Vec3 {
    let bits = |k: u64| mix(seed ^ mix(4 * index as u64 + k));
    let pair = |k: u64| {
        // Never 0, of which there is no logarithm.
        let radius = (-2.0 * (1.0 - to_unit(bits(k))).ln()).sqrt();
        let angle = std::f64::consts::TAU * to_unit(bits(k + 1));
        [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32]
    };
    let [x, y] = pair(0);
    let [z, _] = pair(2);
    Vec3::new(x, y, z)
}

#[inline(always)]
pub(super) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The settings' learning rates, column by column.
pub(crate) fn rates(settings: &Settings, mean: f32, sh_degree: u8, all: usize) -> Vec<f32> {
    let trained = columns(sh_degree);
    let rate = |column: usize| match column {
        column::MEAN..LN_SCALE => mean,
        LN_SCALE..column::QUAT => settings.rates.ln_scale,
        column::QUAT..LOGIT => settings.rates.quat,
        LOGIT => settings.rates.logit,
        // The constant coefficient, of three colours.
        11..14 => settings.rates.sh,
        // Degrees that are not trained yet stay as they are.
        column if column < trained => settings.rates.sh_rest,
        _ => 0.0,
    };
    (0..all).map(rate).collect()
}
