//! Options of a session that a client requests at `open`.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use wildcity_scene::ProfileOverrides;
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_sim::{Dynamics, EgoModel};

use crate::observe::encode::Encoding;
use crate::scenario::load::ScenarioSource;
use crate::sensors::settings::Sensors;

/// How to open a session. For a field that is `None`, the twin or this package's `limits` decide.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionOptions {
    /// Name of the twin.
    pub twin: String,
    /// Its version; the latest if absent.
    pub version: Option<u64>,
    /// Seed of the first episode.
    pub seed: u64,
    /// Where to start; if absent, at the start of the twin's first trajectory, or at the world's
    /// origin.
    pub start: Option<Start>,
    /// Cameras; if absent, the twin's rig, or the preset `vehicle6`.
    pub rig: Option<RigChoice>,
    /// Fields of the twin's render profile to override.
    pub profile: ProfileOverrides,
    /// Contents of each observation.
    pub outputs: Outputs,
    /// How the ego moves.
    pub dynamics: Dynamics,
    /// Simulated time of a step, in microseconds.
    pub dt_us: Option<i64>,
    /// Time between two decisions of the agent, in microseconds; one step if absent. Only
    /// observations at decisions have images.
    pub decision_us: Option<i64>,
    /// Length of the warm-up in microseconds. The warm-up is the part of the recorded drive before
    /// the start; the first observations hold its poses and frames.
    pub warm_up_us: i64,
    /// Largest time for one answer.
    pub deadline: Option<Duration>,
    /// The scenario that is driven; without one there are no actors.
    pub scenario: Option<ScenarioOptions>,
    /// The repair of its images; none if absent.
    pub repair: Option<RepairOptions>,
    /// Effects of its sensors; none if absent.
    pub sensors: Option<Sensors>,
    /// What contact with the twin does. If absent, the scenario decides; without a scenario, a
    /// contact of a teleported ego is reported, and another one ends the episode.
    pub contact: Option<ContactMode>,
}

/// A scenario, and which values of its ego section apply.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioOptions {
    pub source: ScenarioSource,
    /// Values of its sweep; the first ones where absent.
    pub values: BTreeMap<String, serde_json::Value>,
    /// Whether the scenario's dynamics apply, because the request gives none.
    pub dynamics: bool,
    /// Whether the scenario's warm-up applies, because the request gives none.
    pub warm_up: bool,
    /// Whether observations contain the poses of the actors.
    pub actors: bool,
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
            scenario: None,
            repair: None,
            sensors: None,
            contact: None,
        }
    }
}

/// Which images are repaired, and by which model. A field that is `None` has the default of
/// [`Selection`](wildcity_repair::Selection).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RepairOptions {
    /// Name of the model.
    pub model: String,
    /// A camera is repaired once its trust is below this.
    pub below: Option<f64>,
    /// A camera is no longer repaired once its trust is above this.
    pub above: Option<f64>,
    /// Images whose trust is below this are not repaired.
    pub at_least: Option<f64>,
    /// Largest number of repaired images of one pose of the rig.
    pub per_step: Option<u64>,
    /// Behaviour when the model fails.
    pub on_failure: OnFailure,
}

/// Behaviour when an image could not be repaired.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnFailure {
    /// The image is delivered as rendered, and marked so.
    #[default]
    Unrepaired,
    /// The request is refused with [`SessionError::Repair`](crate::SessionError::Repair); nothing
    /// changed.
    Error,
}

/// Whether a session looks for contact with the twin, and what it does at a contact. With a
/// scenario, `Off` switches it off, and the scenario says what a contact does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ContactMode {
    /// A contact is an event, and ends the episode as a driving failure.
    End,
    /// A contact is an event, and the episode goes on.
    Report,
    /// Contact with the twin is not looked for.
    Off,
}

impl ContactMode {
    /// The mode of an episode unless the session names one. A teleported ego is not stopped by what
    /// it meets: it is often put into places where no car drives.
    pub(crate) fn default_for(model: EgoModel) -> Self {
        if model == EgoModel::Teleport { Self::Report } else { Self::End }
    }
}

/// Options of a step in addition to its command.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepOptions {
    /// Duration for which the command is followed, in microseconds: a whole number of steps; one
    /// step if absent.
    pub until_us: Option<i64>,
    /// Whether the episode ends with it.
    pub terminate: bool,
    /// Notes of the agent, for the record.
    pub notes: Option<serde_json::Value>,
}

/// Where an episode starts.
#[derive(Clone, Debug, PartialEq)]
pub enum Start {
    /// At a pose, `world_from_rig`.
    Pose(Pose),
    /// Along a recorded trajectory.
    Station {
        /// Name of the trajectory.
        trajectory: String,
        /// Distance along it in metres, from 0 to its length.
        station_m: f64,
    },
    /// A random pose along a recorded trajectory, sampled with the episode's seed.
    Random(RandomStart),
}

/// A start that is sampled anew for each episode, from uniform distributions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RandomStart {
    /// Name of the trajectory; the first one if absent.
    pub trajectory: Option<String>,
    /// Lowest station, in metres; if absent, 0 or the end of the warm-up.
    pub from_m: Option<f64>,
    /// Where the stations end, in metres; at the trajectory's end if absent.
    pub to_m: Option<f64>,
    /// Largest distance to the left or right of the drive, in metres.
    pub lateral_m: f64,
    /// Largest angle to the drive's heading, in radians.
    pub heading_rad: f64,
}

/// Changes by `reset` for its episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResetOptions {
    /// Seed of the episode.
    pub seed: u64,
    /// Where it starts; the session's start if absent.
    pub start: Option<Start>,
    /// How the ego moves; the session's dynamics if absent.
    pub dynamics: Option<Dynamics>,
    /// Speed at the start, in m/s, in place of that of the dynamics.
    pub speed_m_s: Option<f64>,
}

/// Which rig.
#[derive(Clone, Debug, PartialEq)]
pub enum RigChoice {
    /// A rig that comes with the program, by name.
    Preset(String),
    /// A rig of the client's own. The caller has checked it with [`Rig::check`].
    Full(Rig),
}

/// Contents of each observation.
#[derive(Clone, Debug, PartialEq)]
pub struct Outputs {
    /// Names of the cameras in the order of the images; all cameras of the rig if absent.
    pub cameras: Option<Vec<String>>,
    /// Crops and sizes of images, by camera.
    pub images: BTreeMap<String, ImagePart>,
    /// How colour images are encoded.
    pub encoding: Encoding,
    /// Which maps come with every image.
    pub maps: PixelMaps,
    /// How many last frames of each camera; 1 if absent.
    pub frames: Option<u64>,
    /// Whether images come with their trust.
    pub trust: bool,
    /// Time between two frames in microseconds, by camera. Other cameras take a frame at every
    /// step.
    pub periods_us: BTreeMap<String, i64>,
}

impl Outputs {
    /// Colour of all cameras at every step.
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

/// Per-pixel maps of an image in addition to its colour; all but `instances` are f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelMaps {
    /// Expected depth in metres, `[height, width]`.
    pub depth: bool,
    /// Accumulated opacity, `[height, width]`.
    pub opacity: bool,
    /// Unit normals in the camera's axes, `[height, width, 3]`.
    pub normals: bool,
    /// Whose Gaussian each pixel shows, u16 `[height, width]`: 0 none, 1 the twin, and actor k is k
    /// + 2.
    pub instances: bool,
}

impl PixelMaps {
    /// f32 values per pixel, all f32 maps together.
    pub(crate) fn values(self) -> usize {
        usize::from(self.depth) + usize::from(self.opacity) + 3 * usize::from(self.normals)
    }
}

/// Which part of a camera's image is rendered, and at which size. The crop comes first.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImagePart {
    /// First column, first row, width and height, in pixels of the rig's camera.
    pub crop: Option<[u64; 4]>,
    /// Width and height of the rendered image, in pixels.
    pub size: Option<[u64; 2]>,
}
