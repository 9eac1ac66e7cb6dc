//! What opens a session, resolved against the twin.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::limits;
use wildcity_scene::ProfileOverrides;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{Rig, RigCamera, check_overlay_pixels};
use wildcity_scene::route::Route;
use wildcity_sim::Dynamics;
use wildcity_twin::residency::Resident;

use crate::error::SessionError;
use crate::observe::encode::Encoding;

/// What opens a session. What is `None` is chosen by the twin or by `config`.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionOptions {
    /// Name of the twin.
    pub twin: String,
    /// Its version; the latest if absent.
    pub version: Option<u64>,
    /// Seed of the first episode.
    pub seed: u64,
    /// Where to start: else the start of the twin's first trajectory, else the world's origin.
    pub start: Option<Start>,
    /// Cameras: else the twin's rig, else the preset `vehicle6`.
    pub rig: Option<RigChoice>,
    /// What of the twin's render profile is to be otherwise.
    pub profile: ProfileOverrides,
    /// What each observation holds.
    pub outputs: Outputs,
    /// How the ego moves.
    pub dynamics: Dynamics,
    /// Simulated time of a step, in microseconds.
    pub dt_us: Option<i64>,
    /// Time between two decisions of the agent, in microseconds: it looks at images only then. A
    /// step if absent.
    pub decision_us: Option<i64>,
    /// What lies before the start, in microseconds: poses and frames of the recorded drive.
    pub warm_up_us: i64,
    /// How long one answer may take.
    pub deadline: Option<Duration>,
}

impl SessionOptions {
    /// The latest version of a twin, and every default.
    pub fn twin(twin: impl Into<String>, outputs: Outputs) -> Self {
        Self {
            twin: twin.into(),
            version: None,
            seed: 0,
            start: None,
            rig: None,
            profile: ProfileOverrides::default(),
            outputs,
            dynamics: Dynamics::default(),
            dt_us: None,
            decision_us: None,
            warm_up_us: 0,
            deadline: None,
        }
    }
}

/// Where an episode starts.
#[derive(Clone, Debug, PartialEq)]
pub enum Start {
    /// At a pose, `world_from_rig`.
    Pose(Pose),
    /// Along a recorded trajectory.
    Station {
        /// Its name.
        trajectory: String,
        /// Distance along it, in metres, within its length.
        station_m: f64,
    },
}

/// Which cameras.
#[derive(Clone, Debug, PartialEq)]
pub enum RigChoice {
    /// A rig that comes with the program.
    Preset(String),
    /// One written out; checked with [`Rig::check`] by whoever built it.
    Full(Rig),
}

/// What each observation holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Outputs {
    /// Names of the cameras, in the order wanted; all if absent.
    pub cameras: Option<Vec<String>>,
    /// Other parts and sizes of images, by camera.
    pub images: BTreeMap<String, ImagePart>,
    /// How colour images travel.
    pub encoding: Encoding,
    /// What else of every image.
    pub maps: PixelMaps,
    /// How many last frames of each camera; 1 if absent.
    pub frames: Option<u64>,
    /// Whether to say how far each image may be believed.
    pub trust: bool,
    /// Time between two frames, in microseconds, of cameras that do not take one with every step.
    pub periods_us: BTreeMap<String, i64>,
}

impl Outputs {
    /// Colour of all cameras, at every step.
    pub fn colour(encoding: Encoding) -> Self {
        Self {
            cameras: None,
            images: BTreeMap::new(),
            encoding,
            maps: PixelMaps::default(),
            frames: None,
            trust: false,
            periods_us: BTreeMap::new(),
        }
    }
}

/// What an observation holds of an image beside its colours, all f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelMaps {
    /// Expected depth in metres, `[height, width]`.
    pub depth: bool,
    /// Accumulated opacity, `[height, width]`.
    pub opacity: bool,
    /// Unit normals in the camera's axes, `[height, width, 3]`.
    pub normals: bool,
}

impl PixelMaps {
    /// Values per pixel.
    pub(crate) fn values(self) -> usize {
        usize::from(self.depth) + usize::from(self.opacity) + 3 * usize::from(self.normals)
    }
}

/// What is drawn of a camera's image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImagePart {
    /// First column and row, width and height, in the rig's pixels.
    pub crop: Option<[u64; 4]>,
    /// Width and height that it is drawn at.
    pub size: Option<[u64; 2]>,
}

/// The rig's name and the wanted cameras in the wanted order, as they are to be drawn.
pub(crate) fn choose_cameras(
    resident: &Resident,
    choice: Option<RigChoice>,
    outputs: &Outputs,
) -> Result<(String, Vec<RigCamera>), SessionError> {
    let (rig, mut cameras) = whole_cameras(resident, choice, outputs)?;
    let refused = |must: String| SessionError::OutOfRange { field: "outputs.images", must };
    // Before any overlay is made larger.
    let drawn_pixels = |camera: &RigCamera| {
        let whole = [camera.camera.width_px, camera.camera.height_px].map(u64::from);
        let part = outputs.images.get(&camera.name).copied().unwrap_or_default();
        let cropped = part.crop.map_or(whole, |[_, _, width, height]| [width, height]);
        let [width, height] = part.size.unwrap_or(cropped);
        width.saturating_mul(height)
    };
    let overlaid = cameras.iter().filter(|camera| camera.appearance.overlay.is_some());
    let pixels = overlaid.map(drawn_pixels).fold(0, u64::saturating_add);
    check_overlay_pixels(pixels).map_err(|cause| refused(cause.to_string()))?;
    for (name, ImagePart { crop, size }) in &outputs.images {
        let drawn = cameras.iter_mut().find(|camera| camera.name == *name);
        let camera = drawn.ok_or_else(|| refused(format!("camera {name:?}: it is not drawn")))?;
        if let Some([left, top, width, height]) = *crop {
            let part = camera.cropped([left, top], [width, height]);
            *camera = part.map_err(|cause| refused(cause.to_string()))?;
        }
        if let Some([width, height]) = *size {
            let scaled = camera.scaled(width, height);
            *camera = scaled.map_err(|cause| refused(cause.to_string()))?;
        }
    }
    Ok((rig, cameras))
}

/// The same as the rig has them.
fn whole_cameras(
    resident: &Resident,
    choice: Option<RigChoice>,
    outputs: &Outputs,
) -> Result<(String, Vec<RigCamera>), SessionError> {
    let preset = |name: &str| {
        Rig::preset(name).ok_or_else(|| SessionError::UnknownRig {
            name: name.to_owned(),
            known: Rig::preset_names().collect(),
        })
    };
    let rig = match choice {
        Some(RigChoice::Full(rig)) => rig,
        Some(RigChoice::Preset(name)) => preset(&name)?,
        None => match &resident.version.manifest.rig {
            Some(rig) => rig.clone(),
            None => preset(limits::RIG)?,
        },
    };
    let Some(names) = &outputs.cameras else { return Ok((rig.name, rig.cameras)) };
    if !(1..=rig.cameras.len()).contains(&names.len()) {
        let must = format!("{} names; 1 to {} are accepted", names.len(), rig.cameras.len());
        return Err(SessionError::OutOfRange { field: "outputs.cameras", must });
    }
    let mut chosen: Vec<RigCamera> = Vec::with_capacity(names.len());
    for (index, name) in names.iter().enumerate() {
        let camera = rig.cameras.iter().find(|camera| camera.name == *name).ok_or_else(|| {
            let known = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
            let field = format!("outputs.cameras[{index}]");
            SessionError::UnknownCamera { field, name: name.clone(), known }
        })?;
        if chosen.contains(camera) {
            return Err(SessionError::CameraTwice { index, name: name.clone() });
        }
        chosen.push(camera.clone());
    }
    Ok((rig.name, chosen))
}

/// Where the rig was (`world_from_rig`) by time in microseconds, rising to an episode's start at 0.
pub(crate) type Track = Vec<(i64, Pose)>;

/// How an episode gets to its start: the start alone, or `warm_up_us` of the recorded drive before it.
/// Without a start, it is at the first drive's begin, or where that has driven for `warm_up_us`.
pub(crate) fn resolve_start(
    resident: &Resident,
    start: Option<&Start>,
    warm_up_us: i64,
) -> Result<Track, SessionError> {
    let logs = &resident.version.manifest.trajectories;
    let limits_us = 0..=limits::WARM_UP_US;
    if !limits_us.contains(&warm_up_us) {
        return Err(no_warm_up(format!("{warm_up_us} µs; {limits_us:?} µs are accepted")));
    }
    match start {
        Some(Start::Pose(pose)) if warm_up_us == 0 => Ok(vec![(0, *pose)]),
        Some(Start::Pose(_)) => {
            let must = format!("{warm_up_us} µs; only a start along a trajectory has a before");
            Err(no_warm_up(must))
        }
        Some(Start::Station { trajectory: name, station_m }) => {
            let log = logs.iter().find(|log| log.name == *name).ok_or_else(|| {
                let known = logs.iter().map(|log| log.name.clone()).collect();
                SessionError::UnknownTrajectory { name: name.clone(), known }
            })?;
            let length_m = log.length_m();
            if !(0.0..=length_m).contains(station_m) {
                let must = format!("{station_m} m; {name:?} is from 0 to {length_m} m long");
                return Err(SessionError::OutOfRange { field: "start.station_m", must });
            }
            if warm_up_us == 0 {
                return Ok(vec![(0, log.at_station(*station_m))]);
            }
            warm_up(log, Route::new(log)?.at(*station_m).time_us, warm_up_us)
        }
        None => match logs.first() {
            None if warm_up_us == 0 => Ok(vec![(0, Pose::IDENTITY)]),
            None => Err(no_warm_up(format!("{warm_up_us} µs; the twin has no trajectory"))),
            Some(log) if warm_up_us == 0 => Ok(vec![(0, log.at_station(0.0))]),
            Some(log) => {
                let first_us = log.keyframes.first().map_or(0, |first| first.time_us);
                warm_up(log, first_us.saturating_add(warm_up_us), warm_up_us)
            }
        },
    }
}

/// The last `warm_up_us` of a drive before one of its times, in microseconds.
fn warm_up(log: &Trajectory, now_us: i64, warm_up_us: i64) -> Result<Track, SessionError> {
    let route = Route::new(log)?;
    let from_us = now_us.saturating_sub(warm_up_us);
    let poses = route.pose_at(from_us).and_then(|from| Ok((from, route.pose_at(now_us)?)));
    let (from, now) = poses.map_err(|cause| no_warm_up(format!("{warm_up_us} µs; {cause}")))?;
    let between = log.keyframes.iter().filter(|key| (from_us + 1..now_us).contains(&key.time_us));
    let between = between.map(|key| (key.time_us - now_us, key.world_from_rig));
    Ok(std::iter::once((-warm_up_us, from)).chain(between).chain([(0, now)]).collect())
}

fn no_warm_up(must: String) -> SessionError {
    SessionError::OutOfRange { field: "warm_up_us", must }
}
