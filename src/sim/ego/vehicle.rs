//! The numbers of a car.

use glam::{DMat2, DVec2};

/// A single track: both wheels of an axle are one, in the middle.
///
/// The default's numbers are those of the vehicle model of NVIDIA's AlpaSim (a Ford Fusion), which gives
/// the stiffness of one wheel and doubles it for the axle; so do we.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vehicle {
    /// Mass, in kg.
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
    /// Time in which steering and drive come within 1/e of what they are told, in seconds.
    pub lag_s: f64,
}

/// How a vehicle moves sideways at speed v, forwards or backwards, with z the lateral velocity of its
/// centre of gravity (m/s, to the left) and its yaw rate (rad/s, to the left):
/// `|v| dz/dt = (grip + v |v| turning) z + v steer δ`.
///
/// It is Newton's law for linear tyres, whose force is stiffness times slip, `(u - v δ) / |v|` for a
/// wheel with the lateral velocity u, times |v|: so nothing is divided by v, and at v = 0 it says z = 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LateralDynamics {
    grip: DMat2,
    pub(super) steer: DVec2,
}

impl Vehicle {
    /// What every ego drives.
    pub const DEFAULT: Self = Self {
        mass_kg: 2014.4,
        inertia_kg_m2: 3414.2,
        rear_to_cg_m: 1.59,
        wheelbase_m: 2.85,
        front_wheel_n_rad: 93_534.5,
        rear_wheel_n_rad: 176_162.1,
        lag_s: 0.1,
    };

    /// The steering angle, in radians, with which the car comes to drive a curvature, in 1/m, at a speed.
    ///
    /// In a steady turn the tyres slip: `δ = κ (L + K v²)`, `K = m (l_r C_r - l_f C_f) / (2 L C_f C_r)`,
    /// by setting dz/dt = 0. K is 0.0035 s²/m here: the car understeers.
    pub fn steering_rad(&self, curvature_1_m: f64, speed_m_s: f64) -> f64 {
        let Self { mass_kg, rear_to_cg_m, wheelbase_m, .. } = *self;
        let (front, rear) = (self.front_wheel_n_rad, self.rear_wheel_n_rad);
        let moment = rear_to_cg_m * rear - (wheelbase_m - rear_to_cg_m) * front;
        let understeer_s2_m = mass_kg * moment / (2.0 * wheelbase_m * front * rear);
        curvature_1_m * (wheelbase_m + understeer_s2_m * speed_m_s * speed_m_s.abs())
    }

    pub(super) fn tyres(&self) -> LateralDynamics {
        let (front, rear) = (2.0 * self.front_wheel_n_rad, 2.0 * self.rear_wheel_n_rad);
        let (rear_m, front_m) = (self.rear_to_cg_m, self.wheelbase_m - self.rear_to_cg_m);
        let (mass, inertia) = (self.mass_kg, self.inertia_kg_m2);
        let moment = front_m * front - rear_m * rear;
        let turn = front_m * front_m * front + rear_m * rear_m * rear;
        LateralDynamics {
            grip: DMat2::from_cols_array_2d(&[
                [-(front + rear) / mass, -moment / inertia],
                [-moment / mass, -turn / inertia],
            ]),
            steer: DVec2::new(front / mass, front_m * front / inertia),
        }
    }
}

impl LateralDynamics {
    /// The matrix of `|v| dz/dt = G z + v steer δ`, in m/s².
    pub(super) fn matrix(&self, speed_m_s: f64) -> DMat2 {
        let mut matrix = self.grip;
        matrix.y_axis.x -= speed_m_s * speed_m_s.abs();
        matrix
    }

    /// The fastest decay at low speed, times speed, in m/s²: 438 of the default car.
    pub(super) fn stiffness_m_s2(&self) -> f64 {
        // The larger eigenvalue of a matrix whose eigenvalues are real and negative.
        let half = 0.5 * (self.grip.x_axis.x + self.grip.y_axis.y);
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
        let (car, tyres) = (Vehicle::DEFAULT, Vehicle::DEFAULT.tyres());
        for speed_m_s in [-10.0, -0.5, 1e-3, 5.0, 60.0] {
            let delta_rad = car.steering_rad(0.01, speed_m_s);
            let force = tyres.steer * (speed_m_s * delta_rad);
            let steady = -(tyres.matrix(speed_m_s).inverse() * force);
            assert!((steady.y - 0.01 * speed_m_s).abs() < 1e-12, "{speed_m_s}: {steady}");
        }
    }
}
