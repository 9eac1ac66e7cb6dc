//! The gRPC status of each error.
//!
//! AlpaSim's runtime retries `UNAVAILABLE`, and `DEADLINE_EXCEEDED` with the text "Stopped waiting for backend".

use tonic::Status;

use wildcity_session::SessionError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use crate::camera::CameraSpecError;
use crate::scene::SceneError;

/// Why a request was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum SensorsimError {
    /// There is no such scene.
    #[error("{0}")]
    UnknownScene(String),
    /// The request is invalid.
    #[error("{0}")]
    Invalid(String),
    /// A camera, a pose or a size is invalid.
    #[error(transparent)]
    Camera(#[from] CameraSpecError),
    /// The session layer refused.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The service stops.
    #[error("the server is shutting down")]
    Stopping,
    /// Not offered.
    #[error("{0}")]
    Unimplemented(&'static str),
    /// What another request of the same scene was refused with.
    #[error("{}", .0.message())]
    Repeated(Status),
}

impl From<SceneError> for SensorsimError {
    fn from(error: SceneError) -> Self {
        match error {
            SceneError::Id { .. } | SceneError::Trajectory { .. } | SceneError::Start { .. } => {
                Self::UnknownScene(error.to_string())
            }
            SceneError::Pose { .. } | SceneError::Missing { .. } => Self::Camera(error.into()),
        }
    }
}

impl SensorsimError {
    /// What the client gets.
    pub(super) fn status(&self) -> Status {
        let text = self.to_string();
        match self {
            Self::UnknownScene(_) => Status::not_found(text),
            Self::Invalid(_) | Self::Camera(_) => Status::invalid_argument(text),
            Self::Stopping => Status::unavailable(text),
            Self::Unimplemented(what) => Status::unimplemented(*what),
            Self::Session(error) => of_session(error, text),
            Self::Repeated(status) => status.clone(),
        }
    }
}

impl From<SensorsimError> for Status {
    fn from(error: SensorsimError) -> Self {
        error.status()
    }
}

fn of_session(error: &SessionError, text: String) -> Status {
    let late = || Status::deadline_exceeded(format!("Stopped waiting for backend: {text}"));
    match error {
        SessionError::Twin(
            StoreError::Name { .. }
            | StoreError::NoTwin { .. }
            | StoreError::NoVersion { .. }
            | StoreError::GarbageCollected { .. },
        ) => Status::not_found(text),
        SessionError::Busy { .. } => Status::unavailable(text),
        SessionError::DeadlineExceeded
        | SessionError::Residency(
            ResidencyError::NoRoom { .. }
            | ResidencyError::TooLarge { .. }
            | ResidencyError::TimedOut { .. },
        ) => late(),
        SessionError::AnswerTooLarge { .. } | SessionError::OutOfRange { .. } => {
            Status::invalid_argument(text)
        }
        _ => Status::internal(text),
    }
}
