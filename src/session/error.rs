//! Errors of sessions.

use wildcity_options::Start;
use wildcity_render::RenderError;
use wildcity_repair::RepairError;
use wildcity_scene::geometry::PoseError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::{RigError, RigFieldError};
use wildcity_scene::route::RouteError;
use wildcity_scene::sky::SkyError;
use wildcity_sim::EgoError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use crate::record::error::RecordError;
use crate::scenario::load::ScenarioError;

/// Why a request was refused. The session is then as it was before the request.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The twin does not exist or cannot be read.
    #[error(transparent)]
    Twin(#[from] StoreError),
    /// The data of a frame does not fit into memory, or could not be loaded.
    #[error(transparent)]
    Residency(ResidencyError),
    /// The scenario does not exist, is malformed, or does not fit the twin.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// There is no rig preset of this name.
    #[error("there is no rig preset {name:?}; there is {}", known.join(", "))]
    UnknownRig {
        name: String,
        /// The names of the presets.
        known: Vec<&'static str>,
    },
    /// The rig of the request is invalid.
    #[error("{}", rig_message(.0))]
    Rig(RigFieldError),
    /// The numbers of a pose are invalid.
    #[error("{field}: {cause}")]
    Pose {
        /// The pose, as `start.pose`.
        field: String,
        cause: PoseError,
    },
    /// A text is not a name.
    #[error(
        "{name:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    Name {
        /// The field of the request, as on the wire.
        field: &'static str,
        name: String,
    },
    /// The rig has no camera of this name.
    #[error("the rig has no camera {name:?}; it has {}", known.join(", "))]
    UnknownCamera {
        /// The field of the request that names it, as on the wire.
        field: String,
        name: String,
        /// The names of the rig's cameras.
        known: Vec<String>,
    },
    /// The server has no repair model of this name.
    #[error("there is no repair model {name:?}; there is {}", joined_or_none(known))]
    UnknownRepair {
        name: String,
        /// The names of the models.
        known: Vec<String>,
    },
    /// The repair model cannot be loaded, or not be used for these images.
    #[error("the repair model {name:?} cannot be used: {reason}")]
    RepairUnavailable { name: String, reason: String },
    /// The repair model failed, and the session had asked for an error in this case.
    #[error("the image of camera {camera:?} was not repaired: {cause}; nothing changed")]
    Repair {
        /// Name of the camera.
        camera: String,
        cause: Box<RepairError>,
    },
    /// A recorded drive of the twin cannot be used as a route.
    #[error(transparent)]
    Route(#[from] RouteError),
    /// The session has no snapshot of this name.
    #[error("there is no snapshot {name:?}; there is {}", joined_or_none(known))]
    UnknownSnapshot {
        /// The field of the request that names it, as on the wire.
        field: &'static str,
        name: String,
        /// The names of the session's snapshots.
        known: Vec<String>,
    },
    /// There is no recorded episode of this name.
    #[error(
        "there is no recorded episode {name:?}; an episode is named SESSION-NUMBER, as its file"
    )]
    UnknownEpisode { name: String },
    /// A recorded episode cannot be continued.
    #[error("the recorded episode cannot be continued: {reason}")]
    Branch { reason: String },
    /// A camera was requested twice.
    #[error("camera {name:?} is requested twice; name each camera once")]
    CameraTwice {
        /// Index of the second request in `outputs.cameras`.
        index: usize,
        name: String,
    },
    /// An option of one camera is outside its limits.
    #[error("{field} is {must}")]
    CameraOption {
        /// The field of the request, as on the wire: it names the camera.
        field: String,
        /// The value, and what is accepted.
        must: String,
    },
    /// The twin has no trajectory of this name.
    #[error("the twin has no trajectory {name:?}; it has {}", joined_or_none(known))]
    UnknownTrajectory {
        /// The field of the request that names it, as on the wire.
        field: &'static str,
        name: String,
        /// The names of the twin's trajectories.
        known: Vec<String>,
    },
    /// A number or count is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        /// The field of the request, as on the wire.
        field: &'static str,
        /// The value, and what is accepted.
        must: String,
    },
    /// The requested profile is invalid.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The profile's `sky_error` is below what the twin's sky can be baked to.
    #[error("profile: {0}")]
    Sky(SkyError),
    /// The images of one answer have too many pixels.
    #[error("the answer has {pixels} pixels; at most {limit} fit: request fewer or smaller images")]
    AnswerTooLarge {
        /// The field of the request that asks for them, as on the wire.
        field: &'static str,
        /// Pixels of all images together.
        pixels: u64,
        /// The most that fit.
        limit: u64,
    },
    /// The ego cannot execute the command.
    #[error(transparent)]
    Ego(#[from] EgoError),
    /// The agent has ended the episode.
    #[error("the episode ended with step {steps}; send reset")]
    EpisodeOver {
        /// Steps of the episode.
        steps: u64,
    },
    /// The render queue is full, or the budget for answers is used up.
    #[error("the server is busy: {what}; try again later")]
    Busy {
        /// The resource that is used up.
        what: &'static str,
    },
    /// The deadline passed while the frame was queued or rendered.
    #[error("the frame was not ready within the deadline; nothing changed")]
    DeadlineExceeded,
    /// The backend refused the frame.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An image could not be encoded.
    #[error("the image of camera {camera:?} could not be encoded: {reason}")]
    Encode {
        /// Name of the camera.
        camera: String,
        reason: String,
    },
    /// The episode's file could not be written, so that the request had no effect: every answer is
    /// on record.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A bug of the program: a worker thread panicked.
    #[error("a worker thread of the server crashed; see the server's log")]
    Crashed,
    /// A thread could not be started.
    #[error("cannot start a thread: {reason}")]
    Thread {
        /// The operating system's message.
        reason: String,
    },
}

impl From<RigFieldError> for SessionError {
    fn from(cause: RigFieldError) -> Self {
        Self::Rig(cause)
    }
}

impl SessionError {
    /// The error of a `reset`, which has no `warm_up_us`: a start that is too early for the
    /// session's warm-up is the fault of the start.
    pub(crate) fn into_reset_error(self, start: Option<&Start>) -> Self {
        match (self, start) {
            // `warm_up_us` belongs to `open`. What a reset can change is its start.
            (Self::OutOfRange { field: "warm_up_us", must }, Some(start)) => {
                let field = match start {
                    Start::Pose { .. } => "start.pose",
                    Start::Station { .. } => "start.station_m",
                    Start::Random { .. } => "start.random.from_m",
                };
                let must = format!("too early for the session's warm_up_us, which is {must}");
                Self::OutOfRange { field, must }
            }
            (error, _) => error,
        }
    }
}

impl From<ResidencyError> for SessionError {
    fn from(error: ResidencyError) -> Self {
        match error {
            // Errors of the store have one variant, wherever they come from.
            ResidencyError::Store(error) => Self::Twin(error),
            other => Self::Residency(other),
        }
    }
}

/// The part of the request, for errors that do not name it.
fn rig_message(RigFieldError { part, cause }: &RigFieldError) -> String {
    match cause {
        RigError::Camera { cause, .. } => format!("rig.{part}: {cause}"),
        RigError::Pose { cause, .. } => format!("rig.{part}: {cause}"),
        RigError::Appearance { cause, .. } => format!("rig.{part}: {cause}"),
        cause => cause.to_string(),
    }
}

fn joined_or_none(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}
