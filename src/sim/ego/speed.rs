//! Speed over a step: what is told to the drive comes with a lag, and speed stays within bounds.

/// A stretch of a step in which speed is constant, or moves without a bound and without changing sign.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Phase {
    /// How long it lasts, in seconds; above zero.
    pub(super) duration_s: f64,
    /// Whether speed is constant: at a bound, or because nothing pushes.
    pub(super) held: bool,
    /// Speed and drive at its start.
    pub(super) drive: Drive,
    /// Speed at its end, in m/s: exactly the bound, or 0, where it ends there.
    pub(super) end_m_s: f64,
}

/// Speed and its drive: the acceleration `a` follows what it is told, `da/dt = (told - a) / lag`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drive {
    /// Speed, in m/s; below 0 backwards.
    pub(super) speed_m_s: f64,
    /// What the drive gives, in m/s²; at a bound of speed more than happens.
    pub(super) acceleration_m_s2: f64,
    /// What it is told to give, in m/s².
    pub(super) target_m_s2: f64,
    /// Its lag, in seconds.
    pub(super) lag_s: f64,
}

impl Drive {
    /// Speed after a time in seconds, if no bound holds it.
    pub(super) fn speed_after(&self, time_s: f64) -> f64 {
        // The integral of a(t) = told + (a - told) e^(-t / lag).
        let lagging = self.lag_s * -(-time_s / self.lag_s).exp_m1();
        self.speed_m_s
            + self.target_m_s2 * time_s
            + (self.acceleration_m_s2 - self.target_m_s2) * lagging
    }

    /// What the drive gives after a time in seconds, in m/s².
    pub(super) fn acceleration_after(&self, time_s: f64) -> f64 {
        let lacking = self.acceleration_m_s2 - self.target_m_s2;
        self.target_m_s2 + lacking * (-time_s / self.lag_s).exp()
    }

    /// Cuts a step into phases; also what the drive gives at its end. `bounds_m_s` hold the speed, 0 lies
    /// within or on them. At most one change of the acceleration's sign, two bounds and a standstill lie
    /// in a step: six phases.
    pub(super) fn phases(mut self, step_s: f64, bounds_m_s: [f64; 2]) -> (Vec<Phase>, f64) {
        let mut phases = Vec::new();
        let mut left_s = step_s;
        while left_s > 0.0 {
            let turns_s = self.turns_after().unwrap_or(f64::INFINITY);
            // At rest it begins as it is told.
            let pushes = match self.acceleration_m_s2 {
                0.0 => self.target_m_s2,
                given => given,
            };
            let [low, high] = bounds_m_s;
            let held = pushes == 0.0
                || (pushes < 0.0 && self.speed_m_s <= low)
                || (pushes > 0.0 && self.speed_m_s >= high);
            let (duration_s, end_m_s) = if held {
                (turns_s.min(left_s), self.speed_m_s)
            } else {
                self.free(turns_s.min(left_s), bounds_m_s)
            };
            phases.push(Phase { duration_s, held, drive: self, end_m_s });
            self.acceleration_m_s2 =
                if duration_s == turns_s { 0.0 } else { self.acceleration_after(duration_s) };
            self.speed_m_s = end_m_s;
            left_s -= duration_s;
        }
        (phases, self.acceleration_m_s2)
    }

    /// When the drive changes from braking to pushing or back, in seconds, if it does.
    fn turns_after(&self) -> Option<f64> {
        // told + (a - told) e^(-t / lag) = 0.
        let opposed = self.acceleration_m_s2 * self.target_m_s2 < 0.0;
        let ratio = (self.target_m_s2 - self.acceleration_m_s2) / self.target_m_s2;
        opposed.then(|| self.lag_s * ratio.ln()).filter(|time_s| *time_s > 0.0)
    }

    /// How long speed, which only rises or only falls for `most_s`, moves without reaching a bound or 0;
    /// and where it is then.
    fn free(&self, most_s: f64, bounds_m_s: [f64; 2]) -> (f64, f64) {
        let end_m_s = self.speed_after(most_s);
        let [low, high] = bounds_m_s;
        let rises = end_m_s > self.speed_m_s;
        let between = |m_s: &f64| {
            if rises {
                self.speed_m_s < *m_s && *m_s < end_m_s
            } else {
                end_m_s < *m_s && *m_s < self.speed_m_s
            }
        };
        let reached = [low, 0.0, high].into_iter().filter(between);
        let first = if rises { reached.reduce(f64::min) } else { reached.reduce(f64::max) };
        let Some(target_m_s) = first else { return (most_s, end_m_s) };
        // Halving 64 times leaves no f64 between; Newton's method would need care where a = 0.
        let (mut before_s, mut after_s) = (0.0, most_s);
        for _ in 0..64 {
            let middle_s = 0.5 * (before_s + after_s);
            if (self.speed_after(middle_s) < target_m_s) == rises {
                before_s = middle_s;
            } else {
                after_s = middle_s;
            }
        }
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
        assert!((given - (5.0 - 10.0 * (-1f64).exp())).abs() < 1e-12, "{given}");
    }

    #[test]
    fn phases_fill_the_step_and_join() {
        for bounds in [[0.0, 60.0], [-10.0, 60.0]] {
            for speed in [0.0, 1e-9, 0.2, 59.9, 60.0] {
                for given in [-9.8, -1.0, 0.0, 9.8] {
                    for told in [-9.8, 0.0, 1e-9, 9.8] {
                        let start = drive(speed, given, told);
                        let (phases, end) = start.phases(1.0, bounds);
                        let total_s: f64 = phases.iter().map(|phase| phase.duration_s).sum();
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
