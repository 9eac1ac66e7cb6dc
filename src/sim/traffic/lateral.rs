//! Lateral manoeuvres of an actor on its course: from one offset to another by a quintic, or by a
//! given shape.

use super::script::{Over, Shape};

/// The offset from the course, to the left, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lateral {
    /// Coefficients of the polynomial in the manoeuvre's time, in seconds: metres, m/s, m/s² and so
    /// on.
    coefficients: [f64; 6],
    /// Elapsed time of the manoeuvre, in seconds. It stops while the actor stands.
    elapsed_s: f64,
    /// Elapsed time at which the manoeuvre ends, in seconds.
    duration_s: f64,
    /// Offset at which the manoeuvre ends, in metres.
    target_m: f64,
    pace: Pace,
    /// The profile, if it is no polynomial.
    profile: Option<Profile>,
}

/// How fast a manoeuvre runs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Pace {
    /// Reference speed, in m/s: the actor's speed at the start of the manoeuvre, at least 1. At
    /// this speed or above the manoeuvre runs in real time; below it, in proportion to the speed.
    Speed(f64),
    /// In real time, while the actor moves.
    Time,
    /// Its time is the actor's way, in metres.
    Distance,
}

/// A change of the offset by a shape.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Profile {
    from_m: f64,
    shape: Shape,
}

/// Slower than this, an actor does not move aside, in m/s.
const STANDS_MPS: f64 = 1e-3;

impl Pace {
    /// Time of the manoeuvre by real time, at a speed.
    fn rate(self, speed_mps: f64) -> f64 {
        match self {
            Self::Speed(reference_mps) => (speed_mps / reference_mps).min(1.0),
            Self::Time => f64::from(u8::from(speed_mps > STANDS_MPS)),
            Self::Distance => speed_mps,
        }
    }
}

impl Lateral {
    /// A constant offset, without a manoeuvre.
    pub(super) fn at(offset_m: f64) -> Self {
        Self {
            coefficients: [offset_m, 0.0, 0.0, 0.0, 0.0, 0.0],
            elapsed_s: 0.0,
            duration_s: 0.0,
            target_m: offset_m,
            pace: Pace::Speed(1.0),
            profile: None,
        }
    }

    /// A manoeuvre to `target_m` by a shape.
    pub(super) fn by_profile(&self, target_m: f64, over: Over, shape: Shape) -> Self {
        let from_m = self.offset_m();
        let extent = shape.extent(target_m - from_m, over);
        // A step, or a rate without a change, is complete at once.
        if extent <= 0.0 {
            return Self::at(target_m);
        }
        let pace = if matches!(over, Over::Distance(_)) { Pace::Distance } else { Pace::Time };
        let profile = Some(Profile { from_m, shape });
        // The coefficients hold the start only, because the profile computes the offset.
        Self { duration_s: extent, target_m, pace, profile, ..Self::at(from_m) }
    }

    /// Whether a manoeuvre is under way.
    pub(super) fn is_moving(&self) -> bool {
        self.duration_s > 0.0
    }

    /// A manoeuvre to `target_m` within `duration_s` from the present offset, rate and
    /// acceleration. At its end, rate and acceleration are 0: the quintic with these six
    /// conditions.
    pub(super) fn moving_to(&self, target_m: f64, duration_s: f64, speed_mps: f64) -> Self {
        let [from_m, rate, acceleration] = self.derivatives();
        let way_m = target_m - from_m;
        // The first three coefficients give offset, rate and acceleration now. The last three make
        // offset, rate and acceleration at the end those of the aim.
        let t = duration_s;
        let t2 = t * t;
        let t3 = t.powi(3);
        let t4 = t.powi(4);
        let t5 = t.powi(5);
        let cubic = (20.0 * way_m - 12.0 * rate * t - 3.0 * acceleration * t2) / (2.0 * t3);
        let quartic = (-30.0 * way_m + 16.0 * rate * t + 3.0 * acceleration * t2) / (2.0 * t4);
        let quintic = (12.0 * way_m - 6.0 * rate * t - acceleration * t2) / (2.0 * t5);
        Self {
            coefficients: [from_m, rate, 0.5 * acceleration, cubic, quartic, quintic],
            elapsed_s: 0.0,
            duration_s,
            target_m,
            pace: Pace::Speed(speed_mps.max(1.0)),
            profile: None,
        }
    }

    /// The offset after `duration_s` at a mean speed. The manoeuvre slows down with the actor, so
    /// that the actor never slides sideways.
    pub(super) fn after(&self, duration_s: f64, speed_mps: f64) -> Self {
        let elapsed_s = self.elapsed_s + self.pace.rate(speed_mps) * duration_s;
        // Also true without a manoeuvre, whose duration is 0: the offset stays at its aim.
        if elapsed_s >= self.duration_s {
            return Self::at(self.target_m);
        }
        Self { elapsed_s, ..*self }
    }

    /// The present offset, in metres.
    pub(super) fn offset_m(&self) -> f64 {
        self.derivatives()[0]
    }

    /// The present rate at a speed, in m/s to the left.
    pub(super) fn rate_mps(&self, speed_mps: f64) -> f64 {
        self.derivatives()[1] * self.pace.rate(speed_mps)
    }

    /// The offset at which the manoeuvre ends, in metres.
    pub(super) fn target_m(&self) -> f64 {
        self.target_m
    }

    /// Offset, rate and acceleration in the manoeuvre's time.
    fn derivatives(&self) -> [f64; 3] {
        let [a, b, c, d, e, f] = self.coefficients;
        let t = self.elapsed_s;
        if let Some(Profile { from_m, shape }) = self.profile {
            let way_m = self.target_m - from_m;
            let x = t / self.duration_s;
            // A quintic that follows starts with the rate, and without acceleration.
            return [from_m + way_m * shape.at(x), way_m * shape.slope(x) / self.duration_s, 0.0];
        }
        [
            // Horner's scheme for the polynomial and its first two derivatives.
            a + t * (b + t * (c + t * (d + t * (e + t * f)))),
            b + t * (2.0 * c + t * (3.0 * d + t * (4.0 * e + t * 5.0 * f))),
            2.0 * c + t * (6.0 * d + t * (12.0 * e + t * 20.0 * f)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lane_change_arrives_smoothly() {
        let mut lateral = Lateral::at(-3.5).moving_to(0.0, 4.0, 10.0);
        for _ in 0..200 {
            lateral = lateral.after(0.01, 10.0);
        }
        // The middle: half the way, at the largest rate, 15/8 of the mean.
        assert!((lateral.offset_m() + 1.75).abs() < 1e-9, "{lateral:?}");
        assert!((lateral.rate_mps(10.0) - 1.875 * 3.5 / 4.0).abs() < 1e-9);
        for _ in 0..201 {
            lateral = lateral.after(0.01, 10.0);
        }
        assert_eq!(lateral, Lateral::at(0.0));
    }

    #[test]
    fn a_second_move_continues_the_first() {
        let mut lateral = Lateral::at(0.0).moving_to(2.0, 2.0, 5.0);
        for _ in 0..90 {
            lateral = lateral.after(0.01, 5.0);
        }
        let back = lateral.moving_to(0.0, 3.0, 5.0);
        assert!((back.offset_m() - lateral.offset_m()).abs() < 1e-12);
        assert!((back.rate_mps(5.0) - lateral.rate_mps(5.0)).abs() < 1e-12);
        // Just before the end, where the manoeuvre is still a polynomial.
        let end = back.after(2.999_999, 5.0);
        assert!(end.offset_m().abs() < 1e-9 && end.rate_mps(5.0).abs() < 1e-6, "{end:?}");
    }

    #[test]
    fn an_actor_that_stands_does_not_slide() {
        let lateral = Lateral::at(0.0).moving_to(2.0, 2.0, 5.0).after(0.5, 5.0);
        assert_eq!(lateral.after(1.0, 0.0), lateral);
        assert_eq!(lateral.rate_mps(0.0), 0.0);
    }
}
