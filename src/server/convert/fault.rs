//! Faults to the closed list of codes.

use crate::fault::{Fault, is_content, is_full};
use wildcity_protocol::error::Code;
use wildcity_render::RenderError;
use wildcity_scene::geometry::PoseError;
use wildcity_scene::rig::RigError;
use wildcity_session::SessionError;
use wildcity_sim::EgoError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

/// The code of a fault, and the field at fault where one is.
pub(super) fn code_and_field(fault: &Fault) -> (Code, Option<String>) {
    let field = |text: &str| Some(text.to_owned());
    match fault {
        Fault::MalformedJson(_) | Fault::BrokenFrame(_) => (Code::MalformedJson, None),
        Fault::InvalidRequest { field, .. } => (Code::InvalidRequest, field.clone()),
        Fault::UnexpectedBinary => (Code::UnexpectedBinary, None),
        Fault::MessageTooLarge { .. } => (Code::MessageTooLarge, None),
        Fault::SeqOutOfOrder { .. } => (Code::SeqOutOfOrder, field("seq")),
        Fault::WrongOrder(_) => (Code::WrongOrder, field("type")),
        Fault::UnsupportedProtocol { .. } => (Code::UnsupportedProtocol, field("protocols")),
        Fault::SessionState(_) | Fault::Replaced => (Code::SessionState, None),
        Fault::UnknownSession { .. } => (Code::UnknownSession, field("session")),
        Fault::SessionExists { .. } => (Code::SessionExists, field("session")),
        Fault::InvalidName { field, .. } => (Code::InvalidName, Some(field.clone())),
        Fault::Pose { field, cause } => {
            let code = match cause {
                PoseError::NotFinite { .. } => Code::PoseNotFinite,
                PoseError::NotARotation { .. } | PoseError::TooFar { .. } => Code::PoseInvalid,
            };
            (code, Some(format!("{field}.{}", cause.field())))
        }
        Fault::NotFinite { field } => {
            // The list of codes is closed, and an action is no pose.
            let of_action = field.starts_with("action");
            (if of_action { Code::OutOfRange } else { Code::PoseNotFinite }, Some(field.clone()))
        }
        Fault::Camera { field, cause } => {
            (Code::CameraInvalid, Some(format!("{field}.{}", cause.field())))
        }
        Fault::Appearance { field, .. } => (Code::CameraInvalid, Some(field.clone())),
        Fault::Rig { field, cause } => {
            let code = match cause {
                RigError::Count { .. } | RigError::Overlays { .. } => Code::OutOfRange,
                RigError::Name { .. } | RigError::Duplicate { .. } => Code::InvalidName,
                RigError::Camera { .. } | RigError::Appearance { .. } => Code::CameraInvalid,
            };
            (code, Some(field.clone()))
        }
        Fault::Busy { .. } => (Code::Busy, None),
        Fault::TimedOut(_) => (Code::TimedOut, None),
        Fault::ShuttingDown => (Code::ShuttingDown, None),
        Fault::Unauthorized => (Code::Unauthorized, None),
        Fault::Forbidden { .. } => (Code::Forbidden, None),
        Fault::UnknownUpload { .. } => (Code::UnknownUpload, None),
        Fault::UploadOffset { .. } => (Code::UploadOffset, field("upload-offset")),
        Fault::UploadDigest { .. } => (Code::UploadDigest, None),
        Fault::StorageFull { .. } => (Code::StorageFull, None),
        Fault::NoUploads { .. } => (Code::Busy, None),
        Fault::UnknownPush { .. } => (Code::UnknownPush, None),
        Fault::Content { .. } => (Code::PushRefused, None),
        Fault::OutOfRange { field, .. } => (Code::OutOfRange, Some(field.clone())),
        Fault::Spool { .. } => (Code::Internal, None),
        Fault::Internal(_) => (Code::Internal, None),
        Fault::Session(error) => of_session(error),
    }
}

/// The cells at fault, if cells are.
pub(super) fn cells(fault: &Fault) -> &[[i32; 2]] {
    match fault {
        Fault::Content { cells, .. }
        | Fault::Session(SessionError::Twin(StoreError::Overlap { cells, .. })) => cells,
        _ => &[],
    }
}

fn of_session(error: &SessionError) -> (Code, Option<String>) {
    let field = |text: &str| Some(text.to_owned());
    match error {
        SessionError::Twin(StoreError::Name { .. }) => (Code::InvalidName, field("twin")),
        SessionError::Twin(StoreError::NoTwin { .. }) => (Code::UnknownTwin, field("twin")),
        SessionError::Twin(StoreError::NoVersion { .. } | StoreError::GarbageCollected { .. }) => {
            (Code::UnknownVersion, field("version"))
        }
        SessionError::Twin(StoreError::Overlap { .. } | StoreError::Conflict { .. }) => {
            (Code::Conflict, None)
        }
        SessionError::Twin(error) if is_content(error) => (Code::PushRefused, None),
        SessionError::Twin(StoreError::Io { cause, .. }) if is_full(cause) => {
            (Code::StorageFull, None)
        }
        SessionError::Twin(
            StoreError::NotSynced { .. }
            | StoreError::OutcomeUnknown { .. }
            | StoreError::Url { .. },
        ) => (Code::Internal, None),
        SessionError::Residency(error) => match error {
            ResidencyError::NoRoom { .. } | ResidencyError::TooLarge { .. } => {
                (Code::Busy, field("twin"))
            }
            ResidencyError::TimedOut { .. } => (Code::DeadlineExceeded, None),
            ResidencyError::Load { .. } | ResidencyError::Sky { .. } | ResidencyError::Store(_) => {
                (Code::TwinDamaged, field("twin"))
            }
            ResidencyError::Thread { .. } => (Code::Internal, None),
        },
        SessionError::Twin(_) | SessionError::Route(_) => (Code::TwinDamaged, field("twin")),
        SessionError::UnknownRig { .. } => (Code::UnknownRig, field("rig")),
        SessionError::UnknownCamera { field, .. } => (Code::UnknownCamera, Some(field.clone())),
        SessionError::CameraTwice { index, .. } => {
            (Code::OutOfRange, Some(format!("outputs.cameras[{index}]")))
        }
        SessionError::UnknownTrajectory { .. } => {
            (Code::UnknownTrajectory, field("start.trajectory"))
        }
        SessionError::Profile(_) | SessionError::Sky(_) => (Code::OutOfRange, field("profile")),
        SessionError::OutOfRange { field, .. } => (Code::OutOfRange, Some((*field).to_owned())),
        SessionError::AnswerTooLarge { .. } | SessionError::Render(RenderError::TooMany { .. }) => {
            (Code::AnswerTooLarge, None)
        }
        SessionError::EpisodeOver { .. } => (Code::SessionState, None),
        SessionError::Ego(error) => match error {
            EgoError::Command { .. } => (Code::SessionState, Some(error.field())),
            EgoError::Range { .. }
            | EgoError::PathCount { .. }
            | EgoError::PathTime { .. }
            | EgoError::PathShort { .. } => (Code::OutOfRange, Some(error.field())),
        },
        SessionError::Busy { .. } => (Code::Busy, None),
        SessionError::Render(RenderError::DeviceMemory { .. }) => (Code::Busy, field("twin")),
        SessionError::DeadlineExceeded => (Code::DeadlineExceeded, None),
        SessionError::Render(_)
        | SessionError::Encode { .. }
        | SessionError::Record(_)
        | SessionError::Crashed
        | SessionError::Thread { .. } => (Code::Internal, None),
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use wildcity_scene::RecordFormat;

    /// Only what lies in the push itself is refused for good.
    #[test]
    fn what_a_commit_can_end_with() {
        let io = |kind: io::ErrorKind| StoreError::Io {
            action: "write",
            path: "city/chunk".into(),
            cause: kind.into(),
        };
        let (name, number, cells) = ("city".to_owned(), 2, vec![[0, 0]]);
        let (base, latest, settings) = (1, 2, Vec::new());
        let (url, reason) = ("s3://x".to_owned(), "no credentials".to_owned());
        let (record, field, count, gaussians) = (RecordFormat::default(), "mean", 1, 2);
        for (error, refused, code) in [
            (io(io::ErrorKind::StorageFull), false, Code::StorageFull),
            (io(io::ErrorKind::QuotaExceeded), false, Code::StorageFull),
            (io(io::ErrorKind::PermissionDenied), false, Code::TwinDamaged),
            (
                StoreError::OutcomeUnknown {
                    name: name.clone(),
                    number,
                    cause: io::ErrorKind::TimedOut.into(),
                },
                false,
                Code::Internal,
            ),
            (
                StoreError::NotSynced {
                    name: name.clone(),
                    number,
                    cause: Box::new(io(io::ErrorKind::Other)),
                },
                false,
                Code::Internal,
            ),
            (StoreError::Url { url, reason }, false, Code::Internal),
            (
                StoreError::GarbageCollected { name: name.clone(), number },
                false,
                Code::UnknownVersion,
            ),
            (
                StoreError::Format { path: "city/log/2".into(), found: 9, supported: 1 },
                false,
                Code::TwinDamaged,
            ),
            (StoreError::Conflict { name: name.clone(), number }, false, Code::Conflict),
            (StoreError::Overlap { name, base, latest, cells, settings }, true, Code::Conflict),
            (StoreError::Clamped { record, field, count, gaussians }, true, Code::PushRefused),
        ] {
            let fault = Fault::from(error);
            assert_eq!((fault.is_content(), code_and_field(&fault).0), (refused, code), "{fault}");
        }
    }

    /// The device may have room again when others have left.
    #[test]
    fn a_scene_that_a_device_has_no_room_for_may_be_tried_again() {
        let error = RenderError::DeviceMemory { needed_bytes: 2 << 30, limit_bytes: 1 << 30 };
        let fault = Fault::Session(error.into());
        assert_eq!(code_and_field(&fault), (Code::Busy, Some("twin".to_owned())));
        assert!(fault.to_string().contains("2147483648"), "{fault}");
    }
}
