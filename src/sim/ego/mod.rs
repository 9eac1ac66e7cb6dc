//! The ego: its state, its motion models, and its response to commands.
//!
//! There are three models. `teleport` takes the pose that the agent sends. `kinematic` rolls
//! without slip and reaches the commanded acceleration and curvature at once. `dynamic` is the
//! linear single-track model (Rajamani, "Vehicle Dynamics and Control", chapter 2; the CommonRoad
//! vehicle models call it the single-track model) with lags of steering and drive. The last two
//! move in the plane of the rig, which the [`Ground`] lifts and tilts.
//!
//! # Integration of the dynamic model
//! For given speed and steering, lateral velocity and yaw rate obey two linear equations, whose
//! eigenvalues at low speed v are -178/v and -438/v: 438,000 1/s at 1 mm/s. An explicit step of 10
//! ms is stable only from 1.6 m/s (RK4) or 2.2 m/s (RK2) on, which is why other simulators switch
//! to another model at low speed. Here the equations are solved instead of stepped. At constant
//! speed the solution is a matrix exponential (`constant_speed.rs`). While speed changes there is
//! no closed form, and a collocation polynomial that satisfies the equations at five points takes
//! its place (`collocation.rs`, Radau IIA of order 9). Both forms are multiplied by |v|, so that
//! nothing is divided by v: at standstill they give zero lateral slip. Steering and drive lag
//! exponentially, and bounds of speed are reached at their exact times. The result is exact at
//! constant speed and has an error of 1e-9 otherwise, from standstill to the largest speed, without
//! another model.
//!
//! The integration intervals grow. A change of steering leaves a transient that decays within v/178
//! s, so intervals begin with a length of v/438 and grow by half each: about twenty suffice for any
//! speed, and no interval is repeated.
//!
//! The study that compares integrators is a test and not a command: its reference is the implicit
//! solver of another crate, which only the tests depend on, and the other methods that it compares
//! are used by no part of the server. An agent's machine needs neither.

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

use path::ReferenceTrajectory;

pub use path::{Path, TimedPose};
pub use single_track::{Setpoint, SingleTrackState};
pub use vehicle::Vehicle;
pub use wildcity_options::DynamicsModel;

/// A motion model and its initial conditions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dynamics {
    pub model: DynamicsModel,
    /// Speed at the start of an episode, in m/s along the rig; 0 for a teleport.
    pub speed_m_s: f64,
    /// Whether braking beyond standstill makes the car go backwards; otherwise it stops.
    pub reverse: bool,
}

/// An agent's command for one step.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// The pose at the end of the step, `world_from_rig`.
    Pose(Pose),
    /// A trajectory to follow.
    Path(Path),
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
    /// Acceleration along the car, in m/s², within ±[`limits::EGO_ACCELERATION_M_S2`].
    pub acceleration_m_s2: f64,
    /// Curvature of the path of the rear axle, in 1/m, positive to the left, within
    /// ±[`limits::EGO_CURVATURE_1_M`]. The dynamic model steers such that it reaches this curvature
    /// in steady state.
    pub curvature_1_m: f64,
}

/// The state of an ego between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ego {
    dynamics: Dynamics,
    world_from_rig: Pose,
    velocity_m_s: DVec3,
    acceleration_m_s2: DVec3,
    yaw_rate_rad_s: f64,
    /// State in the frame of the rig's present pose: position and heading are zero.
    car: SingleTrackState,
    /// Whether at least one step was made.
    moved: bool,
}

/// A trajectory that is followed for several steps.
struct Plan<'a> {
    path: &'a Path,
    reference: &'a ReferenceTrajectory,
    /// The rig when it was made.
    world_from_start: Pose,
}

/// Why a command or dynamics were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EgoError {
    /// The model does not support this kind of command.
    #[error(
        "{given} does not move this ego, whose model is {model}: send {takes}, or open a session with other dynamics"
    )]
    Command {
        /// Name of the model.
        model: &'static str,
        /// The kind of command that was sent.
        given: &'static str,
        /// The kinds of command that the model supports.
        takes: &'static str,
    },
    /// A number is out of range.
    #[error("{field} is {value:?}; {least:?} to {most:?} are accepted")]
    Range {
        /// The field, by its name on the wire.
        field: &'static str,
        value: f64,
        least: f64,
        most: f64,
    },
    /// A path has too many poses, or none.
    #[error("the trajectory has {count} poses; 1 to {limit} are accepted")]
    PathCount { count: usize, limit: usize },
    /// The times of a path do not increase strictly.
    #[error(
        "trajectory[{index}].time_us is {time_us}; more than {before_us} and at most {limit_us} is accepted"
    )]
    PathTime {
        /// Index of the pose.
        index: usize,
        /// Its time, in microseconds.
        time_us: i64,
        /// Time of the previous pose, in microseconds.
        before_us: i64,
        /// The latest accepted, in microseconds.
        limit_us: i64,
    },
    /// A path ends before the step does.
    #[error("the trajectory ends at {end_us} µs and the step at {step_us} µs: send a longer one")]
    PathShort {
        /// Time of the last pose, in microseconds since the start of the step.
        end_us: i64,
        /// Duration of the step, in microseconds.
        step_us: i64,
    },
}

impl EgoError {
    /// The field at fault, by its name on the wire.
    pub fn field(&self) -> String {
        match self {
            Self::Command { given, .. } => (*given).to_owned(),
            Self::Range { field, .. } => (*field).to_owned(),
            Self::PathCount { .. } | Self::PathShort { .. } => "trajectory".to_owned(),
            Self::PathTime { index, .. } => format!("trajectory[{index}].time_us"),
        }
    }
}

impl TryFrom<wildcity_options::Dynamics> for Dynamics {
    type Error = EgoError;

    fn try_from(asked: wildcity_options::Dynamics) -> Result<Self, EgoError> {
        Self::checked(asked.model, asked.speed, asked.reverse)
    }
}

impl From<Dynamics> for wildcity_options::Dynamics {
    fn from(Dynamics { model, speed_m_s, reverse }: Dynamics) -> Self {
        Self { model, speed: speed_m_s, reverse }
    }
}

impl From<Dynamics> for wildcity_options::DynamicsChoice {
    fn from(dynamics: Dynamics) -> Self {
        Self::Full(dynamics.into())
    }
}

impl Dynamics {
    /// Dynamics from untrusted input.
    ///
    /// # Errors
    /// The speed is not finite or not within the bounds of the model.
    pub fn checked(model: DynamicsModel, speed_m_s: f64, reverse: bool) -> Result<Self, EgoError> {
        let dynamics = Self { model, speed_m_s, reverse };
        let [least, most] = match model {
            // A teleport has no speed of its own, so only 0 is meaningful.
            DynamicsModel::Teleport => [0.0, 0.0],
            DynamicsModel::Kinematic | DynamicsModel::Dynamic => dynamics.bounds_m_s(),
        };
        in_range("dynamics.speed", speed_m_s, [least, most])?;
        Ok(dynamics)
    }

    /// These dynamics with a different speed at the start, from the field `field` of a request.
    ///
    /// # Errors
    /// As [`Dynamics::checked`].
    pub fn with_speed(self, field: &'static str, speed_m_s: f64) -> Result<Self, EgoError> {
        // The same check, but the message must name the field of the request that had the value.
        let refused = |error| match error {
            EgoError::Range { value, least, most, .. } => {
                EgoError::Range { field, value, least, most }
            }
            other => other,
        };
        Self::checked(self.model, speed_m_s, self.reverse).map_err(refused)
    }

    /// The first pose of an episode that is requested to start at `world_from_rig`: the same pose,
    /// placed on the ground unless the model is a teleport.
    pub fn start_pose(&self, world_from_rig: Pose, ground: &Ground<'_>) -> Pose {
        match self.model {
            DynamicsModel::Teleport => world_from_rig,
            DynamicsModel::Kinematic | DynamicsModel::Dynamic => ground.place(world_from_rig),
        }
    }

    /// Smallest and largest speed, in m/s.
    fn bounds_m_s(&self) -> [f64; 2] {
        let back_m_s = if self.reverse { -limits::EGO_REVERSE_M_S } else { 0.0 };
        [back_m_s, limits::EGO_SPEED_M_S]
    }
}

impl Action {
    /// An action from untrusted input.
    ///
    /// # Errors
    /// A number is not finite or out of range.
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
    // The condition says what must hold, so that NaN is refused.
    let accepted = (least..=most).contains(&value);
    if accepted { Ok(()) } else { Err(EgoError::Range { field, value, least, most }) }
}

impl Ego {
    /// An ego at the start of an episode; `world_from_rig` comes from [`Dynamics::start_pose`].
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

    /// The ego after a step of `step_us` microseconds. `self` is not changed.
    ///
    /// # Errors
    /// The model does not support this kind of command, or a path ends before the step does.
    pub fn stepped(
        &self,
        command: &Command,
        step_us: i64,
        ground: &Ground<'_>,
    ) -> Result<Self, EgoError> {
        // A path that is too short is refused for every model, before any state is computed.
        if let Command::Path(path) = command
            && path.end_us() < step_us
        {
            return Err(EgoError::PathShort { end_us: path.end_us(), step_us });
        }
        let step_s = step_us as f64 * 1e-6;
        match (self.dynamics.model, command) {
            (DynamicsModel::Teleport, Command::Pose(pose)) => Ok(self.moved_to(*pose, step_s)),
            (DynamicsModel::Teleport, Command::Path(path)) => {
                Ok(self.moved_to(self.world_from_rig * path.at(step_us), step_s))
            }
            (_, Command::Action(action)) if self.dynamics.model != DynamicsModel::Teleport => {
                Ok(self.driven(self.advanced(&self.car, *action, step_s), step_s, ground))
            }
            (_, Command::Path(path)) => {
                let car = self.tracked(&path.reference(), self.car, 0, step_us);
                Ok(self.driven(car, step_s, ground))
            }
            // The remaining pairs are refusals: the models that move by actions have no use for a
            // pose, and a teleport none for an action.
            (model, Command::Action(_)) => {
                let takes = "pose or trajectory";
                Err(EgoError::Command { model: model.name(), given: "action", takes })
            }
            (model, Command::Pose(_)) => {
                let takes = "action or trajectory";
                Err(EgoError::Command { model: model.name(), given: "pose", takes })
            }
        }
    }

    /// The egos after each of `steps` steps along a plan, a trajectory or an action that holds for
    /// all of them. A plan of one step is [`Ego::stepped`].
    ///
    /// # Errors
    /// As [`Ego::stepped`]; the path must reach to the end of the last step.
    pub fn followed(
        &self,
        command: &Command,
        step_us: i64,
        steps: usize,
        ground: &Ground<'_>,
    ) -> Result<Vec<Self>, EgoError> {
        // The first step is computed like any single step, so its errors are the same. It also
        // checks the kind of the command.
        let mut egos = vec![self.stepped(command, step_us, ground)?];
        let Command::Path(path) = command else {
            // An action holds for every step, so each step is one of its own.
            for index in 1..steps {
                egos.push(egos[index - 1].stepped(command, step_us, ground)?);
            }
            return Ok(egos);
        };
        let end_us = step_us * steps as i64;
        if path.end_us() < end_us {
            return Err(EgoError::PathShort { end_us: path.end_us(), step_us: end_us });
        }
        // The reference is derived once for all steps: it depends only on the path.
        let reference = path.reference();
        for index in 1..steps {
            let plan = Plan { path, reference: &reference, world_from_start: self.world_from_rig };
            let since_us = step_us * index as i64;
            egos.push(egos[index - 1].on_path(&plan, since_us, step_us, ground));
        }
        Ok(egos)
    }

    /// The ego after a step along a plan that was made `since_us` microseconds before the step,
    /// when the rig was at `world_from_start`.
    ///
    /// # Errors
    /// As [`Ego::stepped`]; the path must reach to the end of the step.
    pub fn resumed(
        &self,
        command: &Command,
        world_from_start: Pose,
        since_us: i64,
        step_us: i64,
        ground: &Ground<'_>,
    ) -> Result<Self, EgoError> {
        let Command::Path(path) = command else { return self.stepped(command, step_us, ground) };
        let end_us = since_us + step_us;
        if path.end_us() < end_us {
            return Err(EgoError::PathShort { end_us: path.end_us(), step_us: end_us });
        }
        let plan = Plan { path, reference: &path.reference(), world_from_start };
        Ok(self.on_path(&plan, since_us, step_us, ground))
    }

    fn on_path(&self, plan: &Plan<'_>, since_us: i64, step_us: i64, ground: &Ground<'_>) -> Self {
        let Plan { path, reference, world_from_start } = plan;
        let step_s = step_us as f64 * 1e-6;
        match self.dynamics.model {
            DynamicsModel::Teleport => {
                self.moved_to(*world_from_start * path.at(since_us + step_us), step_s)
            }
            DynamicsModel::Kinematic | DynamicsModel::Dynamic => {
                // The reference stays in the frame of the plan's start. The car is moved into it,
                // instead of the path into the car's frame, so that no rounding accumulates over
                // the steps.
                let start_from_rig = world_from_start.inverse() * self.world_from_rig;
                let forward = start_from_rig.rotation * DVec3::X;
                let car = SingleTrackState {
                    position_m: start_from_rig.position_m.truncate(),
                    yaw_rad: forward.y.atan2(forward.x),
                    ..self.car
                };
                let after = self.tracked(reference, car, since_us, step_us);
                // `driven` expects the way since the present pose and not since the start of the
                // plan.
                self.driven(after.relative_to(&car), step_s, ground)
            }
        }
    }

    /// The dynamics that it was created with.
    pub fn dynamics(&self) -> Dynamics {
        self.dynamics
    }

    /// The pose of the rig in the world after the last step.
    pub fn world_from_rig(&self) -> Pose {
        self.world_from_rig
    }

    /// Present velocity of the rig's origin along world axes, in m/s. For a teleport it is the mean
    /// over the last step, and zero at the start.
    pub fn velocity_m_s(&self) -> DVec3 {
        self.velocity_m_s
    }

    /// Mean acceleration over the last step along world axes, in m/s²: the change of velocity
    /// divided by the step's duration. Zero at the start, and after the first step of a teleport,
    /// whose earlier velocity is unknown.
    pub fn acceleration_m_s2(&self) -> DVec3 {
        self.acceleration_m_s2
    }

    /// Present yaw rate about the rig's z axis, in rad/s. For a teleport it is the mean over the
    /// last step.
    pub fn yaw_rate_rad_s(&self) -> f64 {
        self.yaw_rate_rad_s
    }

    /// Angle of the front wheels, in radians, positive to the left; `None` for a teleport.
    pub fn steering_rad(&self) -> Option<f64> {
        (self.dynamics.model != DynamicsModel::Teleport).then_some(self.car.steering_rad)
    }

    fn moved_to(&self, world_from_rig: Pose, step_s: f64) -> Self {
        let way_m = world_from_rig.position_m - self.world_from_rig.position_m;
        let velocity_m_s = way_m / step_s;
        let turn = self.world_from_rig.rotation.inverse() * world_from_rig.rotation;
        // The rotation about z in the swing-twist decomposition: twice the angle of the (w, z)
        // part.
        let turned_rad = path::wrapped(2.0 * turn.z.atan2(turn.w));
        // Before the first step the velocity is 0 by definition and not by measurement. Its change
        // would be a false peak.
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

    /// The ego after its car moved in the plane of the rig.
    fn driven(&self, car: SingleTrackState, step_s: f64, ground: &Ground<'_>) -> Self {
        let start_from_rig = Pose {
            position_m: car.position_m.extend(0.0),
            rotation: DQuat::from_rotation_z(car.yaw_rad),
        };
        // A car that does not move keeps its pose bit by bit: the product would be normalised once
        // more.
        let world_from_rig = if start_from_rig == Pose::IDENTITY {
            self.world_from_rig
        } else {
            ground.place(self.world_from_rig * start_from_rig)
        };
        // The state has the velocity of the centre of gravity, and the rig's origin is the rear
        // axle: u - l_r ω.
        let rear_m_s = car.lateral_m_s - Vehicle::DEFAULT.rear_to_cg_m * car.yaw_rate_rad_s;
        let velocity_m_s = world_from_rig.rotation * DVec3::new(car.speed_m_s, rear_m_s, 0.0);
        Self {
            dynamics: self.dynamics,
            world_from_rig,
            velocity_m_s,
            acceleration_m_s2: (velocity_m_s - self.velocity_m_s) / step_s,
            yaw_rate_rad_s: car.yaw_rate_rad_s,
            // The pose in the world has the position from here on. The car's own starts at zero
            // again, so that its numbers stay small.
            car: SingleTrackState { position_m: DVec2::ZERO, yaw_rad: 0.0, ..car },
            moved: true,
        }
    }

    /// The car after `step_s` of an action.
    fn advanced(&self, car: &SingleTrackState, action: Action, step_s: f64) -> SingleTrackState {
        let vehicle = Vehicle::DEFAULT;
        let bounds_m_s = self.dynamics.bounds_m_s();
        if self.dynamics.model == DynamicsModel::Kinematic {
            return kinematic::rolled(car, &vehicle, action, step_s, bounds_m_s);
        }
        let steering_rad = vehicle.steering_rad(action.curvature_1_m, car.speed_m_s);
        // At speed, understeer asks for an angle beyond what the wheels reach.
        let most_rad = limits::EGO_STEERING_RAD;
        let setpoint = Setpoint {
            acceleration_m_s2: action.acceleration_m_s2,
            steering_rad: steering_rad.clamp(-most_rad, most_rad),
        };
        car.after(&vehicle, setpoint, step_s, bounds_m_s)
    }

    /// The car after a step along a reference: the tracker computes a new action for each tick. The
    /// step begins at the time `from_us` of the reference, and `car` is in its frame.
    fn tracked(
        &self,
        reference: &ReferenceTrajectory,
        car: SingleTrackState,
        from_us: i64,
        step_us: i64,
    ) -> SingleTrackState {
        let from_s = from_us as f64 * 1e-6;
        let lag_s = match self.dynamics.model {
            DynamicsModel::Dynamic => Vehicle::DEFAULT.lag_s,
            // The kinematic model reaches a command at once.
            DynamicsModel::Teleport | DynamicsModel::Kinematic => 0.0,
        };
        // Ticks of equal length of at most `TRACKER_TICK_US`, so that the last one is not a
        // remnant.
        let ticks = (step_us as u64).div_ceil(limits::TRACKER_TICK_US);
        let tick_s = step_us as f64 * 1e-6 / ticks as f64;
        (0..ticks).fold(car, |car, tick| {
            let time_s = from_s + tick as f64 * tick_s;
            let action = tracker::track(reference, time_s, lag_s, &car);
            self.advanced(&car, action, tick_s)
        })
    }
}
