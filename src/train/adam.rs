//! Adam (Kingma and Ba 2015) for parameters that are few: poses, exposures, the network of a sky.

use serde::{Deserialize, Serialize};

/// Decays of the two moments.
pub(crate) const DECAYS: [f64; 2] = [0.9, 0.999];

/// The moments of some parameters that move together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Adam {
    /// The moving means of each derivative and of its square.
    moments: Vec<[f64; 2]>,
    /// Steps that have moved these parameters: those of a pose are fewer than those of a run.
    steps: i32,
}

impl Adam {
    pub(crate) fn new(parameters: usize) -> Self {
        Self { moments: vec![[0.0; 2]; parameters], steps: 0 }
    }

    /// What to add to each parameter, given the derivatives by all of them.
    pub(crate) fn step(&mut self, by: &[f64], rate: f64) -> Vec<f64> {
        self.steps += 1;
        // Both means begin at 0, and are too small by these factors.
        let corrections = DECAYS.map(|decay| 1.0 - decay.powi(self.steps));
        let mut moves = Vec::with_capacity(by.len());
        for ([mean, square], &by) in self.moments.iter_mut().zip(by) {
            *mean += (1.0 - DECAYS[0]) * (by - *mean);
            *square += (1.0 - DECAYS[1]) * (by * by - *square);
            // A derivative that was always 0 moves nothing: 0/0 would be a NaN.
            let root = (*square / corrections[1]).sqrt().max(f64::MIN_POSITIVE);
            moves.push(-rate * *mean / corrections[0] / root);
        }
        moves
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_steps_have_the_size_of_the_rate() {
        let mut adam = Adam::new(3);
        let moves = adam.step(&[1e-9, -300.0, 0.0], 0.1);
        assert!((moves[0] + 0.1).abs() < 1e-12 && (moves[1] - 0.1).abs() < 1e-12);
        assert_eq!(moves[2], 0.0);
    }

    #[test]
    fn the_lowest_point_of_a_bowl_is_found() {
        let mut adam = Adam::new(2);
        let mut at = [1.0, -2.0];
        for step in 0..2_000 {
            let by = [2.0 * (at[0] - 0.3), 20.0 * (at[1] - 0.1)];
            let moves = adam.step(&by, 0.02 * 0.998_f64.powi(step));
            at = [at[0] + moves[0], at[1] + moves[1]];
        }
        assert!((at[0] - 0.3).abs() < 1e-3 && (at[1] - 0.1).abs() < 1e-3, "{at:?}");
    }
}
