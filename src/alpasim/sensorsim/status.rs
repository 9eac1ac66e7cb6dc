//! The gRPC status of each error.
//!
//! AlpaSim's runtime retries `UNAVAILABLE`, and `DEADLINE_EXCEEDED` with the text "Stopped waiting
//! for backend".

use tonic::Status;

use wildcity_session::SessionError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use crate::camera::CameraSpecError;
use crate::limits;
use crate::object::ObjectError;
use crate::scene::SceneError;

/// Why a request was refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SensorsimError {
    /// There is no such scene.
    #[error("{0}")]
    UnknownScene(String),
    /// The request is invalid.
    #[error("{0}")]
    Invalid(String),
    /// A camera, a pose or a size is invalid.
    #[error(transparent)]
    Camera(#[from] CameraSpecError),
    /// The id of a dynamic object stands for nothing.
    #[error(transparent)]
    Object(#[from] ObjectError),
    /// The session layer refused.
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("the server is shutting down")]
    Stopping,
    /// The error of another request of the same scene.
    #[error("{}", .0.message())]
    Repeated(Status),
}

impl From<SceneError> for SensorsimError {
    fn from(error: SceneError) -> Self {
        match error {
            SceneError::Id { .. } | SceneError::Trajectory { .. } | SceneError::Start { .. } => {
                Self::UnknownScene(error.to_string())
            }
            // The scene exists, but a pose within the request is at fault.
            SceneError::Pose { .. } | SceneError::Missing { .. } => Self::Camera(error.into()),
        }
    }
}

impl SensorsimError {
    /// The status that the client gets: a message of at most [`limits::STATUS_BYTES`].
    pub(crate) fn status(&self) -> Status {
        let text = self.to_string();
        let status = match self {
            Self::UnknownScene(_) => Status::not_found(text),
            Self::Invalid(_) | Self::Camera(_) | Self::Object(_) => Status::invalid_argument(text),
            Self::Stopping => Status::unavailable(text),
            Self::Session(error) => session_status(error, text),
            Self::Repeated(status) => status.clone(),
        };
        let text = status.message();
        if text.len() <= limits::STATUS_BYTES {
            return status;
        }
        // Clients bound the size of headers: a longer one would lose the whole answer.
        let end = text.floor_char_boundary(limits::STATUS_BYTES);
        Status::new(status.code(), &text[..end])
    }
}

impl From<SensorsimError> for Status {
    fn from(error: SensorsimError) -> Self {
        error.status()
    }
}

fn session_status(error: &SessionError, text: String) -> Status {
    // The runtime retries by this text, word for word.
    let late = || Status::deadline_exceeded(format!("Stopped waiting for backend: {text}"));
    match error {
        SessionError::Twin(
            StoreError::Name { .. }
            | StoreError::NoTwin { .. }
            | StoreError::NoVersion { .. }
            | StoreError::GarbageCollected { .. },
        ) => Status::not_found(text),
        // A dynamic object names an asset that does not exist.
        SessionError::Twin(StoreError::NoActor { .. } | StoreError::ActorDamaged { .. }) => {
            Status::invalid_argument(format!("dynamic_objects: {text}"))
        }
        SessionError::Busy { .. } => Status::unavailable(text),
        SessionError::DeadlineExceeded
        // Too little memory now may be enough later, when other scenes are idle.
        | SessionError::Residency(
            ResidencyError::NoRoom { .. }
            | ResidencyError::NoRoomForActor { .. }
            | ResidencyError::TooLarge { .. }
            | ResidencyError::TimedOut { .. },
        ) => late(),
        SessionError::AnswerTooLarge { .. } | SessionError::OutOfRange { .. } => {
            Status::invalid_argument(text)
        }
        // What remains is no fault of the request: retrying it does not help.
        _ => Status::internal(text),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use tonic::Code;

    /// Every row of the table in docs/alpasim.md that a single request cannot cause.
    #[test]
    fn each_error_has_its_status() {
        let session = |error: SessionError| SensorsimError::from(error);
        let residency = |error: ResidencyError| session(error.into());
        let twin = String::from("demo");
        let text = String::from("sedan");
        let no_room = ResidencyError::NoRoom {
            twin: twin.clone(),
            needed_bytes: 2,
            held_bytes: 0,
            limit_bytes: 1,
        };
        let no_room_for_actor = ResidencyError::NoRoomForActor {
            actor: text.clone(),
            needed_bytes: 2,
            held_bytes: 0,
            limit_bytes: 1,
        };
        let too_large =
            // Any numbers: only the kind of an error decides on its status.
            ResidencyError::TooLarge { twin: twin.clone(), needed_bytes: 2, limit_bytes: 1 };
        let timed_out = ResidencyError::TimedOut {
            twin: twin.clone(),
            missing: 1,
            needed: 2,
            waited: Duration::from_secs(300),
        };
        let no_actor = StoreError::NoActor { text, found: 0, known: Vec::new() };
        let id = "x".parse::<crate::scene::SceneId>().unwrap_err();
        let object = crate::object::ObjectShape::from_track("7@").unwrap_err();
        let late = "Stopped waiting for backend: ";
        for (error, code, start) in [
            (SensorsimError::from(id), Code::NotFound, "\"x\" is no scene"),
            (SensorsimError::Stopping, Code::Unavailable, "the server is shutting down"),
            (session(SessionError::Busy { what: "frames queued" }), Code::Unavailable, ""),
            (session(SessionError::DeadlineExceeded), Code::DeadlineExceeded, late),
            (residency(no_room), Code::DeadlineExceeded, late),
            (residency(no_room_for_actor), Code::DeadlineExceeded, late),
            (residency(too_large), Code::DeadlineExceeded, late),
            (residency(timed_out), Code::DeadlineExceeded, late),
            (session(no_actor.into()), Code::InvalidArgument, "dynamic_objects: "),
            (object.into(), Code::InvalidArgument, "dynamic_objects: track_id"),
            (session(SessionError::Crashed), Code::Internal, ""),
        ] {
            let status = error.status();
            assert_eq!(status.code(), code, "{status}");
            assert!(status.message().starts_with(start), "{status}");
            // Several requests of one scene get the same status.
            let repeated = SensorsimError::Repeated(error.status()).status();
            assert_eq!((repeated.code(), repeated.message()), (code, status.message()));
        }
    }

    #[test]
    fn a_long_message_is_cut_between_two_characters() {
        let message = |text: String| SensorsimError::Invalid(text).status().message().to_owned();
        let whole = "a".repeat(limits::STATUS_BYTES);
        assert_eq!(message(whole.clone()), whole);
        // The two bytes of the last character would be on both sides of the limit.
        let cut = format!("a{}", "é".repeat(limits::STATUS_BYTES / 2 - 1));
        assert_eq!(message(format!("{cut}éé")), cut);
        let unknown = SessionError::UnknownRig { name: "é".repeat(5000), known: Vec::new() };
        let status = SensorsimError::from(unknown).status();
        assert_eq!(status.code(), Code::Internal);
        assert!(status.message().len() <= limits::STATUS_BYTES, "{}", status.message().len());
    }
}
