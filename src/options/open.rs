//! The request `open`, and the settings of a session.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::camera::{Exposure, Lens, Shutter, Windshield};
use crate::{DriveSection, Pose, RigLidar, Sensors};

/// How the ego moves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Dynamics {
    /// The motion model.
    pub model: DynamicsModel,
    /// Speed at the start of an episode, in m/s.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schemars(range(min = -10.0, max = 60.0)))]
    pub speed: f64,
    /// Whether a car that brakes beyond standstill drives backwards. If false, it stands still.
    #[serde(default)]
    pub reverse: bool,
}

/// Motion model of the ego.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Model"))]
pub enum DynamicsModel {
    /// Moves to the requested pose.
    #[default]
    Teleport,
    /// Rolls without slipping, and reaches the requested acceleration and curvature at once.
    Kinematic,
    /// Single-track model with linear tyres. Its steering and drive lag by 0.1 s.
    Dynamic,
}

impl From<DynamicsChoice> for Dynamics {
    /// A model alone starts at standstill.
    fn from(choice: DynamicsChoice) -> Self {
        match choice {
            DynamicsChoice::Full(dynamics) => dynamics,
            DynamicsChoice::Model(model) => Self { model, speed: 0.0, reverse: false },
        }
    }
}

impl DynamicsModel {
    /// The name on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Teleport => "teleport",
            Self::Kinematic => "kinematic",
            Self::Dynamic => "dynamic",
        }
    }
}

/// Opens a session on a twin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Open {
    /// Number of this request.
    pub seq: u64,
    /// Name of the twin.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::NAME_PATTERN)))]
    pub twin: String,
    /// Version of the twin. If absent, the latest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u64>,
    /// Name for the session. If absent, the server chooses one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::NAME_PATTERN)))]
    pub session: Option<String>,
    /// Seed of the first episode.
    #[serde(default)]
    pub seed: u64,
    /// Where to start. If absent, the start of the twin's first trajectory, or the origin if it has
    /// none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Start>,
    /// The cameras. If absent, the twin's rig, or the preset `vehicle6` if it has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<RigChoice>,
    /// Changes of the twin's render profile for this session, for example `{"tau_px": 2.0}`. Fields
    /// that are absent keep the server's setting, if it has one, or else the twin's.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub profile: serde_json::Map<String, serde_json::Value>,
    /// What each observation holds.
    #[serde(default)]
    pub outputs: Outputs,
    /// How the ego moves. If absent, by teleport.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<DynamicsChoice>,
    /// Simulated time of a step, in microseconds. If absent, the server's default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 10_000_000)))]
    pub dt_us: Option<i64>,
    /// How long an answer may take, in milliseconds. If absent, the server's limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1)))]
    pub deadline_ms: Option<u64>,
    /// Time between two decisions of the agent, in simulated microseconds: a whole number of steps.
    /// Only observations at decisions have images. If absent, every observation has images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 10_000_000)))]
    pub decision_us: Option<i64>,
    /// The repair of images by a model of the server. If absent, images are as rendered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair: Option<Repair>,
    /// Effects of the sensors, and the delay of the planner. If absent, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Sensors>,
    /// What contact with the twin does. If absent, the scenario decides. Without a scenario, a
    /// contact of a teleported ego is reported, and another one ends the episode.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub contact: Option<ContactMode>,
    /// The scenario to drive. If absent, there are no actors and no route.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenario: Option<ScenarioChoice>,
    /// Length of the recorded drive before the start, in microseconds. Its poses are the ego's
    /// history, and its frames are in the first bundle. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 20_000_000)))]
    pub warm_up_us: Option<i64>,
    /// A part of a recorded drive that the answer is to have.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trajectory: Option<DriveSection>,
    /// Whether episodes are recorded. If absent, true. An episode without a record cannot be
    /// replayed, scored, exported or continued.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<bool>,
    /// Which versions of the twin the session shows from its second observation on. If absent, its
    /// own until `switch_version`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub follow: Option<Follow>,
}

/// Which versions of its twin a session shows by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Follow {
    /// The latest, from the next `step` or `reset` after it became known. Only without `version`.
    Latest,
}

impl Open {
    /// Opens the latest version of a twin, with every default.
    ///
    /// ```
    /// use wildcity_options::{Encoding, Open, Outputs};
    ///
    /// let outputs = Outputs { encoding: Encoding::Png, depth: true, ..Outputs::default() };
    /// let open = Open { seed: 7, outputs, ..Open::twin("street") };
    /// let json = serde_json::to_value(open)?;
    /// assert_eq!(json["outputs"]["encoding"], "png");
    /// assert_eq!(json["twin"], "street");
    /// # Ok::<(), serde_json::Error>(())
    /// ```
    pub fn twin(name: impl Into<String>) -> Self {
        Self {
            seq: 0,
            twin: name.into(),
            version: None,
            session: None,
            seed: 0,
            start: None,
            rig: None,
            profile: serde_json::Map::new(),
            outputs: Outputs::default(),
            dynamics: None,
            dt_us: None,
            deadline_ms: None,
            decision_us: None,
            repair: None,
            sensors: None,
            contact: None,
            scenario: None,
            warm_up_us: None,
            trajectory: None,
            record: None,
            follow: None,
        }
    }
}

/// Which images are repaired, and by which model. In `opened` every field but those of the model is
/// there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Repair {
    /// Name of the model, one of `welcome.repairs`.
    pub model: String,
    /// A camera is repaired from trust below this on. If absent, 0.75.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub below: Option<f64>,
    /// A camera is no longer repaired from trust above this on. If absent, 0.85.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub above: Option<f64>,
    /// Under this trust nothing is repaired. If absent, 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub at_least: Option<f64>,
    /// Most images that are repaired of one pose of the rig: those with the least trust, then the
    /// first cameras. If absent, 16.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub per_step: Option<u64>,
    /// What happens when the model fails. If absent, `unrepaired`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_failure: Option<OnFailure>,
}

/// What happens to an image that a model failed to repair.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum OnFailure {
    /// It is delivered as rendered, with the status `failed`.
    #[default]
    Unrepaired,
    /// The request is refused with `repair_failed`, and nothing changed.
    Error,
}

/// What contact with the twin does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ContactMode {
    /// It is an event, and ends the episode. Only without a scenario.
    End,
    /// It is an event, and the episode goes on. Only without a scenario.
    Report,
    /// It is not looked for.
    Off,
}

/// Where an episode starts.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum Start {
    /// At a pose.
    Pose {
        /// `world_from_rig`.
        pose: Pose,
    },
    /// At a distance along a recorded trajectory.
    Station {
        /// Name of the trajectory.
        trajectory: String,
        /// Distance from the start of the trajectory, in metres.
        #[serde(default)]
        #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
        station_m: f64,
    },
    /// Somewhere along a recorded trajectory, drawn anew for each episode with its seed.
    Random {
        /// What is drawn.
        random: RandomStart,
    },
}

/// A start that is drawn with the episode's seed. Every draw is uniform.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RandomStart {
    /// Name of the trajectory. If absent, the twin's first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trajectory: Option<String>,
    /// Least distance from the start of the trajectory, in metres. If absent, 0, or where the
    /// warm-up ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub from_m: Option<f64>,
    /// Largest distance from the start of the trajectory. If absent, its length.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub to_m: Option<f64>,
    /// Largest distance to the left or right of the drive, in metres, 0 to 20.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 20.0)))]
    pub lateral_m: Option<f64>,
    /// Largest angle to the drive's heading, in radians, 0 to π.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = std::f64::consts::PI)))]
    pub heading_rad: Option<f64>,
}

/// The scenario of a session.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum ScenarioChoice {
    /// A scenario of the server, by name, with the first values of its sweep.
    Name(String),
    /// The scenario itself, in the format `wildcity.scenario/1`; or, without the field `format`,
    /// the `name` of one of the server's with `values` of its sweep.
    Object(serde_json::Map<String, serde_json::Value>),
}

/// The cameras of a session.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum RigChoice {
    /// A preset, by name.
    Preset(String),
    /// A rig with all its cameras.
    Full(Rig),
}

/// How the ego moves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum DynamicsChoice {
    /// A motion model that starts at standstill.
    Model(DynamicsModel),
    /// A motion model with all its settings.
    Full(Dynamics),
}

/// The cameras of a vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Name.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::NAME_PATTERN)))]
    pub name: String,
    /// The cameras, in the order of the images in observations.
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 16)))]
    pub cameras: Vec<RigCamera>,
    /// The LiDARs. Every observation of the ego has a sweep of each, which ends at its time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schemars(length(max = 4)))]
    pub lidars: Vec<RigLidar>,
}

/// A camera on the vehicle: a pinhole unless it has a lens. All intrinsics are in pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct RigCamera {
    /// Name.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = crate::NAME_PATTERN)))]
    pub name: String,
    /// Image width.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 16_384)))]
    pub width: u64,
    /// Image height.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 16_384)))]
    pub height: u64,
    /// Focal length along x. Answers always have it; requests may omit it for an f-theta lens.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 1e6)))]
    pub fx: Option<f64>,
    /// Focal length along y. Answers always have it; requests may omit it for an f-theta lens.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 1e6)))]
    pub fy: Option<f64>,
    /// Principal point, x, from the image's left edge.
    #[cfg_attr(feature = "schema", schemars(range(min = -1e6, max = 1e6)))]
    pub cx: f64,
    /// Principal point, y, from the image's top edge.
    #[cfg_attr(feature = "schema", schemars(range(min = -1e6, max = 1e6)))]
    pub cy: f64,
    /// The lens model. If absent, a pinhole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
    /// The windshield in front of the lens, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub windshield: Option<Windshield>,
    /// The rolling shutter. If absent, all rows are exposed at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shutter: Option<Shutter>,
    /// The colour correction. If absent, colours are not changed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure: Option<Exposure>,
    /// The part of its own car that the camera sees: a PNG with opacity, of the image's size, drawn
    /// over the image, as `data:image/png;base64,..`. Answers do not repeat it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overlay: Option<String>,
    /// Width and height of what the image shows, in pixels of the camera's native size. An image
    /// below its native size is the native image shrunk. If absent, the image has native size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub native_size: Option<[f64; 2]>,
    /// `rig_from_camera`: camera axes are x right, y down, z forward.
    pub camera_to_rig: Pose,
}

/// What each observation holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Outputs {
    /// Names of the cameras to render, in this order. If absent, all.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 16)))]
    #[cfg_attr(feature = "schema", schemars(transform = crate::unique_items))]
    pub cameras: Option<Vec<String>>,
    /// Crops and sizes of images that differ from the rig's, by camera name. The cameras of
    /// `opened` describe the images as sent.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub images: BTreeMap<String, ImagePart>,
    /// Encoding of colour images.
    pub encoding: Encoding,
    /// JPEG quality, 1 to 100. Other encodings ignore it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 100)))]
    pub quality: Option<u8>,
    /// Whether to add `depth`, f32 `[height, width]`: expected camera z, or distance for wide
    /// lenses, in metres.
    pub depth: bool,
    /// Whether to add `opacity`, f32 `[height, width]`: how valid depth and colour are.
    pub opacity: bool,
    /// Whether to add `normals`, f32 `[height, width, 3]`: unit vectors in the camera's axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normals: Option<bool>,
    /// Whether to add `instances`, u16 `[height, width]`: whose Gaussian each pixel shows. If
    /// absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instances: Option<bool>,
    /// Whether to add `semantics`, u8 `[height, width]`: the class of the Gaussian that each pixel
    /// shows. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub semantics: Option<bool>,
    /// Number of last frames of each camera that an observation holds. If absent, 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 16)))]
    pub frames: Option<u64>,
    /// Whether to add a confidence to each image. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trust: Option<bool>,
    /// Whether to tell where the actors of the scenario are. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub actors: Option<bool>,
    /// Time between two frames, by camera name, in simulated microseconds: a whole number of steps.
    /// If absent, every camera takes a frame with every step.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(transform = crate::periods))]
    pub period_us: Option<BTreeMap<String, i64>>,
}

impl Outputs {
    /// Colour of all cameras at every step.
    pub fn colour(encoding: Encoding) -> Self {
        Self {
            cameras: None,
            images: BTreeMap::new(),
            encoding,
            quality: None,
            depth: false,
            opacity: false,
            normals: None,
            instances: None,
            semantics: None,
            frames: None,
            trust: None,
            actors: None,
            period_us: None,
        }
    }
}

impl Default for Outputs {
    fn default() -> Self {
        Self::colour(Encoding::Jpeg)
    }
}

/// Crop and size of a camera's image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct ImagePart {
    /// Left column, top row, width and height of the crop, in pixels of the rig's image. If absent,
    /// the whole image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<[u64; 4]>,
    /// Width and height at which the crop is rendered, in pixels. If absent, those of the crop.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(inner(range(min = 1, max = 16_384))))]
    pub size: Option<[u64; 2]>,
}

/// Encoding of colour images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// A JPEG file, u8 `[n]`.
    Jpeg,
    /// A PNG file, u8 `[n]`.
    Png,
    /// Pixels, u8 `[height, width, 3]`.
    Raw,
}
