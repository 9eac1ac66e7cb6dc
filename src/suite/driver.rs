//! The built-in agents.

use glam::DVec3;

use wildcity_episode::pose_at;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_session::{Episode, Session};
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::scenario::{FileError, Scenario};
use wildcity_sim::traffic::{Idm, rolled};
use wildcity_sim::{Command, DynamicsModel};

use crate::case::Case;

/// Agents that come with the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuiltIn {
    /// Drives as recorded. On the bare twin it must pass: it is each scenario's own test.
    Log,
    /// Brakes to standstill, and stays there.
    Stand,
    /// Follows the recorded line by the Intelligent Driver Model.
    Idm,
}

/// Poses of a trajectory command, 0.1 s apart: 2 s.
const PLAN_POSES: i64 = 20;
const PLAN_STEP_US: i64 = 100_000;
/// Braking of an agent that stands, in m/s².
const BRAKING_MPS2: f64 = 4.0;
/// Lowest free-flow speed for `idm`, in m/s, for recordings that are slower.
const LEAST_FREE_MPS: f64 = 5.0;

impl BuiltIn {
    /// An agent by its name.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "log" => Some(Self::Log),
            "stand" => Some(Self::Stand),
            "idm" => Some(Self::Idm),
            _ => None,
        }
    }

    /// The name that `--agent` takes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Log => "log",
            Self::Stand => "stand",
            Self::Idm => "idm",
        }
    }

    /// Checks that a scenario has what this agent follows: `log` a recorded drive, which is
    /// `drive`, and `idm` a route.
    ///
    /// # Errors
    /// Names the field to add.
    pub fn check(self, scenario: &Scenario, drive: Option<&Trajectory>) -> Result<(), FileError> {
        match self {
            Self::Log if drive.is_none() => Err(FileError::new(
                "route.trajectory",
                "is missing: the agent log follows a recorded drive of the twin; name it there, or start on it with \
                 ego.start.trajectory (`wildcity twin drive` gives a twin a drive)",
            )),
            Self::Idm if scenario.route.is_none() => Err(FileError::new(
                "route",
                "is missing: the agent idm follows a route; write route.lanes (of a map), route.points, or \
                 route.trajectory (a recorded drive, which `wildcity twin drive` gives a twin)",
            )),
            Self::Log | Self::Idm | Self::Stand => Ok(()),
        }
    }

    /// The command for the next step.
    ///
    /// # Errors
    /// The scenario has no recorded drive, which this agent follows ([`Self::check`]).
    pub(crate) fn command(self, case: &Case, session: &Session) -> Result<Command, String> {
        let episode = session.episode();
        let teleports = episode.ego().dynamics().model == DynamicsModel::Teleport;
        let dt_us = case.options.dt_us.unwrap_or(wildcity_session::limits::DT_US);
        match self {
            // It takes its own pose: a teleport stands by being told where it is.
            Self::Stand if teleports => Ok(Command::Pose(episode.world_from_rig())),
            Self::Stand => {
                let speed_mps = episode.ego().velocity_m_s().length();
                // Not more than stops the car within the step, because more would be a request to
                // drive backwards.
                let braking = -BRAKING_MPS2.min(speed_mps / (dt_us as f64 * 1e-6));
                let action = Action::checked(braking, 0.0).map_err(|error| error.to_string())?;
                Ok(Command::Action(action))
            }
            Self::Log => {
                let drive = case.drive.as_ref().ok_or("there is no recorded drive to follow")?;
                // Times of the episode are shifted to the clock of the recording.
                let at = |time_us: i64| pose_at(drive, case.drive_start_us + time_us);
                follow(teleports, episode, dt_us, &at)
            }
            Self::Idm => {
                let plan = IdmPlan::new(case, session)?;
                follow(teleports, episode, dt_us, &|time_us| plan.at(time_us - episode.time_us()))
            }
        }
    }
}

/// A command that leads along poses by time, in microseconds since the episode's start.
fn follow(
    teleports: bool,
    episode: &Episode,
    dt_us: i64,
    at: &dyn Fn(i64) -> Pose,
) -> Result<Command, String> {
    let now_us = episode.time_us();
    if teleports {
        return Ok(Command::Pose(at(now_us + dt_us)));
    }
    let rig_from_world = episode.world_from_rig().inverse();
    // At least to the end of the step, which the path must cover.
    let count = PLAN_POSES.max(dt_us / PLAN_STEP_US + 1);
    let poses = (1..=count).map(|k| {
        let time_us = k * PLAN_STEP_US;
        TimedPose { time_us, start_from_rig: rig_from_world * at(now_us + time_us) }
    });
    let path = Path::checked(poses.collect()).map_err(|error| error.to_string())?;
    Ok(Command::Path(path))
}

/// A plan of the Intelligent Driver Model along the route, behind the nearest actor; the end of the
/// route is a wall.
struct IdmPlan<'a> {
    case: &'a Case,
    /// Station at each 10 ms from now.
    stations_m: Vec<f64>,
}

/// Reference of the ego.
#[derive(Clone, Copy)]
struct Lead {
    /// The station of the ego's origin at which its front would touch, in metres.
    rear_m: f64,
    /// Speed along the route, in m/s.
    speed_mps: f64,
}

/// The nearest actor ahead in the corridor of the ego's width.
fn lead(case: &Case, session: &Session, station_m: f64) -> Option<Lead> {
    let traffic = session.traffic()?;
    let course = &case.resolved.route.as_ref()?.course;
    let ego = case.resolved.traffic.ego_box;
    let front_m = ego.center_x_m + 0.5 * ego.box_.length_m;
    let there = traffic.states().iter().filter(|state| state.present);
    let leads = there.filter_map(|state| {
        let spec = traffic.specs().get(usize::from(state.index))?;
        let beside = course.nearest(state.world_from_actor.position_m);
        let ahead = course.at(beside.station_m).rotation * DVec3::X;
        let own_forward = state.world_from_actor.rotation * DVec3::X;
        // Rounding may bring the product above 1, and the root below needs a positive number.
        let cos = own_forward.dot(ahead).abs().min(1.0);
        let sin = (1.0 - cos * cos).sqrt();
        let half_along_m = 0.5 * (spec.box_.length_m * cos + spec.box_.width_m * sin);
        let half_across_m = 0.5 * (spec.box_.length_m * sin + spec.box_.width_m * cos);
        // Half of both widths and the room on the side: nearer than this, the boxes would meet.
        let reach_m = half_across_m + 0.5 * ego.box_.width_m + SIDE_M;
        let is_ahead = beside.station_m > station_m && beside.left_m.abs() < reach_m;
        // Where the ego's origin is when its front touches the actor's rear.
        let rear_m = beside.station_m - half_along_m - front_m;
        is_ahead.then(|| Lead { rear_m, speed_mps: state.velocity_mps.dot(ahead).max(0.0) })
    });
    leads.min_by(|a, b| a.rear_m.total_cmp(&b.rear_m))
}

/// Room that `idm` keeps on each side, in metres.
const SIDE_M: f64 = 0.3;

/// Step of the plan, in microseconds.
const IDM_STEP_US: i64 = 10_000;

impl<'a> IdmPlan<'a> {
    fn new(case: &'a Case, session: &Session) -> Result<Self, String> {
        let episode = session.episode();
        let route = case.resolved.route.as_ref().ok_or("there is no route to follow")?;
        let course = &route.course;
        let length_m = course.length_m();
        let begin = course.nearest(episode.world_from_rig().position_m);
        let whole_s = case.line.limit_us.unwrap_or(0) as f64 * 1e-6;
        // The speed at which the route takes exactly the time limit.
        let free_speed_mps = if whole_s > 0.0 {
            (length_m / whole_s).max(LEAST_FREE_MPS)
        } else {
            Idm::WILDCITY.free_speed_mps
        };
        // The braking is not clipped, because a driver that must pass needs to be able to stop.
        let idm = Idm { free_speed_mps, clipped: false, ..Idm::WILDCITY };
        let lead = lead(case, session, begin.station_m);
        let forward = episode.world_from_rig().rotation * DVec3::X;
        let mut speed_mps = episode.ego().velocity_m_s().dot(forward).max(0.0);
        let mut station_m = begin.station_m;
        let mut stations_m = vec![station_m];
        // As long as the longest step and the path after it.
        let plan_us = PLAN_POSES * PLAN_STEP_US + wildcity_session::limits::DT_MAX_US;
        for step in 0..plan_us / IDM_STEP_US {
            let wall_m = length_m - station_m;
            let mut acceleration = idm.acceleration(speed_mps, 0.0, wall_m);
            if let Some(Lead { rear_m, speed_mps: lead_mps }) = lead {
                let ahead_s = (step * IDM_STEP_US) as f64 * 1e-6;
                // The lead is assumed to keep its speed.
                let gap_m = rear_m + lead_mps * ahead_s - station_m;
                acceleration = acceleration.min(idm.acceleration(speed_mps, lead_mps, gap_m));
            }
            let [way_m, end_mps] = rolled(speed_mps, acceleration, IDM_STEP_US as f64 * 1e-6);
            station_m += way_m;
            speed_mps = end_mps;
            stations_m.push(station_m);
        }
        Ok(Self { case, stations_m })
    }

    /// The pose after a time from now.
    fn at(&self, after_us: i64) -> Pose {
        let last = self.stations_m.len() - 1;
        // A negative time is the present. Beyond the plan its last place holds.
        let step = usize::try_from(after_us / IDM_STEP_US).unwrap_or(0).min(last);
        match &self.case.resolved.route {
            Some(route) => route.course.at(self.stations_m[step]),
            None => Pose::IDENTITY,
        }
    }
}
