//! Derivatives by a camera's pose, and by the poses of the rig that it belongs to.

use std::ops::AddAssign;

use glam::{DQuat, DVec3};

use crate::{RollingShutter, View};
use wildcity_scene::geometry::Pose;

/// A twist `ξ = (ρ, φ)` of a frame, or the derivatives of a loss by one at 0.
///
/// A view's twist moves the world in the camera's frame, at every moment of its exposure:
/// `camera_from_world = exp(ξ) camera_from_world₀`, so that a point `p` of that frame moves to
/// `p + ρ + φ × p` in first order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Twist {
    /// Translation, in metres; its derivatives, per metre.
    pub rho: DVec3,
    /// Rotation vector, in radians; its derivatives, per radian.
    pub phi: DVec3,
}

/// The derivatives by the twists of a rig, of which
/// `world_from_camera = world_from_ego exp(ego) ego_from_camera exp(camera)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigTwists {
    /// One per time: shared by the cameras of a rig.
    pub ego: Twist,
    /// One per camera: shared by all times.
    pub camera: Twist,
}

impl AddAssign for Twist {
    fn add_assign(&mut self, other: Self) {
        self.rho += other.rho;
        self.phi += other.phi;
    }
}

impl Twist {
    /// The six derivatives or parameters: ρ, then φ.
    pub fn to_array(self) -> [f64; 6] {
        [self.rho.x, self.rho.y, self.rho.z, self.phi.x, self.phi.y, self.phi.z]
    }

    /// From ρ, then φ.
    pub fn from_array([a, b, c, d, e, f]: [f64; 6]) -> Self {
        Self { rho: DVec3::new(a, b, c), phi: DVec3::new(d, e, f) }
    }

    /// The rigid transform `exp(ξ)`.
    pub fn exp(self) -> Pose {
        let angle = self.phi.length();
        // Of the series sin θ/θ, (1 - cos θ)/θ², (θ - sin θ)/θ³ a third term is below 1e-16 here.
        let [a, b] = if angle < 1e-4 {
            let square = angle * angle;
            [0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0]
        } else {
            [(1.0 - angle.cos()) / angle.powi(2), (angle - angle.sin()) / angle.powi(3)]
        };
        let turned = self.phi.cross(self.rho);
        Pose {
            position_m: self.rho + a * turned + b * self.phi.cross(turned),
            rotation: DQuat::from_scaled_axis(self.phi),
        }
    }

    /// The derivatives by the twists of the rig, given those by the view's.
    ///
    /// With `camera_from_world = exp(-camera) camera_from_ego exp(-ego) ego_from_world` the view's
    /// twist is `-camera`, and `-Ad(camera_from_ego) ego`: `v_camera = -v`, and
    /// `v_ego = -Ad(camera_from_ego)ᵀ v`.
    pub fn on_rig(self, ego_from_camera: &Pose) -> RigTwists {
        let Pose { position_m, rotation } = ego_from_camera.inverse();
        // Ad(R, t)(ρ, φ) = (R ρ + t × R φ, R φ), so that its transpose takes (a, b) to
        // (Rᵀ a, Rᵀ (b + a × t)).
        let back = rotation.inverse();
        let phi = self.phi + self.rho.cross(position_m);
        let ego = Self { rho: -(back * self.rho), phi: -(back * phi) };
        RigTwists { ego, camera: Self { rho: -self.rho, phi: -self.phi } }
    }
}

impl View {
    /// This view after a twist. Of a camera that turns during its exposure both ends are twisted,
    /// which differs from a twist at every moment in second order of that rotation.
    pub fn twisted(&self, twist: Twist) -> Self {
        // camera_from_world = exp(ξ) camera_from_world₀, and its inverse has exp(-ξ) last.
        let back = twist.exp().inverse();
        let rolling_shutter = self.rolling_shutter.map(|shutter| RollingShutter {
            world_from_camera_first: shutter.world_from_camera_first * back,
            ..shutter
        });
        Self { world_from_camera: self.world_from_camera * back, rolling_shutter, ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_the_flow_of_the_twist() {
        // exp(ξ) = (exp(ξ/n))^n, and with n = 2^20 one step is its first two orders.
        for size in [1e-6, 1e-3, 0.7, 3.0] {
            let twist = Twist {
                rho: size * DVec3::new(0.4, -2.0, 1.0),
                phi: size * DVec3::new(0.5, 0.3, -0.8),
            };
            let mut steps =
                Twist { rho: twist.rho / f64::from(1 << 20), phi: twist.phi / f64::from(1 << 20) }
                    .exp();
            for _ in 0..20 {
                steps = steps * steps;
            }
            let whole = twist.exp();
            assert!((whole.position_m - steps.position_m).length() < 1e-9 * size, "{size}");
            assert!(whole.rotation.angle_between(steps.rotation) < 1e-7 * size, "{size}");
        }
    }

    #[test]
    fn the_twists_of_a_rig_are_those_of_its_view() {
        // A loss v · ξ of the view's twist ξ, by central differences in each twist of the rig.
        let derivatives = Twist::from_array([0.3, -1.0, 0.7, 2.0, 0.4, -0.6]);
        let world_from_ego = Twist::from_array([3.0, 1.0, 0.2, 0.1, 0.2, 0.9]).exp();
        let ego_from_camera = Twist::from_array([1.5, -0.4, 1.6, -0.5, 1.2, 0.3]).exp();
        let base = world_from_ego * ego_from_camera;
        let loss = |ego: Twist, camera: Twist| {
            let moved = world_from_ego * ego.exp() * ego_from_camera * camera.exp();
            // exp(ξ) = camera_from_world base, near the identity.
            let Pose { position_m, rotation } = moved.inverse() * base;
            position_m.dot(derivatives.rho) + rotation.to_scaled_axis().dot(derivatives.phi)
        };
        let RigTwists { ego, camera } = derivatives.on_rig(&ego_from_camera);
        for axis in 0..6 {
            let step = |h: f64| {
                let mut values = [0.0; 6];
                values[axis] = h;
                Twist::from_array(values)
            };
            let h = 1e-5;
            let none = Twist::default();
            let of_ego = (loss(step(h), none) - loss(step(-h), none)) / (2.0 * h);
            let of_camera = (loss(none, step(h)) - loss(none, step(-h))) / (2.0 * h);
            assert!((of_ego - ego.to_array()[axis]).abs() < 1e-8, "ego {axis}");
            assert!((of_camera - camera.to_array()[axis]).abs() < 1e-8, "camera {axis}");
        }
    }
}
