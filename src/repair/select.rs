//! Selects the views of a step that are repaired: by trust, with hysteresis, and at most
//! [`Selection::per_step`] of them.
//!
//! Trust is 1 on the recorded drive, so nothing is repaired there. Two thresholds (hysteresis)
//! prevent repair from switching on and off between steps, which would be visible as flicker. The
//! selection does not depend on a clock: its budget is a number of images, so that a replay makes
//! the same decisions.

use serde::{Deserialize, Serialize};

/// The thresholds of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Selection {
    /// Repair of a camera begins when its trust falls below this value (about 1.4 m off the drive).
    pub below: f64,
    /// Repair of a camera ends when its trust rises above this value (about 0.8 m off the drive).
    pub above: f64,
    /// Below this trust nothing is repaired, because a model would hallucinate the image.
    pub at_least: f64,
    /// Largest number of repaired images per step: those with the least trust; of equal trust, the
    /// first cameras.
    pub per_step: usize,
}

impl Default for Selection {
    fn default() -> Self {
        Selection { below: 0.75, above: 0.85, at_least: 0.1, per_step: 16 }
    }
}

/// The decision for a step.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Per camera: whether it is in repair after this step. The `before` of the next step.
    pub is_on: Vec<bool>,
    /// The cameras to repair now, by index, in ascending order.
    pub cameras: Vec<usize>,
}

impl Selection {
    /// Checks the thresholds.
    ///
    /// # Errors
    /// The field that is wrong, and its value with what is accepted.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        let fields = [("below", self.below), ("above", self.above), ("at_least", self.at_least)];
        for (field, value) in fields {
            if !(0.0..=1.0).contains(&value) {
                return Err((field, format!("{value:?}; trust is 0 to 1")));
            }
        }
        // Equal thresholds are allowed: no hysteresis.
        if self.above < self.below {
            let Selection { above, below, .. } = self;
            let must = format!("{above:?}, less than below ({below:?}); give at least {below:?}");
            return Err(("above", must));
        }
        if self.at_least > self.below {
            let Selection { at_least, below, .. } = self;
            let must =
                format!("{at_least:?}, more than below ({below:?}); nothing would be repaired");
            return Err(("at_least", must));
        }
        Ok(())
    }

    /// Whether a camera is in repair at a trust, given whether it was after the previous step.
    fn is_on(&self, was_on: bool, trust: f64) -> bool {
        // `is_on` goes on below `at_least`, so that repair resumes when the trust returns.
        if was_on { trust <= self.above } else { trust < self.below }
    }

    /// Whether an image may be repaired, if `per_step` leaves room for it.
    pub fn is_candidate(&self, was_on: bool, trust: f64) -> bool {
        self.is_on(was_on, trust) && trust >= self.at_least
    }

    /// Decides a step. `trust` has a value per camera; `before` marks the cameras that were in
    /// repair after the previous step, and is empty after a reset and for single observations,
    /// which have no history. A trust that is not a number counts as 0.
    pub fn decide(&self, before: &[bool], trust: &[f64]) -> Decision {
        let trust: Vec<f64> = trust.iter().map(|t| if t.is_nan() { 0.0 } else { *t }).collect();
        let was_on = |camera: usize| before.get(camera).copied().unwrap_or(false);
        let is_on = |camera: usize| self.is_on(was_on(camera), trust[camera]);
        let is_chosen = |camera: &usize| self.is_candidate(was_on(*camera), trust[*camera]);
        let mut cameras: Vec<usize> = (0..trust.len()).filter(is_chosen).collect();
        let is_on: Vec<bool> = (0..trust.len()).map(is_on).collect();
        // By trust for the budget, then back to the order of cameras for the caller.
        cameras.sort_by(|a, b| trust[*a].total_cmp(&trust[*b]).then(a.cmp(b)));
        cameras.truncate(self.per_step);
        cameras.sort_unstable();
        Decision { is_on, cameras }
    }
}
