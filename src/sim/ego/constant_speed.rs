//! Lateral dynamics at constant speed in closed form, for any speed and any time.

use glam::{DMat2, DVec2};

use super::vehicle::LateralDynamics;

/// The steering actuator: the angle follows its setpoint with a first-order lag,
/// `dδ/dt = (target - δ) / lag`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Steering {
    /// Angle of the front wheels, in radians, positive to the left.
    pub(super) angle_rad: f64,
    /// Setpoint of the angle, in radians.
    pub(super) target_rad: f64,
    /// Its lag, in seconds.
    pub(super) lag_s: f64,
}

/// The solution of `|v| dz/dt = G z + v steer δ(t)` for a speed v, from a state z.
///
/// The steering angle is `target + (δ - target) e^(-t / lag)`, so a particular solution is
/// `c + d e^(-t / lag)` with `G c = -v steer target` and
/// `(G + |v| / lag) d = -v steer (δ - target)`. The remainder decays as the matrix exponential of
/// `G t / |v|`. Everything stays finite as v goes to 0, where z becomes 0 at once: the car rolls in
/// the direction of its wheels. `G + |v| / lag` is regular unless an eigenvalue equals the rate of
/// the lag, -10 1/s: the eigenvalues are below -14 1/s at up to 10 m/s backwards, and forwards
/// below -23 1/s or complex.
#[derive(Clone, Copy, Debug)]
pub(super) struct ConstantSpeed {
    speed_m_s: f64,
    lag_s: f64,
    matrix: DMat2,
    settled: DVec2,
    lagging: DVec2,
    fading: DVec2,
}

impl Steering {
    /// The angle after a time in seconds, in radians.
    pub(super) fn after(&self, time_s: f64) -> f64 {
        self.target_rad + (self.angle_rad - self.target_rad) * (-time_s / self.lag_s).exp()
    }
}

impl ConstantSpeed {
    pub(super) fn new(
        tyres: &LateralDynamics,
        speed_m_s: f64,
        steering: Steering,
        sideways: DVec2,
    ) -> Self {
        let Steering { angle_rad, target_rad, lag_s } = steering;
        let matrix = tyres.matrix(speed_m_s);
        // G is regular at every speed within the limits of the ego, so both inverses exist.
        let with_lag = matrix + DMat2::from_diagonal(DVec2::splat(speed_m_s.abs() / lag_s));
        let settled = -(matrix.inverse() * tyres.steer) * (speed_m_s * target_rad);
        let lagging = -(with_lag.inverse() * tyres.steer) * (speed_m_s * (angle_rad - target_rad));
        let fading = sideways - settled - lagging;
        Self { speed_m_s, lag_s, matrix, settled, lagging, fading }
    }

    /// Lateral velocity (m/s) and yaw rate (rad/s) after a time in seconds, and the change of
    /// heading until then, in radians.
    pub(super) fn after(&self, time_s: f64) -> (DVec2, f64) {
        let lag = (-time_s / self.lag_s).exp();
        // Infinite at v = 0. The branch below then takes the faded state.
        let stretch_s2_m = time_s / self.speed_m_s.abs();
        // At very low speed the slowest eigenvalue of G is -178 m/s²: e^-1780 underflows f64.
        let faded = if stretch_s2_m < 10.0 {
            exponential(self.matrix * stretch_s2_m) * self.fading
        } else {
            DVec2::ZERO
        };
        // The integral of e^(G t / |v|) is |v| G^-1 (e^(G t / |v|) - 1).
        let turned = self.settled * time_s
            + self.lagging * (self.lag_s * (1.0 - lag))
            + self.matrix.inverse() * (faded - self.fading) * self.speed_m_s.abs();
        (self.settled + self.lagging * lag + faded, turned.y)
    }
}

/// The exponential of a matrix: `e^μ (cosh ν + sinh ν / ν (M - μ))`, where μ is half its trace and
/// `(M - μ)² = ν²` (Cayley-Hamilton). For negative ν² the hyperbolic functions become cosine and
/// sine. Nothing overflows if the real parts of the eigenvalues `μ ± ν` are not positive.
fn exponential(matrix: DMat2) -> DMat2 {
    let mean = 0.5 * (matrix.x_axis.x + matrix.y_axis.y);
    let rest = matrix - DMat2::from_diagonal(DVec2::splat(mean));
    let square = -rest.determinant();
    let root = square.abs().sqrt();
    // The series avoid 0 / 0 where both eigenvalues are one. Their next terms, ν⁴/24 and ν⁴/120,
    // are below 1e-17.
    let (even, odd) = if root < 1e-4 {
        // cosh ν = 1 + ν²/2, sinh ν / ν = 1 + ν²/6, up to 1e-16 of each.
        (mean.exp() * (1.0 + square / 2.0), mean.exp() * (1.0 + square / 6.0))
    } else if square < 0.0 {
        (mean.exp() * root.cos(), mean.exp() * root.sin() / root)
    } else if root < 1.0 {
        // `cosh` and `sinh` are exact for a small ν, where the difference of two exponentials
        // cancels.
        (mean.exp() * root.cosh(), mean.exp() * root.sinh() / root)
    } else {
        // `cosh` alone would overflow for a large ν, although `e^μ cosh ν` is small. So the
        // exponents are added first.
        let slow = (mean + root).exp();
        let fast = (mean - root).exp();
        (0.5 * (slow + fast), 0.5 * (slow - fast) / root)
    };
    DMat2::from_diagonal(DVec2::splat(even)) + rest * odd
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ego::vehicle::Vehicle;

    fn series(matrix: DMat2) -> DMat2 {
        // Scaling and squaring: divided by 2^12 the series converges in twelve terms, and twelve
        // squarings undo the scaling.
        let scaled = matrix * 2f64.powi(-12);
        let mut sum = DMat2::IDENTITY;
        let mut term = DMat2::IDENTITY;
        for k in 1..12 {
            term = term * scaled * (1.0 / f64::from(k));
            sum += term;
        }
        (0..12).fold(sum, |power, _| power * power)
    }

    #[test]
    fn the_exponential_is_its_series() {
        let tyres = Vehicle::DEFAULT.tyres();
        // At 13.34 m/s both eigenvalues are one.
        for speed in [2.0, 5.0, 13.3, 13.34, 13.341, 13.4, 30.0, 60.0, -3.0, -10.0f64] {
            for time_s in [1e-6, 1e-3, 0.05, 0.2] {
                let matrix = tyres.matrix(speed) * (time_s / speed.abs());
                let error = exponential(matrix) - series(matrix);
                let worst = error.to_cols_array().into_iter().fold(0.0, |a: f64, b| a.max(b.abs()));
                assert!(worst < 1e-12, "{speed} m/s, {time_s} s: {worst}");
            }
        }
    }

    #[test]
    fn at_a_crawl_the_car_rolls_as_it_is_steered() {
        let car = Vehicle::DEFAULT;
        let tyres = Vehicle::DEFAULT.tyres();
        let steering = Steering { angle_rad: 0.3, target_rad: 0.3, lag_s: 0.1 };
        // The square of 1e-300 underflows to 0. The sideways state at the start must fade in all of
        // them.
        for speed in [0.0, 1e-300, 1e-9, -1e-9, 1e-3] {
            let (z, turned) =
                ConstantSpeed::new(&tyres, speed, steering, DVec2::new(1.0, -2.0)).after(0.1);
            // A car that rolls turns by v δ / L. The centre of gravity moves sideways with its
            // distance from the rear axle.
            let rolls = speed * 0.3 / car.wheelbase_m;
            assert!((z.y - rolls).abs() <= 1e-7 * rolls.abs(), "{speed}: {z}");
            assert!((z.x - rolls * car.rear_to_cg_m).abs() <= 1e-6 * rolls.abs(), "{speed}: {z}");
            // Lateral sliding has decayed within |v| / 178 s.
            assert!((turned - 0.1 * rolls).abs() <= 0.02 * speed.abs(), "{speed}: {turned}");
        }
    }
}
