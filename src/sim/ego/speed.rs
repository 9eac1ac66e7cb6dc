//! Speed over a step: the drive follows its setpoint with a lag, and speed stays within bounds.

/// A part of a step in which speed is constant, or changes without reaching a bound or changing
/// sign.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Phase {
    /// Duration, in seconds; above zero.
    pub(super) duration_s: f64,
    /// Whether speed is constant: at a bound, or without acceleration.
    pub(super) held: bool,
    /// Speed and drive at the start.
    pub(super) drive: Drive,
    /// Speed at the end, in m/s: exactly the bound or 0 if the phase ends there.
    pub(super) end_m_s: f64,
}

/// Speed and drive: the acceleration `a` follows its setpoint with a first-order lag,
/// `da/dt = (target - a) / lag`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drive {
    /// Speed, in m/s; below 0 backwards.
    pub(super) speed_m_s: f64,
    /// Acceleration that the drive delivers, in m/s²; at a bound of speed the actual acceleration
    /// is 0.
    pub(super) acceleration_m_s2: f64,
    /// Setpoint of the acceleration, in m/s².
    pub(super) target_m_s2: f64,
    /// Its lag, in seconds.
    pub(super) lag_s: f64,
}

impl Drive {
    /// Speed after a time in seconds, without bounds, in m/s.
    pub(super) fn speed_after(&self, time_s: f64) -> f64 {
        // The integral of a(t) = target + (a - target) e^(-t / lag).
        // `exp_m1` keeps all digits where the time is much shorter than the lag.
        let lagging = self.lag_s * -(-time_s / self.lag_s).exp_m1();
        self.speed_m_s
            + self.target_m_s2 * time_s
            + (self.acceleration_m_s2 - self.target_m_s2) * lagging
    }

    /// Acceleration that the drive delivers after a time in seconds, in m/s².
    pub(super) fn acceleration_after(&self, time_s: f64) -> f64 {
        let lacking = self.acceleration_m_s2 - self.target_m_s2;
        self.target_m_s2 + lacking * (-time_s / self.lag_s).exp()
    }

    /// Divides a step into phases; also returns the drive's acceleration at its end. `bounds_m_s`
    /// are the smallest and largest speed and contain 0. A step has at most one change of the
    /// acceleration's sign, two bounds and a standstill: six phases.
    pub(super) fn phases(mut self, step_s: f64, bounds_m_s: [f64; 2]) -> (Vec<Phase>, f64) {
        let mut phases = Vec::new();
        let mut left_s = step_s;
        // Invariant: `self` is the drive when `left_s` seconds of the step are left.
        while left_s > 0.0 {
            let turns_s = self.turns_after().unwrap_or(f64::INFINITY);
            // Without acceleration, the setpoint decides the direction of the change.
            let pushes = match self.acceleration_m_s2 {
                0.0 => self.target_m_s2,
                given => given,
            };
            let [low, high] = bounds_m_s;
            // At a bound the car is held while the drive pushes against it.
            let held = pushes == 0.0
                || (pushes < 0.0 && self.speed_m_s <= low)
                || (pushes > 0.0 && self.speed_m_s >= high);
            let (duration_s, end_m_s) = if held {
                // A held phase ends when the acceleration changes its sign, because the car may
                // then leave the bound.
                (turns_s.min(left_s), self.speed_m_s)
            } else {
                self.free(turns_s.min(left_s), bounds_m_s)
            };
            phases.push(Phase { duration_s, held, drive: self, end_m_s });
            // Exactly 0 at the change of sign. A remainder of the old sign would make the same
            // phase again.
            self.acceleration_m_s2 =
                if duration_s == turns_s { 0.0 } else { self.acceleration_after(duration_s) };
            self.speed_m_s = end_m_s;
            left_s -= duration_s;
        }
        (phases, self.acceleration_m_s2)
    }

    /// Time until the acceleration changes its sign, in seconds, if it does.
    fn turns_after(&self) -> Option<f64> {
        // Solve target + (a - target) e^(-t / lag) = 0.
        let opposed = self.acceleration_m_s2 * self.target_m_s2 < 0.0;
        let ratio = (self.target_m_s2 - self.acceleration_m_s2) / self.target_m_s2;
        // A tiny opposed acceleration may give a logarithm of 0. A phase without length would not
        // end the loop.
        opposed.then(|| self.lag_s * ratio.ln()).filter(|time_s| *time_s > 0.0)
    }

    /// Time until speed reaches a bound or 0, at most `most_s`, and the speed at that time. Speed
    /// must be monotone for `most_s`.
    fn free(&self, most_s: f64, bounds_m_s: [f64; 2]) -> (f64, f64) {
        let end_m_s = self.speed_after(most_s);
        let [low, high] = bounds_m_s;
        let rises = end_m_s > self.speed_m_s;
        // Strictly between: a car that starts at a bound or at 0 does not reach it again.
        let between = |m_s: &f64| {
            if rises {
                self.speed_m_s < *m_s && *m_s < end_m_s
            } else {
                end_m_s < *m_s && *m_s < self.speed_m_s
            }
        };
        let reached = [low, 0.0, high].into_iter().filter(between);
        // The first bound on the way: the smallest if speed rises, the largest if it falls.
        let first = if rises { reached.reduce(f64::min) } else { reached.reduce(f64::max) };
        let Some(target_m_s) = first else { return (most_s, end_m_s) };
        // 64 bisections leave no f64 between the bounds; Newton's method would need care where a =
        // 0.
        // Invariant: the target is reached after `before_s` and not later than `after_s`.
        let mut before_s = 0.0;
        let mut after_s = most_s;
        for _ in 0..64 {
            let middle_s = 0.5 * (before_s + after_s);
            if (self.speed_after(middle_s) < target_m_s) == rises {
                before_s = middle_s;
            } else {
                after_s = middle_s;
            }
        }
        // The later end, so that the duration is above zero.
        (after_s, target_m_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(speed_m_s: f64, acceleration_m_s2: f64, target_m_s2: f64) -> Drive {
        Drive { speed_m_s, acceleration_m_s2, target_m_s2, lag_s: 0.1 }
    }

    #[test]
    fn a_car_that_brakes_stands_and_does_not_roll_back() {
        let (phases, given) = drive(0.3, -5.0, -5.0).phases(0.1, [0.0, 60.0]);
        assert_eq!(phases.len(), 2, "{phases:?}");
        // 0.3 m/s at 5 m/s² takes 0.06 s; 0.04 s of the step are left.
        assert!((phases[0].duration_s - 0.06).abs() < 1e-12 && phases[0].end_m_s == 0.0);
        assert!(phases[1].held && (phases[1].duration_s - 0.04).abs() < 1e-12);
        assert_eq!((phases[1].end_m_s, given), (0.0, -5.0));
    }

    #[test]
    fn it_stands_until_the_drive_pushes() {
        // -5 + 10 (1 - e^(-t / 0.1)) is 0 after 0.1 ln 2 s.
        let (phases, given) = drive(0.0, -5.0, 5.0).phases(0.1, [0.0, 60.0]);
        let release_s = 0.1 * std::f64::consts::LN_2;
        assert!(phases[0].held && (phases[0].duration_s - release_s).abs() < 1e-15);
        assert!(!phases[1].held && phases[1].end_m_s > 0.0, "{phases:?}");
        // After 0.1 s, one lag, the drive lacks 1/e of the change from -5 to 5 m/s².
        assert!((given - (5.0 - 10.0 * (-1f64).exp())).abs() < 1e-12, "{given}");
    }

    #[test]
    fn phases_fill_the_step_and_join() {
        for bounds in [[0.0, 60.0], [-10.0, 60.0]] {
            // The speeds are at and next to standstill and the upper bound, where phases are
            // shortest.
            for speed in [0.0, 1e-9, 0.2, 59.9, 60.0] {
                for given in [-9.8, -1.0, 0.0, 9.8] {
                    for told in [-9.8, 0.0, 1e-9, 9.8] {
                        let start = drive(speed, given, told);
                        let (phases, end) = start.phases(1.0, bounds);
                        let total_s: f64 = phases.iter().map(|phase| phase.duration_s).sum();
                        // A rounding error of each phase is at most 2e-16 s.
                        assert!((total_s - 1.0).abs() < 1e-15 && phases.len() <= 6);
                        assert!((end - start.acceleration_after(1.0)).abs() < 1e-12);
                        for pair in phases.windows(2) {
                            assert_eq!(pair[0].end_m_s, pair[1].drive.speed_m_s, "{phases:?}");
                        }
                        let within = |m_s: f64| (bounds[0]..=bounds[1]).contains(&m_s);
                        assert!(phases.iter().all(|phase| within(phase.end_m_s)), "{phases:?}");
                    }
                }
            }
        }
    }
}
