//! The wire code of each error of another package, and the field at fault.

use wildcity_protocol::error::Code;
use wildcity_push::PushError;
use wildcity_render::RenderError;
use wildcity_scene::geometry::PoseError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::{RigError, RigFieldError};
use wildcity_session::{ScenarioError, SessionError};
use wildcity_sim::EgoError;
use wildcity_twin::ingest::IngestError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use super::is_full;

/// A code, and the field at fault, if any.
type Place = (Code, Option<String>);

/// A code without a field.
fn plain(code: Code) -> Place {
    (code, None)
}

/// A code with the field at fault.
fn at(code: Code, field: &str) -> Place {
    (code, Some(field.to_owned()))
}

pub(super) fn pose_code(error: &PoseError) -> Code {
    match error {
        // Not finite has a code of its own, because it comes from a client's own computation and
        // not from its choice.
        PoseError::NotFinite { .. } => Code::PoseNotFinite,
        PoseError::NotARotation { .. } | PoseError::TooFar { .. } => Code::PoseInvalid,
    }
}

fn rig_place(RigFieldError { part, cause }: &RigFieldError) -> Place {
    let part = format!("rig.{part}");
    match cause {
        RigError::Count { .. }
        | RigError::Overlays { .. }
        | RigError::Lidars { .. }
        | RigError::Beams { .. } => at(Code::OutOfRange, &part),
        RigError::Name { .. } | RigError::Duplicate { .. } => at(Code::InvalidName, &part),
        RigError::Pose { cause, .. } => at(pose_code(cause), &format!("{part}.{}", cause.field())),
        RigError::Camera { cause, .. } => {
            at(Code::CameraInvalid, &format!("{part}.{}", cause.field()))
        }
        RigError::LidarPose { cause, .. } => {
            at(pose_code(cause), &format!("{part}.{}", cause.field()))
        }
        RigError::Appearance { .. } | RigError::Lidar { .. } => at(Code::CameraInvalid, &part),
    }
}

/// The cells at fault in a push; empty if the fault is not in cells.
pub(super) fn cells_of_push(error: &PushError) -> &[[i32; 2]] {
    match error {
        PushError::Content { cells, .. } => cells,
        PushError::Session(error) => cells_of_session(error),
        _ => &[],
    }
}

pub(super) fn cells_of_session(error: &SessionError) -> &[[i32; 2]] {
    match error {
        SessionError::Twin(StoreError::Overlap { cells, .. }) => cells,
        _ => &[],
    }
}

/// The code and the field of an error of a push.
pub(super) fn push_place(error: &PushError) -> Place {
    match error {
        PushError::OutOfRange { field, .. } => at(Code::OutOfRange, field),
        PushError::InvalidField { field, .. } => at(Code::InvalidRequest, field),
        PushError::InvalidName { field, .. } => at(Code::InvalidName, field),
        PushError::Content { .. } => plain(Code::PushRefused),
        PushError::UnknownPush { .. } => plain(Code::UnknownPush),
        PushError::Busy { .. } => plain(Code::Busy),
        // The same push would take as long again.
        PushError::TimedOut { .. } => plain(Code::PushRefused),
        PushError::Cancelled | PushError::TooLate { .. } => plain(Code::Conflict),
        PushError::ShuttingDown => plain(Code::ShuttingDown),
        PushError::Session(error) => session_place(error),
        PushError::Unreadable { .. } | PushError::Abandoned { .. } | PushError::Crashed => {
            plain(Code::Internal)
        }
    }
}

pub(super) fn session_place(error: &SessionError) -> Place {
    match error {
        SessionError::Twin(error) => store_place(error),
        SessionError::Residency(error) => residency_place(error),
        SessionError::Route(_) => at(Code::TwinDamaged, "twin"),
        SessionError::Scenario(error) => match error {
            // An unknown name is the field itself; any other error names a part of the scenario.
            ScenarioError::Unknown { .. } | ScenarioError::NotForTwin => {
                at(Code::UnknownScenario, "scenario")
            }
            ScenarioError::Choice { field, .. } => at(Code::InvalidRequest, field),
            _ => at(Code::ScenarioInvalid, &error.field()),
        },
        SessionError::Rig(error) => rig_place(error),
        SessionError::Pose { field, cause } => {
            at(pose_code(cause), &format!("{field}.{}", cause.field()))
        }
        SessionError::Name { field, .. } => at(Code::InvalidName, field),
        SessionError::UnknownRig { .. } => at(Code::UnknownRig, "rig"),
        SessionError::UnknownRepair { .. } => at(Code::UnknownRepair, "repair.model"),
        SessionError::RepairUnavailable { .. } => at(Code::RepairUnavailable, "repair.model"),
        SessionError::Repair { .. } => plain(Code::RepairFailed),
        SessionError::UnknownCamera { field, .. } => at(Code::UnknownCamera, field),
        SessionError::CameraTwice { index, .. } => {
            at(Code::InvalidName, &format!("outputs.cameras[{index}]"))
        }
        SessionError::UnknownSnapshot { field, .. } => at(Code::UnknownState, field),
        SessionError::UnknownEpisode { .. } => at(Code::UnknownState, "from.episode"),
        SessionError::Branch { .. } => at(Code::UnknownState, "from"),
        SessionError::CameraOption { field, .. } => at(Code::OutOfRange, field),
        SessionError::UnknownTrajectory { field, .. } => at(Code::UnknownTrajectory, field),
        SessionError::Profile(error) => profile_place(error),
        SessionError::Sky(_) => at(Code::OutOfRange, "profile.sky_error"),
        SessionError::OutOfRange { field, .. } => at(Code::OutOfRange, field),
        SessionError::AnswerTooLarge { field, .. } => at(Code::AnswerTooLarge, field),
        SessionError::EpisodeOver { .. } => at(Code::SessionState, "type"),
        SessionError::Ego(error) => {
            let code = match error {
                EgoError::Command { .. } => Code::SessionState,
                EgoError::Range { .. }
                | EgoError::PathCount { .. }
                | EgoError::PathTime { .. }
                | EgoError::PathShort { .. } => Code::OutOfRange,
            };
            at(code, &error.field())
        }
        SessionError::Busy { .. } => plain(Code::Busy),
        SessionError::DeadlineExceeded => plain(Code::DeadlineExceeded),
        SessionError::Render(error) => render_place(error),
        // A disk that takes nothing is, to a client, the same as one that takes no more.
        SessionError::Record(error) if is_full(&error.cause) || is_closed(&error.cause) => {
            plain(Code::StorageFull)
        }
        SessionError::Encode { .. }
        | SessionError::Record(_)
        | SessionError::Crashed
        | SessionError::Thread { .. } => plain(Code::Internal),
    }
}

/// Whether a folder may not be written.
fn is_closed(cause: &std::io::Error) -> bool {
    use std::io::ErrorKind::{PermissionDenied, ReadOnlyFilesystem};
    matches!(cause.kind(), PermissionDenied | ReadOnlyFilesystem)
}

fn profile_place(error: &ProfileError) -> Place {
    match error {
        ProfileError::Value { field, .. } => at(Code::OutOfRange, &format!("profile.{field}")),
        ProfileError::Change { field, .. } => at(Code::InvalidRequest, &format!("profile.{field}")),
        ProfileError::Setting { .. } => at(Code::InvalidRequest, "profile"),
    }
}

fn store_place(error: &StoreError) -> Place {
    match error {
        StoreError::Name { .. } => at(Code::InvalidName, "twin"),
        StoreError::NoTwin { .. } => at(Code::UnknownTwin, "twin"),
        StoreError::NoActor { .. } => at(Code::UnknownActor, "actor"),
        StoreError::ActorDamaged { .. } => at(Code::TwinDamaged, "actor"),
        StoreError::ActorExists { .. } => at(Code::Conflict, "name"),
        StoreError::NoVersion { .. } | StoreError::GarbageCollected { .. } => {
            at(Code::UnknownVersion, "version")
        }
        StoreError::Overlap { .. }
        | StoreError::TwinExists { .. }
        | StoreError::Conflict { .. } => plain(Code::Conflict),
        // The file is one of the store here, and not an upload, which has an error of its own.
        StoreError::Gaussians(IngestError::File(_)) => at(Code::TwinDamaged, "twin"),
        StoreError::Gaussians(_)
        | StoreError::Clamped { .. }
        | StoreError::Profile(_)
        | StoreError::FieldMismatch { .. }
        | StoreError::Alignment(_)
        | StoreError::Scattered { .. }
        | StoreError::ManifestSize { .. }
        | StoreError::ViewSize { .. }
        | StoreError::NothingToCut { .. }
        | StoreError::NothingToLabel => plain(Code::PushRefused),
        // Before the arm of all other errors of the disk.
        StoreError::Io { cause, .. } if is_full(cause) => plain(Code::StorageFull),
        StoreError::NotSynced { .. }
        | StoreError::OutcomeUnknown { .. }
        | StoreError::Url { .. } => plain(Code::Internal),
        StoreError::Io { .. }
        | StoreError::Leased { .. }
        | StoreError::Damaged { .. }
        | StoreError::Format { .. }
        | StoreError::DuplicateCell { .. }
        | StoreError::SideFileSize { .. }
        | StoreError::Rig(_)
        | StoreError::Geo(_)
        | StoreError::Trajectory(_)
        | StoreError::DuplicateTrajectory { .. } => at(Code::TwinDamaged, "twin"),
    }
}

fn residency_place(error: &ResidencyError) -> Place {
    match error {
        // Memory may be free again when other sessions have ended.
        ResidencyError::NoRoom { .. } | ResidencyError::TooLarge { .. } => at(Code::Busy, "twin"),
        ResidencyError::NoRoomForActor { .. } => at(Code::Busy, "scenario"),
        ResidencyError::TimedOut { .. } => plain(Code::DeadlineExceeded),
        ResidencyError::Load { .. } | ResidencyError::Sky { .. } | ResidencyError::Store(_) => {
            at(Code::TwinDamaged, "twin")
        }
        ResidencyError::Views { .. } | ResidencyError::Thread { .. } => plain(Code::Internal),
    }
}

fn render_place(error: &RenderError) -> Place {
    match error {
        RenderError::TooMany { .. } => plain(Code::AnswerTooLarge),
        // The device may have room again when other sessions have ended.
        RenderError::DeviceMemory { .. } => at(Code::Busy, "twin"),
        RenderError::ExactRays { .. } => at(Code::OutOfRange, "profile"),
        // The checks of a request exclude these, so that they are defects, or the device has
        // failed.
        RenderError::Views { .. }
        | RenderError::TargetSize { .. }
        | RenderError::Normals { .. }
        | RenderError::Overlay { .. }
        | RenderError::Actors { .. }
        | RenderError::Targets { .. }
        | RenderError::Sky(_)
        | RenderError::Selection { .. }
        | RenderError::Device { .. } => plain(Code::Internal),
    }
}
