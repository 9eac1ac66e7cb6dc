//! The format of an episode's file: one JSON object per line.
//!
//! ```text
//! <episodes>/<session>-<n>.jsonl
//! {"kind":"episode", ...}  what the images depend on in addition to the poses
//! {"kind":"frame", ...}    one per answer with images: request, poses, hashes
//! {"kind":"version", ...}  the following frames are rendered from another version of the twin
//! {"kind":"end", ...}      how the episode went; missing if the server was killed
//! ```
//!
//! A scenario adds the lines of [`wildcity_episode`]: `scenario`, `actors`, `event` and `result`.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use wildcity_episode::{ActorsLine, EpisodeResult, EventLine, ScenarioLine};
use wildcity_options::{ContactMode, Sensors, strict};
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::is_name;
use wildcity_scene::{ProfileOverrides, RenderProfile, Rig};
use wildcity_sim::{Dynamics, Ego};

use crate::episode::{Episode, EpisodeSummary};
use crate::observe::encode::ImageEncoding;
use crate::observe::schedule::Schedule;
use crate::record::command::RecordedCommand;
use crate::record::repairs::{RecordedImageRepair, RecordedRepair};

/// This build, as it is named in records.
pub(crate) const BUILD: &str = concat!("wildcity ", env!("CARGO_PKG_VERSION"));

/// The first line: everything that the images depend on, except for the poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeHeader {
    /// Version of this format.
    pub format: u32,
    /// The build that recorded it, as `wildcity 0.1.0`.
    pub build: String,
    /// Name of the session.
    pub session: String,
    /// Name of the token that the session belongs to; empty on a server without tokens.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub owner: String,
    /// Name of the twin.
    pub twin: String,
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    pub profile: RenderProfile,
    /// BLAKE3 of the profile's JSON, in hex.
    pub profile_hash: String,
    /// Name of the backend.
    pub backend: String,
    /// Property of the backend on which pixels depend in addition to its name: its instruction set.
    #[serde(default)]
    pub backend_detail: String,
    /// The cameras that were rendered, in the order of the images.
    pub rig: Rig,
    /// Maps of the observations, and the encoding of colour.
    pub outputs: RecordedOutputs,
    /// Seed of the episode.
    pub seed: u64,
    /// How the ego moved.
    #[serde(default)]
    pub dynamics: Dynamics,
    /// `world_from_rig` at time zero.
    pub start: Pose,
    /// Simulated time of a step, in microseconds.
    pub dt_us: i64,
    /// The session's other settings; absent if all are the defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings: Option<RecordedSettings>,
    /// The state at the beginning of the file, if that is more than a start: after a warm-up, or of
    /// a branch.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<Episode>,
    /// The recorded episode that this one is a branch of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<RecordedOrigin>,
    /// BLAKE3 of the resolved scenario, in hex; absent without a scenario.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenario: Option<String>,
    /// The repair of the images; absent if the session did not ask for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair: Option<RecordedRepair>,
}

/// Settings of a session that images do not depend on, but bundles, later versions and later
/// episodes do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedSettings {
    /// Fields that override the profile of each version.
    pub profile_overrides: ProfileOverrides,
    /// When the cameras take frames, and when the agent decides.
    pub(crate) schedule: Schedule,
    /// Whether images had a trust.
    pub trust: bool,
    /// Length of the warm-up, in microseconds.
    pub warm_up_us: i64,
    /// Effects of the sensors; absent without.
    #[serde(
        default,
        deserialize_with = "strict::deserialize",
        skip_serializing_if = "Option::is_none"
    )]
    pub sensors: Option<Sensors>,
    /// What contact with the twin does; absent if the session left it to the dynamics.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub contact: Option<ContactMode>,
}

/// Where a branch begins.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedOrigin {
    /// Name of the episode's file, without its ending.
    pub episode: String,
    pub step: u64,
}

/// Maps of the observations, and the encoding of colour.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedOutputs {
    /// How colour was encoded.
    pub encoding: ImageEncoding,
    /// Whether observations had depth.
    pub depth: bool,
    /// Whether observations had opacity.
    pub opacity: bool,
    /// Whether observations had normals.
    #[serde(default)]
    pub normals: bool,
    /// Whether observations had instances; absent if not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub instances: bool,
    /// Whether observations had classes; absent if not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub semantics: bool,
}

/// One answer with images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameRecord {
    /// Which request was answered.
    pub request: FrameRequest,
    /// Steps done, this one included.
    pub step: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// The rendered poses, `world_from_rig`. The last one of a reset or a step is the ego's.
    pub poses: Vec<Pose>,
    /// The rendered cameras of each pose, by their index; absent if all cameras were rendered.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<Vec<usize>>,
    /// The command that moved the ego, unless it was the pose itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<RecordedCommand>,
    /// Steps that the command moved the ego by, for which it was a plan.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub steps: u64,
    /// When the frames at the poses were taken, in microseconds; only for a plan. Otherwise the
    /// last one is at `time_us`, and the earlier ones are in the warm-up.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub times_us: Vec<i64>,
    /// When the frames at the poses were due, in microseconds; only if a camera delivered a frame
    /// that was not due. `times_us` says when their pictures were taken.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub due_us: Vec<i64>,
    /// Notes of the agent, unchanged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub notes: Option<Value>,
    /// Whether the agent ended the episode with this step.
    pub terminated: bool,
    /// BLAKE3 of the hashes of the shown images and then of the sweeps, in hex.
    pub frame_hash: String,
    /// BLAKE3 of each image's pixels as sent, in hex: pose by pose, camera by camera.
    pub images: Vec<String>,
    /// BLAKE3 of each sweep's points as sent, in hex, in the order of the rig. Absent for a rig
    /// without LiDAR.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sweeps: Vec<String>,
    /// Results of the repair model, in the order of `images`; absent if it was used on none of
    /// them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub repairs: Vec<Option<RecordedImageRepair>>,
}

/// Another version of the twin, for the frames that follow.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedVersion {
    /// Steps done before the switch.
    pub step: u64,
    pub version: u64,
    /// BLAKE3 of its manifest, in hex.
    pub version_hash: String,
    pub profile: RenderProfile,
    /// BLAKE3 of the profile's JSON, in hex.
    pub profile_hash: String,
}

/// Requests that are answered with images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameRequest {
    /// The start of an episode.
    Reset,
    Step,
    /// A snapshot was restored.
    Restore,
    /// Poses to render from without moving the ego.
    Observe,
}

/// A line of an episode's file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub(crate) enum Line {
    Episode(Box<EpisodeHeader>),
    /// One per answer with images.
    Frame(FrameRecord),
    Version(RecordedVersion),
    Scenario(Box<ScenarioLine>),
    /// Before the frame of a step.
    Actors(ActorsLine),
    /// An event of a step.
    Event(EventLine),
    /// Verdict and scores, before the end.
    Result(EpisodeResult),
    End(EpisodeSummary),
}

impl RecordedSettings {
    /// The settings of a session that requests none.
    pub(crate) fn with_defaults(cameras: usize, dt_us: i64) -> Self {
        Self {
            profile_overrides: ProfileOverrides::default(),
            schedule: Schedule::every_step(cameras, dt_us),
            trust: false,
            warm_up_us: 0,
            sensors: None,
            contact: None,
        }
    }
}

impl EpisodeHeader {
    /// The version of the format that this build writes and reads.
    pub const FORMAT: u32 = 0;

    /// The state at the beginning of the file.
    pub(crate) fn first_state(&self) -> Episode {
        match &self.state {
            Some(state) => state.clone(),
            None => Episode::new(self.seed, Ego::new(self.dynamics, self.start), self.dt_us),
        }
    }
}

fn one() -> u64 {
    1
}

fn is_one(steps: &u64) -> bool {
    *steps == 1
}

impl FrameRecord {
    /// When the frames at a pose were taken, in microseconds; those of a warm-up are at any time
    /// below 0.
    pub fn taken_us(&self, pose: usize) -> i64 {
        // All poses of `observe` are of one time. Of other requests only the last pose is of now.
        let is_now = self.request == FrameRequest::Observe || pose + 1 == self.poses.len();
        // All times of the warm-up are below 0, and which one it is does not matter.
        let otherwise = if is_now { self.time_us } else { -1 };
        self.times_us.get(pose).copied().unwrap_or(otherwise)
    }

    /// When the frames at a pose were due, in microseconds.
    pub(crate) fn due_us(&self, pose: usize) -> i64 {
        // Without a delay in a sensor, a frame is taken when it is due.
        self.due_us.get(pose).copied().unwrap_or_else(|| self.taken_us(pose))
    }

    /// The rendered cameras of a pose, by their index, of a rig with `rig_cameras`.
    pub fn due_cameras(&self, pose: usize, rig_cameras: usize) -> Vec<usize> {
        self.cameras.get(pose).cloned().unwrap_or_else(|| (0..rig_cameras).collect())
    }
}

/// Whether a text names an episode: the name of a session, a hyphen and a number. Such a name is
/// safe as a file name and cannot be a path.
pub fn is_episode_name(text: &str) -> bool {
    let is_number =
        // A u64 has at most 20 digits.
        |text: &str| (1..=20).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    text.rsplit_once('-').is_some_and(|(session, number)| is_name(session) && is_number(number))
}

/// BLAKE3 of a profile's JSON.
pub(crate) fn profile_hash(profile: &RenderProfile) -> blake3::Hash {
    // Serializing numbers into memory cannot fail. If it did, only the hash would differ.
    blake3::hash(&serde_json::to_vec(profile).unwrap_or_default())
}
