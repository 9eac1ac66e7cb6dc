//! What can go wrong with a session.

use wildcity_render::RenderError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::route::RouteError;
use wildcity_scene::sky::SkyError;
use wildcity_sim::EgoError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use crate::record::format::RecordError;

/// Why a request was refused. The session is then as it was before.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The twin cannot be had.
    #[error(transparent)]
    Twin(#[from] StoreError),
    /// What is to be drawn does not fit into memory, or could not be loaded.
    #[error(transparent)]
    Residency(ResidencyError),
    /// There is no rig preset of this name.
    #[error("there is no rig preset {name:?}; there is {}", known.join(", "))]
    UnknownRig {
        /// The name asked for.
        name: String,
        /// The presets there are.
        known: Vec<&'static str>,
    },
    /// The rig has no camera of this name.
    #[error("the rig has no camera {name:?}; it has {}", known.join(", "))]
    UnknownCamera {
        /// Where it was asked for, as it is called on the wire.
        field: String,
        /// The name asked for.
        name: String,
        /// The cameras there are.
        known: Vec<String>,
    },
    /// A recorded drive of the twin cannot be driven along.
    #[error(transparent)]
    Route(#[from] RouteError),
    /// A camera was asked for twice.
    #[error("camera {name:?} is asked for twice; name each camera once")]
    CameraTwice {
        /// Which name of `outputs.cameras`.
        index: usize,
        /// The name.
        name: String,
    },
    /// The twin has no trajectory of this name.
    #[error("the twin has no trajectory {name:?}; it has {}", listed(known))]
    UnknownTrajectory {
        /// The name asked for.
        name: String,
        /// The trajectories there are.
        known: Vec<String>,
    },
    /// A number or count is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        /// The field, as it is called on the wire.
        field: &'static str,
        /// What it is, and what is accepted.
        must: String,
    },
    /// The profile that is asked for cannot be had.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// The twin's sky is too sharp for the profile's `sky_error`.
    #[error("profile: {0}")]
    Sky(SkyError),
    /// The images of one answer have too many pixels.
    #[error("the answer has {pixels} pixels; at most {limit} fit: ask for fewer or smaller images")]
    AnswerTooLarge {
        /// All images together.
        pixels: u64,
        /// What fits.
        limit: u64,
    },
    /// The ego does not do as it is told.
    #[error(transparent)]
    Ego(#[from] EgoError),
    /// The episode was ended by its agent.
    #[error("the episode ended with step {steps}; send reset")]
    EpisodeOver {
        /// Steps done.
        steps: u64,
    },
    /// Too much waits for the renderer, or too many answers are kept.
    #[error("the server is busy: {what}; try again later")]
    Busy {
        /// What there is too much of.
        what: &'static str,
    },
    /// The deadline passed while the frame was queued or drawn.
    #[error("the frame was not ready within the deadline; nothing changed")]
    DeadlineExceeded,
    /// The backend refused the frame.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An image could not be encoded.
    #[error("camera {camera:?} was not encoded: {reason}")]
    Encode {
        /// The camera.
        camera: String,
        /// What the encoder says.
        reason: String,
    },
    /// The episode's file could not be written. The step was not taken: what is answered is on
    /// record.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A defect of the program.
    #[error("the renderer crashed; the server's log says where")]
    Crashed,
    /// The render thread could not be started.
    #[error("cannot start the render thread: {reason}")]
    Thread {
        /// What the operating system says.
        reason: String,
    },
}

impl From<ResidencyError> for SessionError {
    fn from(error: ResidencyError) -> Self {
        match error {
            ResidencyError::Store(error) => Self::Twin(error),
            other => Self::Residency(other),
        }
    }
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}
