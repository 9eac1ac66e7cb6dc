//! Where an episode starts, and the part of the recorded drive before it.

use glam::{DQuat, DVec3};

use wildcity_options::{RandomStart, Start};
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;
use wildcity_scene::route::Route;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Manifest, Trajectory};
use wildcity_sim::map::LaneSurface;
use wildcity_sim::{Dynamics, Ego, Ground};

use crate::episode::Episode;
use crate::error::SessionError;
use crate::limits;
use crate::scenario::{LoadedScenario, requested_start};

/// The start of an episode, resolved against a version of the twin.
#[derive(Clone, Debug)]
pub(crate) struct EpisodeStart {
    /// The recorded drive before the start: poses at rising times below 0; empty without a warm-up.
    warm_up: Vec<Keyframe>,
    /// Where the ego starts, on the ground if its dynamics need one.
    world_from_rig: Pose,
}

/// Where an episode of a scenario starts, if its request gives no start, dynamics and warm-up of
/// its own: `world_from_rig`.
///
/// # Errors
/// The scenario's warm-up is out of range, or impossible at its start.
pub fn scenario_start(loaded: &LoadedScenario, manifest: &Manifest) -> Result<Pose, SessionError> {
    let scenario = &loaded.scenario;
    let start = scenario.start.as_ref().map(requested_start);
    let warm_up_us = scenario.warm_up_us.unwrap_or(0);
    let dynamics = scenario.dynamics.unwrap_or_default();
    // No start of a scenario is sampled by the session, so that the seed has no effect.
    let seed = 0;
    let lanes = loaded.lanes();
    EpisodeStart::resolve(manifest, start.as_ref(), warm_up_us, dynamics, seed, lanes)
        .map(|start| start.world_from_rig)
}

impl EpisodeStart {
    /// Resolves a start; `seed` is that of the episode, `lanes` the road of its scenario's
    /// map. Without a start, the episode starts where the first recorded drive begins, or after
    /// `warm_up_us` of that drive; on a twin without a drive, at the world's origin.
    ///
    /// # Errors
    /// The trajectory does not exist or is too short, or `warm_up_us` is out of range or
    /// impossible.
    pub(crate) fn resolve(
        manifest: &Manifest,
        start: Option<&Start>,
        warm_up_us: i64,
        dynamics: Dynamics,
        seed: u64,
        lanes: Option<&LaneSurface>,
    ) -> Result<Self, SessionError> {
        let drives = &manifest.trajectories;
        let mut resolved = match start {
            Some(Start::Pose { pose }) => Self::at_pose(checked_pose(*pose)?, warm_up_us)?,
            Some(Start::Station { trajectory, station_m }) => {
                Self::at_station(drives, trajectory, *station_m, warm_up_us)?
            }
            Some(Start::Random { random }) => Self::at_random(drives, random, warm_up_us, seed)?,
            None => Self::at_first_drive(drives, warm_up_us)?,
        };
        // Whatever the kind of start, an ego on wheels is put onto the ground.
        let ground = Ground::from_drives(drives).and_lanes(lanes);
        resolved.world_from_rig = dynamics.start_pose(resolved.world_from_rig, &ground);
        Ok(resolved)
    }

    fn at_pose(world_from_rig: Pose, warm_up_us: i64) -> Result<Self, SessionError> {
        check_warm_up(warm_up_us)?;
        if warm_up_us > 0 {
            let must = format!("{warm_up_us} µs; only a start along a trajectory can have one");
            return Err(warm_up_error(must));
        }
        Ok(Self { warm_up: Vec::new(), world_from_rig })
    }

    fn at_station(
        drives: &[Trajectory],
        name: &str,
        station_m: f64,
        warm_up_us: i64,
    ) -> Result<Self, SessionError> {
        check_warm_up(warm_up_us)?;
        let drive = find_drive(drives, "start.trajectory", name)?;
        let length_m = drive.length_m();
        if !(0.0..=length_m).contains(&station_m) {
            let must = format!("{station_m} m; trajectory {name:?} is {length_m} m long");
            return Err(SessionError::OutOfRange { field: "start.station_m", must });
        }
        // Only the times of a warm-up need a route.
        if warm_up_us == 0 {
            let world_from_rig = drive.at_station(station_m);
            return Ok(Self { warm_up: Vec::new(), world_from_rig });
        }
        let start_us = Route::new(drive)?.at(station_m).time_us;
        Self::with_warm_up(drive, start_us, warm_up_us)
    }

    /// Samples a start. With a warm-up, the drive before the start is moved and rotated with it.
    fn at_random(
        drives: &[Trajectory],
        random: &RandomStart,
        warm_up_us: i64,
        seed: u64,
    ) -> Result<Self, SessionError> {
        let RandomStart { trajectory, from_m, to_m, lateral_m, heading_rad } = random;
        check_warm_up(warm_up_us)?;
        let drive = match (trajectory, drives.first()) {
            (Some(name), _) => find_drive(drives, "start.random.trajectory", name)?,
            (None, Some(first)) => first,
            (None, None) => {
                let must = "a draw along a trajectory, and the twin has none".to_owned();
                return Err(SessionError::OutOfRange { field: "start.random", must });
            }
        };
        let lateral_m = lateral_m.unwrap_or(0.0);
        let heading_rad = heading_rad.unwrap_or(0.0);
        check_jitter("start.random.lateral_m", lateral_m, limits::START_LATERAL_M)?;
        check_jitter("start.random.heading_rad", heading_rad, std::f64::consts::PI)?;

        // The stations between which the start is sampled.
        let route = Route::new(drive)?;
        let length_m = route.length_m();
        let begin_us = drive.keyframes.first().map_or(0, |first| first.time_us);
        // Before this station there is not enough of the drive for the warm-up.
        let warm_m = match warm_up_us {
            0 => 0.0,
            _ => route.station_at(begin_us.saturating_add(warm_up_us)),
        };
        let first_m = from_m.unwrap_or(warm_m);
        let last_m = to_m.unwrap_or(length_m);
        if !(warm_m..=length_m).contains(&first_m) {
            let must = format!("{first_m} m; {warm_m} to {length_m} m are accepted");
            return Err(SessionError::OutOfRange { field: "start.random.from_m", must });
        }
        if !(first_m..=length_m).contains(&last_m) {
            let must = format!("{last_m} m; {first_m} to {length_m} m are accepted");
            return Err(SessionError::OutOfRange { field: "start.random.to_m", must });
        }

        // Use one random stream for each value, so that a change of one range does not change the
        // other values.
        let draw = |name: &str, low: f64, high: f64| {
            // An empty range has no random value.
            if low < high { Random::new(seed, name, 0).range(low, high) } else { low }
        };
        let station_m = draw("start station", first_m, last_m);
        let aside_m = draw("start lateral", -lateral_m, lateral_m);
        let turn_rad = draw("start heading", -heading_rad, heading_rad);

        let drawn = Self::at_station(drives, &drive.name, station_m, warm_up_us)?;
        // In the axes of the rig: y points to the left.
        let offset = Pose {
            position_m: DVec3::new(0.0, aside_m, 0.0),
            rotation: DQuat::from_rotation_z(turn_rad),
        };
        Ok(drawn.moved_by(offset))
    }

    /// Moves the rig, and the drive before the start, by an offset in the rig's frame.
    fn moved_by(self, offset: Pose) -> Self {
        let world_from_rig = self.world_from_rig * offset;
        // The motion in the world that brings the old start to the new one: all poses before it
        // move alike.
        let moved = world_from_rig * self.world_from_rig.inverse();
        let moved_key =
            |key: Keyframe| Keyframe { world_from_rig: moved * key.world_from_rig, ..key };
        Self { warm_up: self.warm_up.into_iter().map(moved_key).collect(), world_from_rig }
    }

    fn at_first_drive(drives: &[Trajectory], warm_up_us: i64) -> Result<Self, SessionError> {
        check_warm_up(warm_up_us)?;
        match drives.first() {
            None if warm_up_us == 0 => Self::at_pose(Pose::IDENTITY, 0),
            None => Err(warm_up_error(format!("{warm_up_us} µs; the twin has no trajectory"))),
            Some(drive) if warm_up_us == 0 => Self::at_pose(drive.at_station(0.0), 0),
            Some(drive) => {
                let first_us = drive.keyframes.first().map_or(0, |first| first.time_us);
                Self::with_warm_up(drive, first_us.saturating_add(warm_up_us), warm_up_us)
            }
        }
    }

    /// A start at a time of the drive, after `warm_up_us` of the drive.
    fn with_warm_up(
        drive: &Trajectory,
        start_us: i64,
        warm_up_us: i64,
    ) -> Result<Self, SessionError> {
        let route = Route::new(drive)?;
        let from_us = start_us.saturating_sub(warm_up_us);
        // The warm-up reaches beyond the drive: the field at fault is its length.
        let pose_at = |time_us: i64| {
            route
                .pose_at(time_us)
                .map_err(|cause| warm_up_error(format!("{warm_up_us} µs; {cause}")))
        };
        let first = Keyframe { time_us: -warm_up_us, world_from_rig: pose_at(from_us)? };
        let world_from_rig = pose_at(start_us)?;
        // Both ends are there already, so that these lie strictly between them.
        let between = drive
            .keyframes
            .iter()
            .filter(|key| (from_us + 1..start_us).contains(&key.time_us))
            .map(|key| Keyframe { time_us: key.time_us - start_us, ..*key });
        Ok(Self { warm_up: std::iter::once(first).chain(between).collect(), world_from_rig })
    }

    /// The start of a recorded episode; `state` is the state at the beginning of its file.
    pub(crate) fn recorded(world_from_rig: Pose, state: Option<&Episode>) -> Self {
        let warm_up = state.map(Episode::warm_up).unwrap_or_default();
        Self { warm_up, world_from_rig }
    }

    /// Converts the start for other dynamics, on this ground if they need one.
    pub(crate) fn placed(&self, ground: &Ground<'_>, dynamics: Dynamics) -> Self {
        let world_from_rig = dynamics.start_pose(self.world_from_rig, ground);
        Self { warm_up: self.warm_up.clone(), world_from_rig }
    }

    /// `world_from_rig` of the start.
    pub(crate) fn world_from_rig(&self) -> Pose {
        self.world_from_rig
    }

    /// An episode that begins at this start.
    pub(crate) fn episode(&self, seed: u64, dynamics: Dynamics, dt_us: i64) -> Episode {
        let ego = Ego::new(dynamics, self.world_from_rig);
        Episode::with_warm_up(seed, ego, &self.warm_up, dt_us)
    }
}

/// The pose of a start, `world_from_rig`.
pub(crate) fn checked_pose(pose: wildcity_options::Pose) -> Result<Pose, SessionError> {
    Pose::try_from(pose)
        .map_err(|cause| SessionError::Pose { field: "start.pose".to_owned(), cause })
}

/// The drive of a name; `field` is the field of the request that has the name.
fn find_drive<'a>(
    drives: &'a [Trajectory],
    field: &'static str,
    name: &str,
) -> Result<&'a Trajectory, SessionError> {
    drives.iter().find(|drive| drive.name == name).ok_or_else(|| {
        let known = drives.iter().map(|drive| drive.name.clone()).collect();
        SessionError::UnknownTrajectory { field, name: name.to_owned(), known }
    })
}

fn check_jitter(field: &'static str, value: f64, most: f64) -> Result<(), SessionError> {
    if (0.0..=most).contains(&value) {
        return Ok(());
    }
    Err(SessionError::OutOfRange { field, must: format!("{value}; 0 to {most} are accepted") })
}

fn check_warm_up(warm_up_us: i64) -> Result<(), SessionError> {
    let limits_us = 0..=limits::WARM_UP_US;
    if !limits_us.contains(&warm_up_us) {
        return Err(warm_up_error(format!("{warm_up_us} µs; {limits_us:?} µs are accepted")));
    }
    Ok(())
}

fn warm_up_error(must: String) -> SessionError {
    SessionError::OutOfRange { field: "warm_up_us", must }
}
