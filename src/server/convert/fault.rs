//! The table of faults: the wire code of each fault, and the HTTP status of each code.
//!
//! Every `match` is exhaustive, so that a new fault or code does not compile before it has its
//! entry.

use axum::http::StatusCode;
use serde_json::Value;

use wildcity_protocol::error::Code;
use wildcity_protocol::http::Refusal;
use wildcity_protocol::message::Answer;
use wildcity_push::PushError;
use wildcity_render::RenderError;
use wildcity_scene::geometry::PoseError;
use wildcity_scene::profile::ProfileError;
use wildcity_scene::rig::RigError;
use wildcity_session::{ScenarioError, SessionError};
use wildcity_sim::EgoError;
use wildcity_twin::ingest::IngestError;
use wildcity_twin::residency::ResidencyError;
use wildcity_twin::store::StoreError;

use crate::fault::{Fault, is_full};
use crate::socket::CloseStatus;

/// A fault on the wire.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct WireFault {
    pub(super) code: Code,
    /// The field at fault, if any.
    pub(super) field: Option<String>,
}

/// The text of a code, as the wire has it.
#[derive(Clone, Debug)]
pub(crate) struct WireCode(pub(crate) String);

/// The HTTP status of a fault.
pub(crate) fn http_status(fault: &Fault) -> StatusCode {
    match fault {
        // HTTP has a status of its own for these; the code is `invalid_request`.
        Fault::NoUpgrade => StatusCode::UPGRADE_REQUIRED,
        Fault::NoRoute { .. } => StatusCode::NOT_FOUND,
        Fault::NoMethod { .. } => StatusCode::METHOD_NOT_ALLOWED,
        fault => code_status(wire_fault(fault).code),
    }
}

/// The Close frame after a fault that ends the connection (RFC 6455, section 7.4.1).
pub(crate) fn close_status(fault: &Fault) -> CloseStatus {
    let code = match fault {
        Fault::SessionEnded => 1000,
        Fault::ShuttingDown => 1001,
        Fault::BrokenFrame(_) => 1002,
        Fault::NotUtf8 => 1007,
        Fault::MessageTooLarge { .. } => 1009,
        Fault::Busy { .. } => 1013,
        Fault::Internal(_) => 1011,
        // Another connection has the session, or the client was silent: the policy of this server.
        _ => 1008,
    };
    CloseStatus { code, reason: self::code(fault).0 }
}

/// The text of a fault's code.
pub(crate) fn code(fault: &Fault) -> WireCode {
    let code = serde_json::to_value(wire_fault(fault).code);
    WireCode(code.ok().and_then(|code| code.as_str().map(str::to_owned)).unwrap_or_default())
}

/// The message that refuses a request over WebSocket.
pub(crate) fn refused(seq: Option<u64>, fault: &Fault) -> String {
    let WireFault { code, field } = wire_fault(fault);
    let message = fault.to_string();
    let answer = Answer::Error { seq, code, message, field, fatal: fault.is_fatal() };
    // An error of strings and flags always has JSON.
    serde_json::to_string(&answer).unwrap_or_default()
}

/// The body of an HTTP answer that refuses.
pub(crate) fn refusal_body(fault: &Fault) -> Value {
    let WireFault { code, field } = wire_fault(fault);
    let offset = match fault {
        Fault::UploadOffset { held, .. } => Some(*held),
        _ => None,
    };
    let cells = match fault {
        Fault::Session(error) => cells_of_session(error).to_vec(),
        Fault::Push(error) => cells_of_push(error).to_vec(),
        _ => Vec::new(),
    };
    serde_json::json!(Refusal { code, message: fault.to_string(), field, cells, offset })
}

/// The cells at fault in a push; empty if the fault is not in cells.
pub(super) fn cells_of_push(error: &PushError) -> &[[i32; 2]] {
    match error {
        PushError::Content { cells, .. } => cells,
        PushError::Session(error) => cells_of_session(error),
        _ => &[],
    }
}

fn cells_of_session(error: &SessionError) -> &[[i32; 2]] {
    match error {
        SessionError::Twin(StoreError::Overlap { cells, .. }) => cells,
        _ => &[],
    }
}

/// The HTTP status of a code. Codes that only occur over WebSocket have a status as well, so that a
/// new HTTP route can answer with any code.
fn code_status(code: Code) -> StatusCode {
    match code {
        Code::MalformedJson
        | Code::InvalidRequest
        | Code::UnexpectedBinary
        | Code::UnsupportedProtocol
        | Code::InvalidName
        | Code::PoseNotFinite
        | Code::PoseInvalid
        | Code::CameraInvalid
        | Code::ScenarioInvalid
        | Code::OutOfRange => StatusCode::BAD_REQUEST,
        Code::Unauthorized => StatusCode::UNAUTHORIZED,
        Code::Forbidden => StatusCode::FORBIDDEN,
        Code::UnknownTwin
        | Code::UnknownActor
        | Code::UnknownVersion
        | Code::UnknownRig
        | Code::UnknownCamera
        | Code::UnknownTrajectory
        | Code::UnknownSession
        | Code::UnknownState
        | Code::UnknownScenario
        | Code::UnknownRepair
        | Code::UnknownUpload
        | Code::UnknownPush => StatusCode::NOT_FOUND,
        Code::TimedOut => StatusCode::REQUEST_TIMEOUT,
        Code::SeqOutOfOrder
        | Code::WrongOrder
        | Code::SessionState
        | Code::SessionExists
        | Code::UploadOffset
        | Code::Conflict => StatusCode::CONFLICT,
        Code::MessageTooLarge => StatusCode::PAYLOAD_TOO_LARGE,
        Code::AnswerTooLarge | Code::UploadDigest | Code::PushRefused => {
            StatusCode::UNPROCESSABLE_ENTITY
        }
        Code::TwinDamaged | Code::RepairFailed | Code::Internal => {
            StatusCode::INTERNAL_SERVER_ERROR
        }
        Code::Busy
        | Code::ShuttingDown
        | Code::RepairUnavailable
        | Code::SharedMemoryUnavailable => StatusCode::SERVICE_UNAVAILABLE,
        Code::DeadlineExceeded => StatusCode::GATEWAY_TIMEOUT,
        Code::StorageFull => StatusCode::INSUFFICIENT_STORAGE,
    }
}

/// A code without a field.
fn plain(code: Code) -> WireFault {
    WireFault { code, field: None }
}

/// A code with the field at fault.
fn at(code: Code, field: &str) -> WireFault {
    WireFault { code, field: Some(field.to_owned()) }
}

/// The code and the field of a fault.
pub(super) fn wire_fault(fault: &Fault) -> WireFault {
    match fault {
        Fault::MalformedJson(_) | Fault::BrokenFrame(_) | Fault::NotUtf8 => {
            plain(Code::MalformedJson)
        }
        Fault::InvalidRequest { field, .. } => {
            WireFault { code: Code::InvalidRequest, field: field.clone() }
        }
        Fault::UnexpectedBinary => plain(Code::UnexpectedBinary),
        Fault::MessageTooLarge { .. } => plain(Code::MessageTooLarge),
        Fault::SeqOutOfOrder { field, .. } => at(Code::SeqOutOfOrder, field),
        Fault::WrongOrder(_) => at(Code::WrongOrder, "type"),
        Fault::UnsupportedProtocol { .. } => at(Code::UnsupportedProtocol, "protocols"),
        Fault::SessionState(_) => at(Code::SessionState, "type"),
        Fault::Replaced => plain(Code::SessionState),
        Fault::UnknownSession { field, .. } => at(Code::UnknownSession, field),
        Fault::NoSuchSession { field, .. } => at(Code::UnknownSession, field),
        Fault::UnknownTrajectory { field, .. } => at(Code::UnknownTrajectory, field),
        Fault::SessionExists { .. } => at(Code::SessionExists, "session"),
        Fault::NotOnConnection { .. } => at(Code::UnknownSession, "session"),
        Fault::SessionTwice { field, .. } => at(Code::InvalidName, field),
        Fault::OtherConnection { field, .. } => at(Code::SeqOutOfOrder, field),
        Fault::InvalidName { field, .. } => at(Code::InvalidName, field),
        Fault::Pose { field, cause } => {
            let code = match cause {
                PoseError::NotFinite { .. } => Code::PoseNotFinite,
                PoseError::NotARotation { .. } | PoseError::TooFar { .. } => Code::PoseInvalid,
            };
            at(code, &format!("{field}.{}", cause.field()))
        }
        Fault::PoseNotFinite { field } => at(Code::PoseNotFinite, field),
        Fault::Camera { field, cause } => {
            at(Code::CameraInvalid, &format!("{field}.{}", cause.field()))
        }
        Fault::Appearance { field, .. } => at(Code::CameraInvalid, field),
        Fault::Rig { field, cause } => {
            let code = match cause {
                RigError::Count { .. } | RigError::Overlays { .. } => Code::OutOfRange,
                RigError::Name { .. } | RigError::Duplicate { .. } => Code::InvalidName,
                RigError::Camera { .. } | RigError::Appearance { .. } => Code::CameraInvalid,
            };
            at(code, field)
        }
        Fault::Busy { .. } | Fault::NoUploads { .. } => plain(Code::Busy),
        Fault::TimedOut(_) => plain(Code::TimedOut),
        Fault::ShuttingDown => plain(Code::ShuttingDown),
        Fault::Unauthorized => at(Code::Unauthorized, "authorization"),
        Fault::UnknownTicket => at(Code::Unauthorized, "ticket"),
        Fault::NothingToWatch { .. } => at(Code::UnknownSession, "session"),
        Fault::SessionEnded => plain(Code::UnknownSession),
        Fault::WatcherSent => plain(Code::InvalidRequest),
        Fault::NoEpisode { .. } | Fault::NoMcap { .. } => at(Code::UnknownState, "episode"),
        Fault::Forbidden { field, .. } => at(Code::Forbidden, field),
        Fault::ForbiddenOrigin { .. } => at(Code::Forbidden, "origin"),
        Fault::ForbiddenHost { .. } => at(Code::Forbidden, "host"),
        Fault::HeaderTwice { header } => at(Code::InvalidRequest, header),
        Fault::NoUpgrade => at(Code::InvalidRequest, "upgrade"),
        Fault::Handshake { header, .. } => at(Code::InvalidRequest, header),
        Fault::NoSubprotocol { .. } => at(Code::UnsupportedProtocol, "sec-websocket-protocol"),
        Fault::NoSharedMemory { field, .. } => at(Code::SharedMemoryUnavailable, field),
        Fault::NoRoute { .. } | Fault::NoMethod { .. } => plain(Code::InvalidRequest),
        Fault::UnknownUpload { field, .. } => {
            WireFault { code: Code::UnknownUpload, field: field.clone() }
        }
        Fault::UploadOffset { .. } => at(Code::UploadOffset, "upload-offset"),
        Fault::UploadDigest { .. } => plain(Code::UploadDigest),
        Fault::StorageFull { .. } => plain(Code::StorageFull),
        Fault::OutOfRange { field, .. } => at(Code::OutOfRange, field),
        Fault::Audit { cause, .. } if is_full(cause) => plain(Code::StorageFull),
        Fault::Audit { .. }
        | Fault::SpoolRead { .. }
        | Fault::SpoolWrite { .. }
        | Fault::Internal(_) => plain(Code::Internal),
        Fault::Session(error) => session_fault(error),
        Fault::Push(error) => push_fault(error),
    }
}

/// The code and the field of an error of a push.
pub(super) fn push_fault(error: &PushError) -> WireFault {
    match error {
        PushError::OutOfRange { field, .. } => at(Code::OutOfRange, field),
        PushError::InvalidField { field, .. } => at(Code::InvalidRequest, field),
        PushError::InvalidName { field, .. } => at(Code::InvalidName, field),
        PushError::Content { .. } => plain(Code::PushRefused),
        PushError::UnknownPush { .. } => plain(Code::UnknownPush),
        PushError::Busy { .. } => plain(Code::Busy),
        PushError::TimedOut { .. } => plain(Code::PushRefused),
        PushError::Cancelled | PushError::TooLate { .. } => plain(Code::Conflict),
        PushError::ShuttingDown => plain(Code::ShuttingDown),
        PushError::Session(error) => session_fault(error),
        PushError::Unreadable { .. } | PushError::Abandoned { .. } | PushError::Crashed => {
            plain(Code::Internal)
        }
    }
}

fn session_fault(error: &SessionError) -> WireFault {
    match error {
        SessionError::Twin(error) => store_fault(error),
        SessionError::Residency(error) => residency_fault(error),
        SessionError::Route(_) => at(Code::TwinDamaged, "twin"),
        SessionError::Scenario(error) => match error {
            ScenarioError::Unknown { .. } => at(Code::UnknownScenario, "scenario"),
            _ => at(Code::ScenarioInvalid, &error.field()),
        },
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
        SessionError::Profile(error) => profile_fault(error),
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
        SessionError::Render(error) => render_fault(error),
        SessionError::Record(error) if is_full(&error.cause) => plain(Code::StorageFull),
        SessionError::Encode { .. }
        | SessionError::Record(_)
        | SessionError::Crashed
        | SessionError::Thread { .. } => plain(Code::Internal),
    }
}

fn profile_fault(error: &ProfileError) -> WireFault {
    match error {
        ProfileError::Value { field, .. } => at(Code::OutOfRange, &format!("profile.{field}")),
        ProfileError::Change { field, .. } => at(Code::InvalidRequest, &format!("profile.{field}")),
        ProfileError::Setting { .. } => at(Code::InvalidRequest, "profile"),
    }
}

fn store_fault(error: &StoreError) -> WireFault {
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
        StoreError::Gaussians(IngestError::File(_)) => at(Code::TwinDamaged, "twin"),
        StoreError::Gaussians(_)
        | StoreError::Clamped { .. }
        | StoreError::Profile(_)
        | StoreError::FieldMismatch { .. }
        | StoreError::Alignment(_)
        | StoreError::Scattered { .. }
        | StoreError::ManifestSize { .. }
        | StoreError::ViewSize { .. }
        | StoreError::NothingToCut { .. } => plain(Code::PushRefused),
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

fn residency_fault(error: &ResidencyError) -> WireFault {
    match error {
        ResidencyError::NoRoom { .. } | ResidencyError::TooLarge { .. } => at(Code::Busy, "twin"),
        ResidencyError::NoRoomForActor { .. } => at(Code::Busy, "scenario"),
        ResidencyError::TimedOut { .. } => plain(Code::DeadlineExceeded),
        ResidencyError::Load { .. } | ResidencyError::Sky { .. } | ResidencyError::Store(_) => {
            at(Code::TwinDamaged, "twin")
        }
        ResidencyError::Thread { .. } => plain(Code::Internal),
    }
}

fn render_fault(error: &RenderError) -> WireFault {
    match error {
        RenderError::TooMany { .. } => plain(Code::AnswerTooLarge),
        // The device may have room again when other sessions have ended.
        RenderError::DeviceMemory { .. } => at(Code::Busy, "twin"),
        RenderError::ExactRays { .. } => at(Code::OutOfRange, "profile"),
        RenderError::Views { .. }
        | RenderError::TargetSize { .. }
        | RenderError::Normals { .. }
        | RenderError::Overlay { .. }
        | RenderError::Actors { .. }
        | RenderError::Targets { .. }
        | RenderError::Sky(_)
        | RenderError::Device { .. } => plain(Code::Internal),
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use wildcity_scene::RecordFormat;

    /// Results of a commit, over WebSocket or over HTTP.
    #[test]
    fn every_error_of_a_commit_has_its_code() {
        let io = |kind: io::ErrorKind| StoreError::Io {
            action: "write",
            path: "city/chunk".into(),
            cause: kind.into(),
        };
        let name = || "city".to_owned();
        let unsettled = StoreError::OutcomeUnknown {
            name: name(),
            number: 2,
            cause: io::ErrorKind::TimedOut.into(),
        };
        let not_synced = StoreError::NotSynced {
            name: name(),
            number: 2,
            cause: Box::new(io(io::ErrorKind::Other)),
        };
        let overlap = StoreError::Overlap {
            name: name(),
            base: 1,
            latest: 2,
            cells: vec![[0, 0]],
            settings: Vec::new(),
        };
        let clamped = StoreError::Clamped {
            record: RecordFormat::default(),
            field: "mean",
            count: 1,
            gaussians: 2,
        };
        let url = StoreError::Url { url: "s3://x".to_owned(), reason: "no credentials".to_owned() };
        let format = StoreError::Format { path: "city/log/2".into(), found: 9, supported: 1 };
        for (error, code, status) in [
            (io(io::ErrorKind::StorageFull), Code::StorageFull, 507),
            (io(io::ErrorKind::QuotaExceeded), Code::StorageFull, 507),
            (io(io::ErrorKind::PermissionDenied), Code::TwinDamaged, 500),
            (unsettled, Code::Internal, 500),
            (not_synced, Code::Internal, 500),
            (url, Code::Internal, 500),
            (StoreError::GarbageCollected { name: name(), number: 2 }, Code::UnknownVersion, 404),
            (format, Code::TwinDamaged, 500),
            (StoreError::Conflict { name: name(), number: 2 }, Code::Conflict, 409),
            (overlap, Code::Conflict, 409),
            (clamped, Code::PushRefused, 422),
        ] {
            let fault = Fault::from(error);
            assert_eq!(wire_fault(&fault).code, code, "{fault}");
            assert_eq!(http_status(&fault).as_u16(), status, "{fault}");
        }
    }

    #[test]
    fn a_scene_that_a_device_has_no_room_for_may_be_tried_again() {
        let error = RenderError::DeviceMemory { needed_bytes: 2 << 30, limit_bytes: 1 << 30 };
        let fault = Fault::Session(error.into());
        assert_eq!(wire_fault(&fault), at(Code::Busy, "twin"));
        assert!(fault.to_string().contains("2147483648"), "{fault}");
    }

    /// The protocol's page has the same codes with the same status, and no other.
    #[test]
    fn the_page_of_the_protocol_has_the_same_table() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../protocol/README.md");
        let page = std::fs::read_to_string(path).unwrap();
        let section = page.split("\n## Errors").nth(1).expect("a section on errors");
        let section = section.split("\n## ").next().expect("split gives at least one part");
        let mut rows: Vec<(String, u16)> = Vec::new();
        for line in section.lines().filter(|line| line.starts_with("| `")) {
            let cells: Vec<&str> = line.split('|').map(str::trim).collect();
            let status = cells[2].parse().unwrap_or_else(|_| panic!("no status in {line}"));
            rows.push((cells[1].trim_matches('`').to_owned(), status));
        }
        rows.sort();
        let schema = serde_json::to_value(schemars::schema_for!(Code)).unwrap();
        let variants = schema["oneOf"].as_array().expect("one variant per code");
        let mut table: Vec<(String, u16)> = Vec::new();
        for variant in variants {
            let code: Code = serde_json::from_value(variant["const"].clone()).unwrap();
            let name = variant["const"].as_str().expect("a text").to_owned();
            table.push((name, code_status(code).as_u16()));
        }
        table.sort();
        assert_eq!(rows, table);
    }
}
