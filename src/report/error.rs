//! Why a report cannot be made.
//!
//! The `Display` text of an error is complete, down to the text of the operating system, and so
//! errors of this project have no `source`: the cause is a field named `cause`, or the error passes
//! it on as `transparent`. A caller that prints an error, with `{:#}` or `to_string`, then prints
//! each cause once.

use wildcity_render::RenderError;
use wildcity_render::gradient::GradientError;
use wildcity_repair::RepairError;
use wildcity_scene::geometry::CameraError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::RigError;
use wildcity_session::SessionError;
use wildcity_twin::residency::ResidencyError;

/// Why a report cannot be made, or a setting cannot be recommended.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The twin cannot be read.
    #[error(transparent)]
    Residency(#[from] ResidencyError),
    /// A frame cannot be rendered.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Gradients cannot be computed.
    #[error(transparent)]
    Gradient(#[from] GradientError),
    /// A camera cannot be scaled to such a small image.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A setting does not fit the twin's profile.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// An image cannot be encoded, or its file cannot be decoded.
    #[error("an image cannot be encoded: {reason}")]
    Encode { reason: String },
    /// A plot cannot be drawn.
    #[error("a plot cannot be drawn: {reason}")]
    Plot { reason: String },
    /// A model cannot be used, or recorded images cannot be read.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The cameras cannot be scaled.
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error("the repair model {model:?} failed on an image of the camera {camera:?}: {cause}")]
    Repair {
        /// Name of the model.
        model: String,
        /// Name of the camera.
        camera: String,
        /// The error of the model.
        cause: Box<RepairError>,
    },
    /// Repair is measured at offsets from a drive, and the twin has none.
    #[error(
        "--repair: the twin has no recorded drive, so there is nothing beside it; leave --repair out"
    )]
    NoDrive,
    /// There are no sample points.
    #[error("there are no sample points to measure at: give at least 2 --stations")]
    NoSamplePoints,
    /// No setting reaches the goal.
    #[error("no setting reaches {goal} with its safety margin; the best reaches {reached:.1}")]
    GoalNotReached {
        /// The goal, in words.
        goal: String,
        /// The best value that is guaranteed, in the goal's unit.
        reached: f64,
    },
    /// The chosen setting misses the goal at the verification points.
    #[error(
        "{setting} was chosen for {goal}, but reaches only {verified:.1} at the sample points that were \
         kept for verification: measure more --stations"
    )]
    NotVerified {
        /// Name of the setting.
        setting: String,
        /// The goal, in words.
        goal: String,
        /// The worst value at the verification points, in the goal's unit.
        verified: f64,
    },
}
