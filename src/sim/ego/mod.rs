//! The ego: where it stands, how it moves, and what a command makes of it.
//!
//! Three models. `teleport`: the pose is what the agent says. `kinematic`: rolls without slipping, has at
//! once what it is told. `dynamic`: slides on linear tyres, steering and drive lag; integrated exactly at
//! constant speed and to 1e-9 else, from standstill to the bounds of speed, without another model below
//! some speed. The last two move in the plane of the rig; the [`Ground`] lifts and tilts that.

mod collocation;
mod constant_speed;
mod kinematic;
mod path;
mod single_track;
mod speed;
mod tracker;
mod vehicle;

use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::limits;
use wildcity_scene::geometry::Pose;

use super::Ground;

pub use path::{Path, TimedPose};
pub use single_track::{Setpoint, SingleTrackState};
pub use vehicle::Vehicle;

/// How an ego moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EgoModel {
    /// To the pose that it is told.
    #[default]
    Teleport,
    /// As it is steered, at once.
    Kinematic,
    /// As a car does that slips and lags.
    Dynamic,
}

/// A model, and what an episode of it begins with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dynamics {
    /// The model.
    pub model: EgoModel,
    /// Speed at the start of an episode, in m/s along the rig; 0 of a teleport.
    pub speed_m_s: f64,
    /// Whether the car goes backwards when it brakes beyond standstill; else it stands.
    pub reverse: bool,
}

/// What an agent wants of a step.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// To be there at its end, `world_from_rig`.
    Pose(Pose),
    /// To follow a path.
    Path(Path),
    /// To accelerate and turn.
    Action(Action),
}

impl From<Pose> for Command {
    fn from(world_from_rig: Pose) -> Self {
        Self::Pose(world_from_rig)
    }
}

/// Acceleration and curvature, constant over a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Action {
    /// Along the car, in m/s²; at most [`limits::EGO_ACCELERATION_M_S2`] either way.
    pub acceleration_m_s2: f64,
    /// Of the way of the rear axle, in 1/m, to the left; at most [`limits::EGO_CURVATURE_1_M`] either
    /// way. A dynamic car steers so that it comes to drive it.
    pub curvature_1_m: f64,
}

/// An ego between two steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Ego {
    dynamics: Dynamics,
    world_from_rig: Pose,
    velocity_m_s: DVec3,
    acceleration_m_s2: DVec3,
    yaw_rate_rad_s: f64,
    /// In the frame of the rig as it is now: its place and heading are zero.
    car: SingleTrackState,
    moved: bool,
}

/// Why an ego does not do as it is told.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EgoError {
    /// The model takes other commands.
    #[error(
        "{given} does not move this ego, whose model is {model}: send {takes}, or open a session with other dynamics"
    )]
    Command {
        /// Name of the model.
        model: &'static str,
        /// What was sent.
        given: &'static str,
        /// What it takes.
        takes: &'static str,
    },
    /// A number is outside its limits.
    #[error("{field} is {value:?}; {least:?} to {most:?} are accepted")]
    Range {
        /// Which, as it is called on the wire.
        field: &'static str,
        /// The refused value.
        value: f64,
        /// The smallest accepted.
        least: f64,
        /// The largest accepted.
        most: f64,
    },
    /// A path has too many poses, or none.
    #[error("the trajectory has {count} poses; 1 to {limit} are accepted")]
    PathCount {
        /// How many it has.
        count: usize,
        /// How many it may have.
        limit: usize,
    },
    /// Times of a path must rise.
    #[error(
        "trajectory[{index}].time_us is {time_us}; more than {before_us} and at most {limit_us} is accepted"
    )]
    PathTime {
        /// Which pose.
        index: usize,
        /// Its time, in microseconds.
        time_us: i64,
        /// The time before it, in microseconds.
        before_us: i64,
        /// The latest accepted, in microseconds.
        limit_us: i64,
    },
    /// A path ends before the step does.
    #[error("the trajectory ends at {end_us} µs and the step at {step_us} µs: send it longer")]
    PathShort {
        /// Where it ends, in microseconds.
        end_us: i64,
        /// Where the step ends, in microseconds.
        step_us: i64,
    },
}

impl EgoError {
    /// What is at fault, as it is called on the wire.
    pub fn field(&self) -> String {
        match self {
            Self::Command { given, .. } => (*given).to_owned(),
            Self::Range { field, .. } => (*field).to_owned(),
            Self::PathCount { .. } | Self::PathShort { .. } => "trajectory".to_owned(),
            Self::PathTime { index, .. } => format!("trajectory[{index}].time_us"),
        }
    }
}

impl EgoModel {
    /// Its name, as on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Teleport => "teleport",
            Self::Kinematic => "kinematic",
            Self::Dynamic => "dynamic",
        }
    }
}

impl Dynamics {
    /// From outside.
    ///
    /// # Errors
    /// The speed is none that the car can have.
    pub fn checked(model: EgoModel, speed_m_s: f64, reverse: bool) -> Result<Self, EgoError> {
        let dynamics = Self { model, speed_m_s, reverse };
        let [least, most] = match model {
            EgoModel::Teleport => [0.0, 0.0],
            EgoModel::Kinematic | EgoModel::Dynamic => dynamics.bounds_m_s(),
        };
        in_range("dynamics.speed", speed_m_s, [least, most])?;
        Ok(dynamics)
    }

    /// Where an episode starts that is to start at a pose (`world_from_rig`): there, and on the ground
    /// unless it is a teleport.
    pub fn start_pose(&self, world_from_rig: Pose, ground: &Ground<'_>) -> Pose {
        match self.model {
            EgoModel::Teleport => world_from_rig,
            EgoModel::Kinematic | EgoModel::Dynamic => ground.place(world_from_rig),
        }
    }

    /// Between which speeds it stays, in m/s.
    fn bounds_m_s(&self) -> [f64; 2] {
        let back_m_s = if self.reverse { -limits::EGO_REVERSE_M_S } else { 0.0 };
        [back_m_s, limits::EGO_SPEED_M_S]
    }
}

impl Action {
    /// From outside.
    ///
    /// # Errors
    /// A number is not finite or beyond its limit.
    pub fn checked(acceleration_m_s2: f64, curvature_1_m: f64) -> Result<Self, EgoError> {
        for (field, value, most) in [
            ("action.acceleration", acceleration_m_s2, limits::EGO_ACCELERATION_M_S2),
            ("action.curvature", curvature_1_m, limits::EGO_CURVATURE_1_M),
        ] {
            in_range(field, value, [-most, most])?;
        }
        Ok(Self { acceleration_m_s2, curvature_1_m })
    }
}

fn in_range(field: &'static str, value: f64, [least, most]: [f64; 2]) -> Result<(), EgoError> {
    // Positively, so that NaN is refused.
    let accepted = (least..=most).contains(&value);
    if accepted { Ok(()) } else { Err(EgoError::Range { field, value, least, most }) }
}

impl Ego {
    /// An ego at its start (`world_from_rig`), as [`Dynamics::start_pose`] gives it.
    pub fn new(dynamics: Dynamics, world_from_rig: Pose) -> Self {
        let car = SingleTrackState { speed_m_s: dynamics.speed_m_s, ..SingleTrackState::default() };
        Self {
            dynamics,
            world_from_rig,
            velocity_m_s: world_from_rig.rotation * DVec3::X * dynamics.speed_m_s,
            acceleration_m_s2: DVec3::ZERO,
            yaw_rate_rad_s: 0.0,
            car,
            moved: false,
        }
    }

    /// The ego after a step. `self` stays as it is.
    ///
    /// # Errors
    /// The model takes other commands, or a path ends before the step does.
    pub fn stepped(
        &self,
        command: &Command,
        step_us: i64,
        ground: &Ground<'_>,
    ) -> Result<Self, EgoError> {
        if let Command::Path(path) = command
            && path.end_us() < step_us
        {
            return Err(EgoError::PathShort { end_us: path.end_us(), step_us });
        }
        let step_s = step_us as f64 * 1e-6;
        match (self.dynamics.model, command) {
            (EgoModel::Teleport, Command::Pose(pose)) => Ok(self.moved_to(*pose, step_s)),
            (EgoModel::Teleport, Command::Path(path)) => {
                Ok(self.moved_to(self.world_from_rig * path.at(step_us), step_s))
            }
            (_, Command::Action(action)) if self.dynamics.model != EgoModel::Teleport => {
                Ok(self.driven(self.advanced(&self.car, *action, step_s), step_s, ground))
            }
            (_, Command::Path(path)) => {
                Ok(self.driven(self.tracked(path, step_us), step_s, ground))
            }
            (model, Command::Action(_)) => {
                let (given, takes) = ("action", "pose or trajectory");
                Err(EgoError::Command { model: model.name(), given, takes })
            }
            (model, Command::Pose(_)) => {
                let (given, takes) = ("pose", "action or trajectory");
                Err(EgoError::Command { model: model.name(), given, takes })
            }
        }
    }

    /// How it moves.
    pub fn dynamics(&self) -> Dynamics {
        self.dynamics
    }

    /// Where it is.
    pub fn world_from_rig(&self) -> Pose {
        self.world_from_rig
    }

    /// Velocity of the rig's origin along world axes, in m/s: now; of a teleport the mean of the last
    /// step, and zero at the start.
    pub fn velocity_m_s(&self) -> DVec3 {
        self.velocity_m_s
    }

    /// Change of velocity over the last step per second, along world axes, in m/s²; zero at the start,
    /// and after the first step of a teleport, of whose velocity before nothing is known.
    pub fn acceleration_m_s2(&self) -> DVec3 {
        self.acceleration_m_s2
    }

    /// Yaw rate about the rig's z axis, in rad/s: now; of a teleport the mean of the last step.
    pub fn yaw_rate_rad_s(&self) -> f64 {
        self.yaw_rate_rad_s
    }

    /// Angle of the front wheels, in radians, to the left; none of a teleport, which has no wheels.
    pub fn steering_rad(&self) -> Option<f64> {
        (self.dynamics.model != EgoModel::Teleport).then_some(self.car.steering_rad)
    }

    fn moved_to(&self, world_from_rig: Pose, step_s: f64) -> Self {
        let way_m = world_from_rig.position_m - self.world_from_rig.position_m;
        let velocity_m_s = way_m / step_s;
        let turn = self.world_from_rig.rotation.inverse() * world_from_rig.rotation;
        // The turn about z of a rotation: twice the angle of its (w, z) part.
        let turned_rad = path::wrapped(2.0 * turn.z.atan2(turn.w));
        let acceleration_m_s2 =
            if self.moved { (velocity_m_s - self.velocity_m_s) / step_s } else { DVec3::ZERO };
        Self {
            world_from_rig,
            velocity_m_s,
            acceleration_m_s2,
            yaw_rate_rad_s: turned_rad / step_s,
            moved: true,
            ..self.clone()
        }
    }

    /// A car that moved in the plane of the rig, as an ego in the world.
    fn driven(&self, car: SingleTrackState, step_s: f64, ground: &Ground<'_>) -> Self {
        let start_from_rig = Pose {
            position_m: car.position_m.extend(0.0),
            rotation: DQuat::from_rotation_z(car.yaw_rad),
        };
        // Who stands stays to the bit: the product would be normalised once more.
        let world_from_rig = match start_from_rig == Pose::IDENTITY {
            true => self.world_from_rig,
            false => ground.place(self.world_from_rig * start_from_rig),
        };
        let rear_m_s = car.lateral_m_s - Vehicle::DEFAULT.rear_to_cg_m * car.yaw_rate_rad_s;
        let velocity_m_s = world_from_rig.rotation * DVec3::new(car.speed_m_s, rear_m_s, 0.0);
        Self {
            dynamics: self.dynamics,
            world_from_rig,
            velocity_m_s,
            acceleration_m_s2: (velocity_m_s - self.velocity_m_s) / step_s,
            yaw_rate_rad_s: car.yaw_rate_rad_s,
            car: SingleTrackState { position_m: DVec2::ZERO, yaw_rad: 0.0, ..car },
            moved: true,
        }
    }

    fn advanced(&self, car: &SingleTrackState, action: Action, step_s: f64) -> SingleTrackState {
        let (vehicle, bounds_m_s) = (Vehicle::DEFAULT, self.dynamics.bounds_m_s());
        if self.dynamics.model == EgoModel::Kinematic {
            return kinematic::rolled(car, &vehicle, action, step_s, bounds_m_s);
        }
        let steering_rad = vehicle.steering_rad(action.curvature_1_m, car.speed_m_s);
        let most_rad = limits::EGO_STEERING_RAD;
        let told = Setpoint {
            acceleration_m_s2: action.acceleration_m_s2,
            steering_rad: steering_rad.clamp(-most_rad, most_rad),
        };
        car.after(&vehicle, told, step_s, bounds_m_s)
    }

    fn tracked(&self, path: &Path, step_us: i64) -> SingleTrackState {
        let reference = path.reference();
        let lag_s = match self.dynamics.model {
            EgoModel::Dynamic => Vehicle::DEFAULT.lag_s,
            EgoModel::Teleport | EgoModel::Kinematic => 0.0,
        };
        let ticks = (step_us as u64).div_ceil(limits::TRACKER_TICK_US);
        let tick_s = step_us as f64 * 1e-6 / ticks as f64;
        (0..ticks).fold(self.car, |car, tick| {
            let action = tracker::track(&reference, tick as f64 * tick_s, lag_s, &car);
            self.advanced(&car, action, tick_s)
        })
    }
}
