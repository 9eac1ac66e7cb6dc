//! Where an episode starts, and the part of the recorded drive before it.

use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Manifest, Trajectory};
use wildcity_sim::{Dynamics, Ego, Ground};

use crate::episode::Episode;
use crate::error::SessionError;
use crate::limits;
use crate::options::Start;

/// The start of an episode, resolved against a version of the twin.
#[derive(Clone, Debug)]
pub(crate) struct EpisodeStart {
    /// The recorded drive before the start: poses at rising times below 0; empty without a warm-up.
    warm_up: Vec<Keyframe>,
    /// Where the ego starts, on the ground if its dynamics need one.
    world_from_rig: Pose,
}

impl EpisodeStart {
    /// Resolves a start. Without one, the episode starts where the first recorded drive begins, or after
    /// `warm_up_us` of that drive; on a twin without a drive, at the world's origin.
    ///
    /// # Errors
    /// The trajectory does not exist or is too short, or `warm_up_us` is out of range or impossible.
    pub(crate) fn resolve(
        manifest: &Manifest,
        start: Option<&Start>,
        warm_up_us: i64,
        dynamics: Dynamics,
    ) -> Result<Self, SessionError> {
        let drives = &manifest.trajectories;
        let mut resolved = match start {
            Some(Start::Pose(pose)) => Self::at_pose(*pose, warm_up_us)?,
            Some(Start::Station { trajectory, station_m }) => {
                Self::at_station(drives, trajectory, *station_m, warm_up_us)?
            }
            None => Self::at_first_drive(drives, warm_up_us)?,
        };
        let ground = Ground::from_drives(drives);
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
        let drive = drives.iter().find(|drive| drive.name == name).ok_or_else(|| {
            let known = drives.iter().map(|drive| drive.name.clone()).collect();
            SessionError::UnknownTrajectory { name: name.to_owned(), known }
        })?;
        let length_m = drive.length_m();
        if !(0.0..=length_m).contains(&station_m) {
            let must = format!("{station_m} m; {name:?} is from 0 to {length_m} m long");
            return Err(SessionError::OutOfRange { field: "start.station_m", must });
        }
        if warm_up_us == 0 {
            let world_from_rig = drive.at_station(station_m);
            return Ok(Self { warm_up: Vec::new(), world_from_rig });
        }
        let start_us = Route::new(drive)?.at(station_m).time_us;
        Self::with_warm_up(drive, start_us, warm_up_us)
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

    /// A start at a time of the drive, after the `warm_up_us` of the drive before it.
    fn with_warm_up(
        drive: &Trajectory,
        start_us: i64,
        warm_up_us: i64,
    ) -> Result<Self, SessionError> {
        let route = Route::new(drive)?;
        let from_us = start_us.saturating_sub(warm_up_us);
        let pose_at = |time_us: i64| {
            route
                .pose_at(time_us)
                .map_err(|cause| warm_up_error(format!("{warm_up_us} µs; {cause}")))
        };
        let first = Keyframe { time_us: -warm_up_us, world_from_rig: pose_at(from_us)? };
        let world_from_rig = pose_at(start_us)?;
        let between = drive
            .keyframes
            .iter()
            .filter(|key| (from_us + 1..start_us).contains(&key.time_us))
            .map(|key| Keyframe { time_us: key.time_us - start_us, ..*key });
        Ok(Self { warm_up: std::iter::once(first).chain(between).collect(), world_from_rig })
    }

    /// The start of a recorded episode; `state` is the one at the beginning of its file.
    pub(crate) fn recorded(world_from_rig: Pose, state: Option<&Episode>) -> Self {
        let warm_up = state.map(Episode::warm_up).unwrap_or_default();
        Self { warm_up, world_from_rig }
    }

    /// `world_from_rig` of the start.
    pub(crate) fn world_from_rig(&self) -> Pose {
        self.world_from_rig
    }

    /// An episode that begins here.
    pub(crate) fn episode(&self, seed: u64, dynamics: Dynamics, dt_us: i64) -> Episode {
        let ego = Ego::new(dynamics, self.world_from_rig);
        Episode::with_warm_up(seed, ego, &self.warm_up, dt_us)
    }
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
