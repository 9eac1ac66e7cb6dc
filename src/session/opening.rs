//! What opens a session, resolved against the twin.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::config;
use crate::geometry::Pose;
use crate::residency::Resident;
use crate::scene::rig::{Rig, RigCamera};
use crate::sim::Dynamics;

use super::{Encoding, SessionError};

/// What opens a session. What is `None` is chosen by the twin or by `config`.
#[derive(Clone, Debug, PartialEq)]
pub struct Opening {
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
    /// What each observation holds.
    pub outputs: Outputs,
    /// How the ego moves.
    pub dynamics: Dynamics,
    /// Simulated time of a step, in microseconds.
    pub dt_us: Option<i64>,
    /// How long one answer may take.
    pub deadline: Option<Duration>,
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
    /// Whether to add depth.
    pub depth: bool,
    /// Whether to add opacity.
    pub opacity: bool,
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
pub(super) fn choose_cameras(
    resident: &Resident,
    choice: Option<RigChoice>,
    outputs: &Outputs,
) -> Result<(String, Vec<RigCamera>), SessionError> {
    let (rig, mut cameras) = whole_cameras(resident, choice, outputs)?;
    for (name, ImagePart { crop, size }) in &outputs.images {
        let refused = |why: String| {
            let must = format!("camera {name:?}: {why}");
            SessionError::OutOfRange { field: "outputs.images", must }
        };
        let drawn = cameras.iter_mut().find(|camera| camera.name == *name);
        let camera = &mut drawn.ok_or_else(|| refused("it is not drawn".into()))?.camera;
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
            None => preset(config::RIG)?,
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
            SessionError::UnknownCamera { index, name: name.clone(), known }
        })?;
        if chosen.contains(camera) {
            return Err(SessionError::CameraTwice { index, name: name.clone() });
        }
        chosen.push(camera.clone());
    }
    Ok((rig.name, chosen))
}

/// A start as a pose, `world_from_rig`.
pub(super) fn resolve_start(resident: &Resident, start: &Start) -> Result<Pose, SessionError> {
    let (name, station_m) = match start {
        Start::Pose(pose) => return Ok(*pose),
        Start::Station { trajectory, station_m } => (trajectory, *station_m),
    };
    let logs = &resident.version.manifest.trajectories;
    let log = logs.iter().find(|log| log.name == *name).ok_or_else(|| {
        let known = logs.iter().map(|log| log.name.clone()).collect();
        SessionError::UnknownTrajectory { name: name.clone(), known }
    })?;
    let length_m = log.length_m();
    if !(0.0..=length_m).contains(&station_m) {
        let must = format!("{station_m} m; {name:?} is from 0 to {length_m} m long");
        return Err(SessionError::OutOfRange { field: "start.station_m", must });
    }
    Ok(log.at_station(station_m))
}
