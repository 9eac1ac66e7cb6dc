//! The settings of a training run, and where each default is from.
//!
//! The reaches of poses and the small images: measured on the demo street. The project's paper: the
//! learning rate of means and its fall, the degree, the weight of depths,
//! the least opacity. gsplat's trainer by Markov chain Monte Carlo: the other learning rates, the
//! losses, 30,000 steps and the growth within them, which make a small twin; the paper's 600,000
//! steps grow by 0.5 % from step 10,000 to 60,000. The first author's code: the noise.

use std::f64::consts::PI;

use documented::DocumentedFields;
use serde::{Deserialize, Serialize};
use wildcity_scene::sky::Network;

/// The settings of a run, as in a file `train.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Steps, each on one image. Schedules are given for 30,000 and scaled to this number.
    pub steps: usize,
    /// Seed of the order of images, and of all random numbers.
    pub seed: u64,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Share of the steps that are made on images which were rendered and repaired, if there are
    /// such.
    pub augmented_share: f64,
    /// Learning rates of Adam, with decay 0.9 and 0.999.
    pub rates: Rates,
    /// Weights of the losses.
    pub loss: Weights,
    /// How many steps learn from small images.
    pub coarse: CoarseSettings,
    /// How the number of Gaussians grows.
    pub growth: Growth,
    /// How poses are trained.
    pub poses: PoseSettings,
    /// What lies behind the Gaussians: a network.
    pub sky: SkySettings,
    /// An exposure for each image.
    pub exposure: ExposureSettings,
    /// Terms of the Gaussians that begin on the ground.
    pub ground: GroundSettings,
}

/// Learning rates of Adam, with decay 0.9 and 0.999.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct Rates {
    /// Of the means, in metres. It falls exponentially to a hundredth.
    pub mean: f32,
    /// Of the logarithms of the standard deviations.
    pub ln_scale: f32,
    /// Of the quaternions of the rotations.
    pub quat: f32,
    /// Of the logits of the opacities.
    pub logit: f32,
    /// Of the constant coefficient of the colours.
    pub sh: f32,
    /// Of their other coefficients.
    pub sh_rest: f32,
}

/// Weights of the losses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
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
    /// Of the mean opacity of the pixels that show the sky.
    pub sky: f64,
}

/// How many steps learn from small images. They cost less, and the gradient of what lies wrong by
/// many pixels points to its place; on a large image it points to some detail that is nearer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct CoarseSettings {
    /// How often the images of the first steps are halved: 2 begins with a quarter of the width.
    pub halvings: u32,
    /// The first step of 30,000 on whole images. All smaller sizes have as many steps before it.
    pub until: usize,
}

/// How the number of Gaussians grows, after 3D Gaussian splatting as Markov chain Monte Carlo
/// (Kheradmand et al. 2024).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct Growth {
    /// Largest number of Gaussians. If neither a settings file nor --cap says it, there is at most
    /// one for each 32 pixels of the images, too.
    pub cap: usize,
    /// Growth of their number each time of a run of 30,000 steps; of shorter ones more.
    pub rate: f64,
    /// Steps from one time to the next, whatever the number of steps.
    pub every: usize,
    /// First step of growth, of 30,000.
    pub from: usize,
    /// Last step of growth, of 30,000.
    pub until: usize,
    /// Gaussians with a smaller opacity are moved to others.
    pub least_opacity: f32,
    /// Noise of the means, in learning rates.
    pub noise: f32,
}

/// Which poses are trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PoseMode {
    /// `Rig` for images of a rig, and `Off` for others.
    Auto,
    Off,
    /// One for each image.
    Image,
    /// One for each time of the rig, and one for each of its cameras.
    Rig,
}

/// How poses are trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct PoseSettings {
    /// Which: `rig`, one for each time of the rig and one for each of its cameras; `image`, one
    /// for each image; `off`, none; `auto`, `rig` for images of a rig and `off` for others.
    pub mode: PoseMode,
    /// About how far a pose of the rig, or of an image, moves along each axis if all steps of a run
    /// agree, in metres.
    pub reach_m: f64,
    /// About how far it turns about each axis, in radians.
    pub reach_rad: f64,
    /// About how far a camera moves on its rig along each axis, in metres.
    pub camera_reach_m: f64,
    /// About how far it turns there about each axis, in radians.
    pub camera_reach_rad: f64,
    /// Weight of the squared distance to the recorded pose, in metres and radians.
    pub weight: f64,
}

/// What lies behind the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SkyMode {
    /// `Network` for images of a rig, and `Off` for others.
    Auto,
    /// The background of the render profile.
    Off,
    /// A network that is trained.
    Network,
}

/// The network of a sky, and how it is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct SkySettings {
    /// `network`, trained; `off`, none; `auto`, `network` for images of a rig and `off` for others.
    pub mode: SkyMode,
    /// Octaves of sines and cosines of a direction.
    pub octaves: usize,
    /// Width of both hidden layers.
    pub width: usize,
    /// Numbers of an image's appearance.
    pub embedding: usize,
    /// Learning rate of the network.
    pub rate: f64,
    /// Learning rate of the appearances.
    pub embedding_rate: f64,
}

/// Whether each image has an exposure of its own, and how it is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct ExposureSettings {
    /// Whether exposures are trained.
    pub on: bool,
    /// Learning rate of the exposures.
    pub rate: f64,
    /// Weight of the squared distance to the identity.
    pub weight: f64,
}

/// The terms of the ground, of Gaussians that began on it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, DocumentedFields)]
#[serde(deny_unknown_fields, default)]
pub struct GroundSettings {
    /// Weight of the standard deviation of heights in a slice, in 1/m.
    pub height: f32,
    /// Weight of `1 - |up · shortest axis|`.
    pub upright: f32,
    /// Weight of `(1 - opacity)²`.
    pub opaque: f32,
    /// Length of a slice along the direction of driving, in metres.
    pub slice_m: f32,
    /// The weights are whole until this step of 30,000.
    pub whole_until: usize,
    /// From then they fall to 0 at this step of 30,000.
    pub until: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            steps: 7_000,
            seed: 0,
            sh_degree: 1,
            augmented_share: 0.3,
            rates: Rates::default(),
            loss: Weights::default(),
            coarse: CoarseSettings::default(),
            growth: Growth::default(),
            poses: PoseSettings::default(),
            sky: SkySettings::default(),
            exposure: ExposureSettings::default(),
            ground: GroundSettings::default(),
        }
    }
}

impl Default for CoarseSettings {
    fn default() -> Self {
        Self { halvings: 2, until: 12_000 }
    }
}

impl Default for PoseSettings {
    fn default() -> Self {
        Self {
            mode: PoseMode::Auto,
            reach_m: 0.3,
            reach_rad: 0.06,
            camera_reach_m: 0.01,
            camera_reach_rad: 0.015,
            weight: 1e-5,
        }
    }
}

impl Default for SkySettings {
    fn default() -> Self {
        Self {
            mode: SkyMode::Auto,
            octaves: 6,
            width: 64,
            embedding: 16,
            rate: 1e-3,
            embedding_rate: 1e-2,
        }
    }
}

impl Default for ExposureSettings {
    fn default() -> Self {
        Self { on: false, rate: 1e-3, weight: 1e-3 }
    }
}

impl Default for GroundSettings {
    fn default() -> Self {
        Self {
            height: 0.01,
            upright: 0.01,
            opaque: 0.01,
            slice_m: 2.0,
            whole_until: 10_000,
            until: 20_000,
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
            // A twentieth of the constant's, as in the code of Kerbl et al. 2023.
            sh_rest: 2.5e-3 / 20.0,
        }
    }
}

impl Default for Weights {
    fn default() -> Self {
        Self { dssim: 0.2, opacity: 0.01, scale: 0.01, disparity: 0.1, sky: 0.1 }
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

/// What a field is, of a section or, with "", of the settings themselves.
fn doc(section: &str, field: &str) -> Result<&'static str, documented::Error> {
    match section {
        "rates" => Rates::get_field_docs(field),
        "loss" => Weights::get_field_docs(field),
        "coarse" => CoarseSettings::get_field_docs(field),
        "growth" => Growth::get_field_docs(field),
        "poses" => PoseSettings::get_field_docs(field),
        "sky" => SkySettings::get_field_docs(field),
        "exposure" => ExposureSettings::get_field_docs(field),
        "ground" => GroundSettings::get_field_docs(field),
        _ => Settings::get_field_docs(field),
    }
}

/// Why settings were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{field} is {value}; it is from {least} to {most}")]
pub struct SettingError {
    field: &'static str,
    value: f64,
    least: f64,
    most: f64,
}

/// A rate of 10 leaves the street in a step.
const MOST_RATE: f64 = 10.0;

/// In metres: a recording that is farther off has to be placed first.
const MOST_REACH_M: f64 = 100.0;

const MOST_WEIGHT: f64 = 1e6;

/// Steps for which the schedules are given.
const SCHEDULE: usize = 30_000;

impl Settings {
    /// The settings as a TOML file, with a comment above each.
    ///
    /// # Errors
    /// A value that TOML does not have.
    pub fn to_commented_toml(&self) -> Result<String, toml::ser::Error> {
        let mut text = String::new();
        // Plain fields come before all tables in TOML, and so have no section.
        let mut section = "";
        let plain = toml::to_string_pretty(self)?;
        for line in plain.lines() {
            let name = line.strip_prefix('[').and_then(|line| line.strip_suffix(']'));
            // A line is the header of a section, a field with its value, or empty.
            let doc = match (name, line.split_once(" = ")) {
                (Some(name), _) => {
                    section = name;
                    Self::get_field_docs(name)
                }
                (None, Some((field, _))) => doc(section, field),
                (None, None) => Ok(""),
            };
            for doc in doc.unwrap_or_default().lines() {
                text.extend(["# ", doc.trim(), "\n"]);
            }
            text.extend([line, "\n"]);
        }
        Ok(text)
    }

    /// Checks that every field is in its range.
    ///
    /// # Errors
    /// The first field out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        let Self { rates, loss, coarse, growth, poses, sky, exposure, ground, .. } = self;
        let rates = [
            ("rates.mean", rates.mean.into()),
            ("rates.ln_scale", rates.ln_scale.into()),
            ("rates.quat", rates.quat.into()),
            ("rates.logit", rates.logit.into()),
            ("rates.sh", rates.sh.into()),
            ("rates.sh_rest", rates.sh_rest.into()),
            ("sky.rate", sky.rate),
            ("sky.embedding_rate", sky.embedding_rate),
            ("exposure.rate", exposure.rate),
        ];
        let weights = [
            ("loss.opacity", loss.opacity.into()),
            ("loss.scale", loss.scale.into()),
            ("loss.disparity", loss.disparity),
            ("loss.sky", loss.sky),
            ("growth.noise", growth.noise.into()),
            ("poses.weight", poses.weight),
            ("exposure.weight", exposure.weight),
            ("ground.height", ground.height.into()),
            ("ground.upright", ground.upright.into()),
            ("ground.opaque", ground.opaque.into()),
        ];
        // f64 holds every integer up to 2^53, which is far above these bounds.
        let range = |field, value: usize, least: usize, most: usize| {
            (field, value as f64, least as f64, most as f64)
        };
        let others = [
            range("steps", self.steps, 1, 10_000_000),
            range("sh_degree", self.sh_degree.into(), 0, 3),
            ("augmented_share", self.augmented_share, 0.0, 1.0),
            ("loss.dssim", loss.dssim, 0.0, 1.0),
            range("coarse.halvings", coarse.halvings as usize, 0, 8),
            range("coarse.until", coarse.until, 0, SCHEDULE),
            ("poses.reach_m", poses.reach_m, 0.0, MOST_REACH_M),
            ("poses.reach_rad", poses.reach_rad, 0.0, PI),
            ("poses.camera_reach_m", poses.camera_reach_m, 0.0, MOST_REACH_M),
            ("poses.camera_reach_rad", poses.camera_reach_rad, 0.0, PI),
            range("growth.cap", growth.cap, 1, 100_000_000),
            ("growth.rate", growth.rate, 0.0, 1.0),
            ("growth.least_opacity", growth.least_opacity.into(), 0.0, 0.5),
            range("growth.every", growth.every, 1, SCHEDULE),
            range("growth.until", growth.until, 0, SCHEDULE),
            // After `until`, which is its bound.
            range("growth.from", growth.from, 0, growth.until),
            range("sky.octaves", sky.octaves, 0, Network::MAX_OCTAVES),
            range("sky.width", sky.width, 1, Network::MAX_WIDTH),
            range("sky.embedding", sky.embedding, 0, Network::MAX_APPEARANCE),
            ("ground.slice_m", ground.slice_m.into(), 0.1, 1e3),
            range("ground.until", ground.until, 0, SCHEDULE),
            range("ground.whole_until", ground.whole_until, 0, ground.until),
        ];
        let rates = rates.map(|(field, value)| (field, value, 0.0, MOST_RATE));
        let weights = weights.map(|(field, value)| (field, value, 0.0, MOST_WEIGHT));
        for (field, value, least, most) in rates.into_iter().chain(weights).chain(others) {
            // A NaN is in no range.
            if !(least..=most).contains(&value) {
                return Err(SettingError { field, value, least, most });
            }
        }
        Ok(())
    }

    /// The number of Gaussians at each step of a run that begins with `start`, if all stay opaque:
    /// the most that a run can have.
    pub fn counts(&self, start: usize) -> impl Iterator<Item = usize> {
        let mut count = start;
        (1..=self.steps).map(move |step| {
            if self.grows_at(step) {
                count += self.added(count);
            }
            count
        })
    }

    /// How often the image of a step is halved, from 1 for the first step.
    pub fn halvings_at(&self, step: usize) -> u32 {
        let CoarseSettings { halvings, until } = self.coarse;
        let until = self.scaled(until);
        // All sizes have the same number of steps, and the last of them ends before `until`.
        let left = until.saturating_sub(step);
        (left as f64 * f64::from(halvings) / until.max(1) as f64).ceil() as u32
    }

    /// The first step on whole images.
    pub(crate) fn first_whole_step(&self) -> usize {
        if self.coarse.halvings == 0 { 1 } else { self.scaled(self.coarse.until).max(1) }
    }

    /// Whether Gaussians are moved and added after a step.
    pub(crate) fn grows_at(&self, step: usize) -> bool {
        let Growth { from, until, every, .. } = self.growth;
        let [from, until] = [from, until].map(|step| self.scaled(step));
        // In short runs as often as in long ones: opacities take their time to fall.
        step.is_multiple_of(every) && step >= from && step < until
    }

    /// How many Gaussians are added to some at a time. In a run of fewer steps there are fewer
    /// times, and more are added at each, so that it ends with as many; at most their number
    /// doubles.
    pub(crate) fn added(&self, count: usize) -> usize {
        let Growth { rate, cap, .. } = self.growth;
        let factor = (1.0 + rate).powf(SCHEDULE as f64 / self.steps as f64).min(2.0);
        ((factor * count as f64).ceil() as usize).min(cap).saturating_sub(count)
    }

    /// A step of a schedule of 30,000 as one of this run.
    pub(crate) fn scaled(&self, step: usize) -> usize {
        (step as f64 * self.steps as f64 / SCHEDULE as f64).round() as usize
    }

    /// A step of this run as one of a schedule of 30,000.
    pub(crate) fn unscaled(&self, step: usize) -> usize {
        (step as f64 * SCHEDULE as f64 / self.steps as f64).round() as usize
    }
}

impl GroundSettings {
    /// How much the terms count at a step of 30,000: whole, then less and less.
    pub(crate) fn share(&self, step: usize) -> f32 {
        if step < self.whole_until {
            return 1.0;
        }
        // `check` has found `until` not below `whole_until`. If they are equal, the terms end at
        // once, and 1 avoids 0 / 0.
        let fading = (self.until - self.whole_until).max(1) as f32;
        (self.until.saturating_sub(step) as f32 / fading).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_setting_has_a_comment() {
        let settings = Settings::default();
        let text = settings.to_commented_toml().unwrap();
        assert_eq!(toml::from_str::<Settings>(&text).unwrap(), settings);
        let mut above = "";
        for line in text.lines() {
            let is_named = line.contains(" = ") || line.starts_with('[');
            assert!(!is_named || above.starts_with("# "), "{line} below {above:?}");
            above = line;
        }
        assert!(text.contains("# Gaussians with a smaller opacity are moved to others.\nleast_"));
    }

    #[test]
    fn images_become_larger_in_equal_parts() {
        let coarse = CoarseSettings { halvings: 2, until: 12_000 };
        let settings = Settings { steps: 300, coarse, ..Settings::default() };
        let count = |halvings| (1..=300).filter(|&k| settings.halvings_at(k) == halvings).count();
        assert_eq!([2, 1, 0].map(count), [59, 60, 181]);
        assert_eq!([1, 60, 120, 300].map(|step| settings.halvings_at(step)), [2, 1, 0, 0]);
        assert_eq!(settings.first_whole_step(), 120);
        let whole = Settings { coarse: CoarseSettings { halvings: 0, ..coarse }, ..settings };
        assert_eq!([whole.halvings_at(1) as usize, whole.first_whole_step()], [0, 1]);
    }
}
