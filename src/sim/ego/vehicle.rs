//! Parameters of the single-track model.

use glam::{DMat2, DVec2};

/// Parameters of the single-track model, in which both wheels of an axle are merged into one in its
/// middle.
///
/// The defaults are those of the vehicle model of NVIDIA's AlpaSim (a Ford Fusion). As there,
/// stiffness is given per wheel and doubled for the axle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vehicle {
    pub mass_kg: f64,
    /// Moment of inertia about the vertical through the centre of gravity, in kg m².
    pub inertia_kg_m2: f64,
    /// From the rear axle, the rig's origin, forward to the centre of gravity, in metres.
    pub rear_to_cg_m: f64,
    /// From the rear axle to the front axle, in metres.
    pub wheelbase_m: f64,
    /// Cornering stiffness of one front wheel, in N/rad.
    pub front_wheel_n_rad: f64,
    /// Cornering stiffness of one rear wheel, in N/rad.
    pub rear_wheel_n_rad: f64,
    /// Time constant of the lag of steering and drive, in seconds.
    pub lag_s: f64,
}

/// The lateral dynamics at speed v, forwards or backwards. The state z is the lateral velocity of
/// the centre of gravity (m/s, positive to the left) and the yaw rate (rad/s, positive to the
/// left): `|v| dz/dt = (grip + v |v| turning) z + v steer δ`.
///
/// These are Newton's equations with linear tyres (Rajamani, "Vehicle Dynamics and Control", 2.3),
/// multiplied by |v|. The lateral force of a tyre is its stiffness times its slip angle,
/// `(u - v δ) / |v|` for a wheel with lateral velocity u. After the multiplication nothing is
/// divided by v, and v = 0 gives z = 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LateralDynamics {
    grip: DMat2,
    pub(super) steer: DVec2,
}

impl Vehicle {
    /// The parameters of every ego.
    pub const DEFAULT: Self = Self {
        mass_kg: 2014.4,
        inertia_kg_m2: 3414.2,
        rear_to_cg_m: 1.59,
        wheelbase_m: 2.85,
        front_wheel_n_rad: 93_534.5,
        rear_wheel_n_rad: 176_162.1,
        lag_s: 0.1,
    };

    /// The steering angle, in radians, that gives a curvature (1/m) in steady state at a speed
    /// (m/s).
    ///
    /// Setting dz/dt = 0 gives `δ = κ (L + K v²)` with the understeer gradient
    /// `K = m (l_r C_r - l_f C_f) / (2 L C_f C_r)` (Rajamani, 3.1.3). K is 0.0035 s²/m for the
    /// default vehicle: it understeers.
    pub fn steering_rad(&self, curvature_1_m: f64, speed_m_s: f64) -> f64 {
        let Self { mass_kg, rear_to_cg_m, wheelbase_m, .. } = *self;
        let front = self.front_wheel_n_rad;
        let rear = self.rear_wheel_n_rad;
        // Positive for an understeering car: the rear axle has the larger moment of stiffness.
        let moment = rear_to_cg_m * rear - (wheelbase_m - rear_to_cg_m) * front;
        let understeer_s2_m = mass_kg * moment / (2.0 * wheelbase_m * front * rear);
        // v |v| and not v²: backwards the same tyres oversteer.
        curvature_1_m * (wheelbase_m + understeer_s2_m * speed_m_s * speed_m_s.abs())
    }

    pub(super) fn tyres(&self) -> LateralDynamics {
        let front = 2.0 * self.front_wheel_n_rad;
        let rear = 2.0 * self.rear_wheel_n_rad;
        let rear_m = self.rear_to_cg_m;
        let front_m = self.wheelbase_m - self.rear_to_cg_m;
        let mass = self.mass_kg;
        let inertia = self.inertia_kg_m2;
        let moment = front_m * front - rear_m * rear;
        let turn = front_m * front_m * front + rear_m * rear_m * rear;
        LateralDynamics {
            // By columns, as glam stores them: the first has the forces of lateral velocity, the
            // second those of yaw rate.
            grip: DMat2::from_cols_array_2d(&[
                [-(front + rear) / mass, -moment / inertia],
                [-moment / mass, -turn / inertia],
            ]),
            steer: DVec2::new(front / mass, front_m * front / inertia),
        }
    }
}

impl LateralDynamics {
    /// The matrix G of `|v| dz/dt = G z + v steer δ`, in m/s².
    pub(super) fn matrix(&self, speed_m_s: f64) -> DMat2 {
        let mut matrix = self.grip;
        // The term -v |v| of the yaw rate is the centripetal part of the lateral acceleration, in
        // the frame of the car.
        matrix.y_axis.x -= speed_m_s * speed_m_s.abs();
        matrix
    }

    /// The rate of the fastest decay at low speed times the speed, in m/s²: 438 for the default
    /// vehicle.
    pub(super) fn stiffness_m_s2(&self) -> f64 {
        // The larger magnitude of the two eigenvalues, which are real and negative.
        let half = 0.5 * (self.grip.x_axis.x + self.grip.y_axis.y);
        // The discriminant is above 0 for real tyres; the bound catches rounding where both
        // eigenvalues are one.
        -half + (half * half - self.grip.determinant()).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_car_is_as_stiff_as_published() {
        let tyres = Vehicle::DEFAULT.tyres();
        // Two wheels per axle: 2 (93,534.5 + 176,162.1) / 2014.4 = 267.8 1/s at 1 m/s.
        assert!((tyres.grip.x_axis.x + 267.77).abs() < 0.01, "{}", tyres.grip);
        assert!((tyres.stiffness_m_s2() - 437.9).abs() < 0.1, "{}", tyres.stiffness_m_s2());
    }

    #[test]
    fn steering_turns_the_car_by_the_curvature_in_the_end() {
        let car = Vehicle::DEFAULT;
        let tyres = Vehicle::DEFAULT.tyres();
        for speed_m_s in [-10.0, -0.5, 1e-3, 5.0, 60.0] {
            let delta_rad = car.steering_rad(0.01, speed_m_s);
            let force = tyres.steer * (speed_m_s * delta_rad);
            let steady = -(tyres.matrix(speed_m_s).inverse() * force);
            // In steady state the yaw rate is κ v.
            assert!((steady.y - 0.01 * speed_m_s).abs() < 1e-12, "{speed_m_s}: {steady}");
        }
    }
}
