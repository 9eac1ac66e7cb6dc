//! The settings of a training run, and where each default is from.
//!
//! The project's paper: the learning rate of means and its fall, the degree, the weight of depths,
//! the least opacity. gsplat's trainer by Markov chain Monte Carlo: the other learning rates, the
//! losses, 30,000 steps and the growth within them, which make a small twin; the paper's 600,000
//! steps grow by 0.5 % from step 10,000 to 60,000. The first author's code: the noise.

use serde::{Deserialize, Serialize};

/// The settings of a run, as in a file `train.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Steps, each on one image. Schedules are given for 30,000 and scaled to this number.
    pub steps: usize,
    /// Of the order of images, and of all random numbers.
    pub seed: u64,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    pub rates: Rates,
    pub loss: Weights,
    pub growth: Growth,
}

/// Learning rates of Adam, with decay 0.9 and 0.999.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Rates {
    /// In metres. It falls exponentially to a hundredth.
    pub mean: f32,
    pub ln_scale: f32,
    pub quat: f32,
    pub logit: f32,
    /// Of the constant coefficient.
    pub sh: f32,
    /// Of the other coefficients.
    pub sh_rest: f32,
}

/// Weights of the losses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Weights {
    /// Of D-SSIM; that of L1 is the rest to 1.
    pub dssim: f64,
    /// Of the mean opacity.
    pub opacity: f32,
    /// Of the mean standard deviation.
    pub scale: f32,
    /// Of the disparity of measured depths.
    pub disparity: f64,
}

/// How the number of Gaussians grows, after 3D Gaussian splatting as Markov chain Monte Carlo
/// (Kheradmand et al. 2024).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Growth {
    pub cap: usize,
    /// Growth of their number each time.
    pub rate: f64,
    /// Steps from one time to the next, whatever the number of steps.
    pub every: usize,
    /// First and last step, of 30,000.
    pub from: usize,
    pub until: usize,
    /// Gaussians with a smaller opacity are moved to others.
    pub least_opacity: f32,
    /// Noise of the means, in learning rates.
    pub noise: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            steps: 7_000,
            seed: 0,
            sh_degree: 1,
            rates: Rates::default(),
            loss: Weights::default(),
            growth: Growth::default(),
        }
    }
}

impl Default for Rates {
    fn default() -> Self {
        Self {
            mean: 2e-3,
            ln_scale: 5e-3,
            quat: 1e-3,
            logit: 5e-2,
            sh: 2.5e-3,
            sh_rest: 2.5e-3 / 20.0,
        }
    }
}

impl Default for Weights {
    fn default() -> Self {
        Self { dssim: 0.2, opacity: 0.01, scale: 0.01, disparity: 0.1 }
    }
}

impl Default for Growth {
    fn default() -> Self {
        Self {
            cap: 1_000_000,
            rate: 0.05,
            every: 100,
            from: 500,
            until: 25_000,
            least_opacity: 0.005,
            noise: 5e2,
        }
    }
}

/// Why settings were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{field} is {value}; {must}")]
pub struct SettingError {
    field: &'static str,
    value: String,
    must: &'static str,
}

impl Settings {
    /// Checks that every field is in its range.
    ///
    /// # Errors
    /// The first field out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        let Rates { mean, ln_scale, quat, logit, sh, sh_rest } = self.rates;
        let rates = [
            ("rates.mean", mean),
            ("rates.ln_scale", ln_scale),
            ("rates.quat", quat),
            ("rates.logit", logit),
            ("rates.sh", sh),
            ("rates.sh_rest", sh_rest),
            ("loss.opacity", self.loss.opacity),
            ("loss.scale", self.loss.scale),
            ("growth.noise", self.growth.noise),
            ("loss.disparity", self.loss.disparity as f32),
        ];
        for (field, value) in rates {
            // A rate of 10 leaves the street in a step.
            let most = if field.starts_with("rates") { 10.0 } else { 1e6 };
            if !(0.0..=most).contains(&value) {
                let must = "it is a number from 0 to 1e6; a rate, to 10";
                return Err(SettingError { field, value: value.to_string(), must });
            }
        }
        let least_opacity = f64::from(self.growth.least_opacity);
        let weights = [
            ("loss.dssim", self.loss.dssim, 1.0),
            ("growth.rate", self.growth.rate, 1.0),
            ("growth.least_opacity", least_opacity, 0.5),
        ];
        for (field, value, most) in weights {
            if !(0.0..=most).contains(&value) {
                let must = if most == 1.0 { "it is from 0 to 1" } else { "it is from 0 to 0.5" };
                return Err(SettingError { field, value: value.to_string(), must });
            }
        }
        let counts = [
            ("steps", self.steps, 1, 10_000_000, "it is from 1 to 10,000,000"),
            ("sh_degree", self.sh_degree.into(), 0, 3, "it is from 0 to 3"),
            ("growth.cap", self.growth.cap, 1, 100_000_000, "it is from 1 to 100,000,000"),
            ("growth.every", self.growth.every, 1, 30_000, "it is from 1 to 30,000"),
            ("growth.from", self.growth.from, 0, self.growth.until, "it is not after growth.until"),
            ("growth.until", self.growth.until, 0, 30_000, "it is at most 30,000"),
        ];
        for (field, value, least, most, must) in counts {
            if value < least || value > most {
                return Err(SettingError { field, value: value.to_string(), must });
            }
        }
        Ok(())
    }

    /// A step of a schedule of 30,000 as one of this run.
    pub(crate) fn scaled(&self, step: usize) -> usize {
        (step as f64 * self.steps as f64 / 30_000.0).round() as usize
    }
}
