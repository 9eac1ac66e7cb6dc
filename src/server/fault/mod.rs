//! Why a request or a connection is refused: the table of faults.
//!
//! [`Fault::report`] is the table: one arm has the wire code, the field at fault and the text of a
//! fault, and [`status`] has the HTTP status of each code. Every `match` is exhaustive, so that a
//! new fault or code does not compile before it has its entry. `errors` has the codes of the errors
//! of other packages, whose text is their own.

mod errors;

use std::fmt::{self, Display, Formatter};
use std::io;
use std::path::PathBuf;

use axum::http::StatusCode;
use serde_json::{Value, json};

use wildcity_protocol::error::Code;
use wildcity_protocol::http::Refusal;
use wildcity_protocol::message::Answer;
use wildcity_push::PushError;
use wildcity_scene::geometry::PoseError;
use wildcity_session::SessionError;
use wildcity_twin::store::StoreError;

use errors::{cells_of_push, cells_of_session, pose_code, push_place, session_place};

/// Why a request or a connection was refused. Its text is in [`Fault::report`].
#[derive(Debug)]
pub(crate) enum Fault {
    /// A text frame or a body is not JSON.
    MalformedJson(String),
    /// JSON, but not a request; `field` is that at fault, for example `rig.cameras[2].width`.
    InvalidRequest { field: Option<String>, reason: String },
    /// The client sent a binary frame; only the server sends those.
    UnexpectedBinary,
    /// A message has more bytes than a request may have.
    MessageTooLarge { bytes: usize, limit: usize },
    /// The messages that clients have begun and not ended have too many bytes together.
    Unfinished,
    /// The bytes are not WebSocket.
    BrokenFrame(String),
    /// A text message, or the reason of a Close frame, is not UTF-8.
    NotUtf8,
    /// The request's number, `seq` or `last_seq`, is neither the next one nor a repeated one.
    SeqOutOfOrder { field: &'static str, seq: u64, expected: String },
    /// A request before `hello`, or a second `hello`.
    WrongOrder(&'static str),
    /// Server and client have no protocol version in common.
    UnsupportedProtocol { server: &'static str, offered: Vec<String> },
    /// The connection already has an open session, or it has none although the request needs one.
    SessionState(&'static str),
    /// There is no session to resume.
    UnknownSession { field: String, name: String },
    /// There is no session of this name from which another one could be opened.
    NoSuchSession { field: &'static str, name: String },
    /// The connection has the sessions `open`, and not this one.
    NotOnConnection { name: String, open: Vec<String> },
    /// A list names a session twice.
    SessionTwice { field: String, name: String },
    /// The sessions to resume together did not belong to one connection; `seq` is the number of the
    /// session's last request.
    OtherConnection { field: String, name: String, seq: u64 },
    /// The twin has the trajectories `known`, and not this one.
    UnknownTrajectory { field: String, name: String, known: Vec<String> },
    /// Another session has the name.
    SessionExists { name: String },
    /// A text is not a name.
    InvalidName { field: String, name: String },
    /// `field` is the pose, as `poses[3]`.
    Pose { field: String, cause: PoseError },
    /// NaN or infinity in a pose, which JSON cannot express; `field` as `pose.xyz[0]`.
    PoseNotFinite { field: String },
    /// The count of `what` has reached its maximum.
    Busy { what: &'static str, limit: usize },
    /// The client was silent for too long.
    TimedOut(&'static str),
    /// Another connection took over the session or the upload.
    Replaced,
    /// The request has no token, or an unknown one.
    Unauthorized,
    /// The ticket was used, is too old, or was never issued.
    UnknownTicket,
    /// There is no such session to watch, or it belongs to another token.
    NothingToWatch { name: String },
    /// The watched session ended.
    SessionEnded,
    /// A watcher sent something.
    WatcherSent,
    /// There is no recorded episode of this name.
    NoEpisode { name: String },
    /// The episode of this name has no MCAP file.
    NoMcap { name: String, reason: String },
    /// The token's role or twins do not allow the request; `field` decides it.
    Forbidden { field: &'static str, reason: String },
    /// The request's host name is not one of the server's names, which are `served`.
    ForbiddenHost { host: String, served: &'static str },
    /// A header that is allowed once occurs more than once.
    HeaderTwice { header: &'static str },
    /// A web page of another machine sent the request.
    ForbiddenOrigin { origin: String },
    /// The address of sessions was requested without an upgrade.
    NoUpgrade,
    /// A header of the WebSocket handshake is wrong.
    Handshake { header: &'static str, must: &'static str },
    /// The handshake does not offer the protocol's name.
    NoSubprotocol { protocol: &'static str },
    /// The client cannot have observations in shared memory; the reason has the remedy.
    NoSharedMemory { field: &'static str, reason: String },
    /// There is no route of this path.
    NoRoute { path: String },
    /// The route does not have this method.
    NoMethod { method: String, path: String },
    /// `field` is that of the body which has the id, if any.
    UnknownUpload { id: String, field: Option<String> },
    /// The bytes do not continue the upload, which goes on from `held`.
    UploadOffset { given: u64, held: u64 },
    /// An upload differs from its announcement in `what`, a digest or a size.
    UploadDigest { what: &'static str, promised: String, found: String },
    /// The disk or the space for uploads is full.
    StorageFull { reason: String },
    /// This server has no directory for uploads.
    NoUploads { reason: String },
    /// A field of a body is outside its limits; `must` has its value, and what is accepted.
    OutOfRange { field: String, must: String },
    /// A file of the spool cannot be read now; a repetition may succeed.
    SpoolRead { cause: io::Error },
    /// A file of the spool cannot be written.
    SpoolWrite { cause: io::Error },
    /// The audit log cannot be written.
    Audit { path: PathBuf, cause: io::Error },
    /// The server will stop when the open sessions have ended.
    Ending,
    /// The server ends all connections.
    ShuttingDown,
    /// An episode or a twin refused it.
    Session(SessionError),
    /// The push was refused, or failed.
    Push(PushError),
    /// A defect of the program.
    Internal(String),
}

/// What a client is told of a fault.
#[derive(Debug)]
pub(crate) struct Report {
    /// The status of an HTTP answer.
    pub(crate) status: StatusCode,
    /// Code, text and field at fault: the body of an HTTP answer.
    pub(crate) body: Refusal,
}

/// The content of a Close frame (RFC 6455, section 7.4).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct CloseStatus {
    pub(crate) code: u16,
    /// At most 123 bytes.
    pub(crate) reason: String,
}

/// The text of a code, as the wire has it.
#[derive(Clone, Debug)]
pub(crate) struct WireCode(pub(crate) String);

impl Fault {
    /// The table of faults: code, field and text of each.
    pub(crate) fn report(&self) -> Report {
        match self {
            Self::MalformedJson(cause) => plain(Code::MalformedJson, format!("not JSON: {cause}")),
            Self::InvalidRequest { field, reason } => {
                let place = (Code::InvalidRequest, field.clone());
                Report::new(place, format!("not a request: {reason}"))
            }
            Self::UnexpectedBinary => plain(
                Code::UnexpectedBinary,
                "requests are JSON text frames; only the server sends binary ones",
            ),
            Self::MessageTooLarge { bytes, limit } => plain(
                Code::MessageTooLarge,
                format!("a message of {bytes} bytes; at most {limit} are accepted"),
            ),
            Self::Unfinished => plain(
                Code::Busy,
                "clients have begun too many long messages: try again when those have ended",
            ),
            Self::BrokenFrame(cause) => {
                plain(Code::MalformedJson, format!("not WebSocket: {cause}"))
            }
            Self::NotUtf8 => plain(Code::MalformedJson, "a text message is not valid UTF-8"),
            Self::SeqOutOfOrder { field, seq, expected } => {
                at(Code::SeqOutOfOrder, *field, format!("{field} is {seq}; {expected}"))
            }
            Self::WrongOrder(reason) => at(Code::WrongOrder, "type", *reason),
            Self::UnsupportedProtocol { server, offered } => at(
                Code::UnsupportedProtocol,
                "protocols",
                format!("this server speaks {server}; the client offers {}", offered.join(", ")),
            ),
            Self::SessionState(reason) => at(Code::SessionState, "type", *reason),
            Self::UnknownSession { field, name } => at(
                Code::UnknownSession,
                field,
                format!(
                    "there is no session {name:?} to resume: it ended, was never opened, or the server was \
                     restarted; branch from {{\"episode\": \"{name}-1\", \"step\": N}} goes on from its record"
                ),
            ),
            Self::NoSuchSession { field, name } => at(
                Code::UnknownSession,
                *field,
                format!(
                    "there is no session {name:?} of this token; it ended, or was never opened"
                ),
            ),
            Self::NotOnConnection { name, open } => {
                // An empty list would end the sentence with nothing.
                let has = if open.is_empty() { "none".to_owned() } else { open.join(", ") };
                let text = format!("this connection has no session {name:?}; it has {has}");
                at(Code::UnknownSession, "session", text)
            }
            Self::SessionTwice { field, name } => at(
                Code::InvalidName,
                field,
                format!("{field}: the session {name:?} is in the list already"),
            ),
            Self::OtherConnection { field, name, seq } => at(
                Code::SeqOutOfOrder,
                field,
                format!(
                    "{field}: the session {name:?} was not on the connection of the first: its \
                     last request was {seq}"
                ),
            ),
            Self::UnknownTrajectory { field, name, known } => at(
                Code::UnknownTrajectory,
                field,
                format!("the twin has no trajectory {name:?}; it has {}", known.join(", ")),
            ),
            Self::SessionExists { name } => at(
                Code::SessionExists,
                "session",
                format!("there is a session {name:?} already; resume it, or choose another name"),
            ),
            Self::InvalidName { field, name } => at(
                Code::InvalidName,
                field,
                format!(
                    "{name:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not \
                     start with ."
                ),
            ),
            Self::Pose { field, cause } => at(
                pose_code(cause),
                format!("{field}.{}", cause.field()),
                format!("{field}: {cause}"),
            ),
            Self::PoseNotFinite { field } => at(
                Code::PoseNotFinite,
                field,
                format!("{field} is not finite; a pose needs finite numbers"),
            ),
            Self::Busy { what, limit } => {
                plain(Code::Busy, format!("there are {limit} {what} already; try again later"))
            }
            Self::TimedOut(what) => plain(Code::TimedOut, format!("no {what} came in time")),
            Self::Replaced => {
                plain(Code::SessionState, "the session was resumed by another connection")
            }
            Self::Unauthorized => at(
                Code::Unauthorized,
                "authorization",
                "the request has no valid token: send Authorization: Bearer TOKEN",
            ),
            Self::UnknownTicket => at(
                Code::Unauthorized,
                "ticket",
                "the ticket was used already, is older than 30 s, or was never issued: \
                 POST /v1/tickets",
            ),
            Self::NothingToWatch { name } => at(
                Code::UnknownSession,
                "session",
                format!(
                    "there is no session {name:?} of this token to watch; GET /v1/sessions lists \
                     them"
                ),
            ),
            Self::SessionEnded => plain(Code::UnknownSession, "the session ended"),
            Self::WatcherSent => plain(Code::InvalidRequest, "a watcher sends nothing"),
            Self::NoEpisode { name } => at(
                Code::UnknownState,
                "episode",
                format!("there is no recorded episode {name:?}; GET /v1/episodes lists them"),
            ),
            Self::NoMcap { name, reason } => at(
                Code::UnknownState,
                "episode",
                format!(
                    "episode {name:?} has no MCAP file: {reason}; `wildcity episode export {name}` \
                     makes one of its record"
                ),
            ),
            Self::Forbidden { field, reason } => {
                at(Code::Forbidden, *field, format!("this token may not do that: {reason}"))
            }
            Self::ForbiddenHost { host, served } => at(
                Code::Forbidden,
                "host",
                format!(
                    "the host name {host:?} is not accepted, only {served}; to add it, start the \
                     server with --origin https://NAME"
                ),
            ),
            Self::HeaderTwice { header } => at(
                Code::InvalidRequest,
                *header,
                format!("the header {header} is there more than once"),
            ),
            Self::ForbiddenOrigin { origin } => at(
                Code::Forbidden,
                "origin",
                format!(
                    "pages from {origin} are refused; only those of this machine and of --origin \
                     are accepted"
                ),
            ),
            // HTTP has a status of its own for this one, for `NoRoute` and for `NoMethod`.
            Self::NoUpgrade => at(
                Code::InvalidRequest,
                "upgrade",
                "this address is a WebSocket: send an upgrade (RFC 6455)",
            )
            .with_status(StatusCode::UPGRADE_REQUIRED),
            Self::Handshake { header, must } => {
                at(Code::InvalidRequest, *header, format!("the header {header} {must}"))
            }
            Self::NoSubprotocol { protocol } => at(
                Code::UnsupportedProtocol,
                "sec-websocket-protocol",
                format!("offer the subprotocol {protocol} in the header sec-websocket-protocol"),
            ),
            Self::NoSharedMemory { field, reason } => {
                at(Code::SharedMemoryUnavailable, *field, format!("no shared memory: {reason}"))
            }
            Self::NoRoute { path } => plain(
                Code::InvalidRequest,
                format!("there is no {path}; protocol/README.md lists the routes"),
            )
            .with_status(StatusCode::NOT_FOUND),
            Self::NoMethod { method, path } => plain(
                Code::InvalidRequest,
                format!("{path} has no method {method}; protocol/README.md lists the routes"),
            )
            .with_status(StatusCode::METHOD_NOT_ALLOWED),
            Self::UnknownUpload { id, field } => Report::new(
                (Code::UnknownUpload, field.clone()),
                format!(
                    "there is no upload {id:?}: it was never begun, did not match its digest, or \
                     is too old"
                ),
            ),
            Self::UploadOffset { given, held } => {
                let mut report = at(
                    Code::UploadOffset,
                    "upload-offset",
                    format!(
                        "the upload has {held} bytes, Upload-Offset is {given}: go on from {held}"
                    ),
                );
                // With the offset the client continues at once, without asking for it.
                report.body.offset = Some(*held);
                report
            }
            Self::UploadDigest { what, promised, found } => plain(
                Code::UploadDigest,
                format!("{what} is {found}, but {promised} was promised: send it again"),
            ),
            Self::StorageFull { reason } => {
                plain(Code::StorageFull, format!("no room for the upload: {reason}"))
            }
            Self::NoUploads { reason } => {
                plain(Code::Busy, format!("this server takes no uploads: {reason}"))
            }
            Self::OutOfRange { field, must } => {
                at(Code::OutOfRange, field, format!("{field} is {must}"))
            }
            Self::SpoolRead { cause } => {
                plain(Code::Internal, format!("cannot read the spool: {cause}"))
            }
            Self::SpoolWrite { cause } => {
                plain(Code::Internal, format!("cannot write to the spool: {cause}"))
            }
            Self::Audit { path, cause } => {
                // A full disk is for the operator to mend, and the client may try again later; it
                // is no defect.
                let code = if is_full(cause) { Code::StorageFull } else { Code::Internal };
                let path = path.display();
                plain(
                    code,
                    format!(
                        "the audit log {path} cannot be written, so nothing is changed: {cause}"
                    ),
                )
            }
            Self::Ending => plain(
                Code::ShuttingDown,
                "the server stops when its sessions have ended, and opens no new one: use another server, or open it \
                 when this one is back",
            ),
            Self::ShuttingDown => plain(
                Code::ShuttingDown,
                "the server is shutting down, and its sessions end: open a new one when it is back",
            ),
            Self::Session(error) => {
                let mut report = Report::new(session_place(error), error.to_string());
                report.body.cells = cells_of_session(error).to_vec();
                report
            }
            Self::Push(error) => Report::from_push(error),
            Self::Internal(reason) => plain(Code::Internal, format!("internal: {reason}")),
        }
    }

    /// Whether the connection must be closed after this fault.
    pub(crate) fn is_fatal(&self) -> bool {
        matches!(
            self,
            // After the first four the position in the stream of bytes is unknown, so that no
            // further message can be read. After the others the connection has no use.
            Self::MessageTooLarge { .. }
                | Self::Unfinished
                | Self::BrokenFrame(_)
                | Self::NotUtf8
                | Self::TimedOut(_)
                | Self::Replaced
                | Self::ShuttingDown
        )
    }

    /// The Close frame after a fault that ends the connection (RFC 6455, section 7.4.1).
    pub(crate) fn close_status(&self) -> CloseStatus {
        let code = match self {
            Self::SessionEnded => 1000,
            Self::ShuttingDown => 1001,
            Self::BrokenFrame(_) => 1002,
            Self::NotUtf8 => 1007,
            Self::MessageTooLarge { .. } => 1009,
            Self::Busy { .. } | Self::Unfinished => 1013,
            Self::Internal(_) => 1011,
            // Another connection has the session, or the client was silent: the policy of this
            // server.
            _ => 1008,
        };
        CloseStatus { code, reason: self.report().code().0 }
    }

    /// The message that refuses a request over WebSocket.
    pub(crate) fn answer(&self, seq: Option<u64>) -> String {
        let Refusal { code, message, field, .. } = self.report().body;
        let answer = Answer::Error { seq, code, message, field, fatal: self.is_fatal() };
        // An error of strings and flags always has JSON.
        serde_json::to_string(&answer).unwrap_or_default()
    }
}

impl Report {
    fn new((code, field): (Code, Option<String>), message: impl Into<String>) -> Self {
        let message = message.into();
        let body = Refusal { code, message, field, cells: Vec::new(), offset: None };
        Self { status: status(code), body }
    }

    /// The report of a push that was refused or failed.
    pub(crate) fn from_push(error: &PushError) -> Self {
        let mut report = Self::new(push_place(error), error.to_string());
        report.body.cells = cells_of_push(error).to_vec();
        report
    }

    fn with_status(self, status: StatusCode) -> Self {
        Self { status, ..self }
    }

    /// The text of the code. It is that of the protocol's own serializer, so that both agree.
    pub(crate) fn code(&self) -> WireCode {
        let code = serde_json::to_value(self.body.code);
        WireCode(code.ok().and_then(|code| code.as_str().map(str::to_owned)).unwrap_or_default())
    }

    /// The body of an HTTP answer that refuses.
    pub(crate) fn json(&self) -> Value {
        json!(self.body)
    }
}

impl Display for Fault {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(&self.report().body.message)
    }
}

impl From<SessionError> for Fault {
    fn from(error: SessionError) -> Self {
        Self::Session(error)
    }
}

impl From<PushError> for Fault {
    fn from(error: PushError) -> Self {
        Self::Push(error)
    }
}

impl From<StoreError> for Fault {
    fn from(error: StoreError) -> Self {
        Self::Session(error.into())
    }
}

/// A report without a field.
fn plain(code: Code, message: impl Into<String>) -> Report {
    Report::new((code, None), message)
}

/// A report with the field at fault.
fn at(code: Code, field: impl Into<String>, message: impl Into<String>) -> Report {
    Report::new((code, Some(field.into())), message)
}

/// Whether an error means that a disk, or a user's quota of it, is full.
pub(crate) fn is_full(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

/// The HTTP status of a code. Codes that only occur over WebSocket have a status as well, so that a
/// new HTTP route can answer with any code.
fn status(code: Code) -> StatusCode {
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

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;
    use wildcity_render::RenderError;
    use wildcity_scene::RecordFormat;
    use wildcity_session::RecordError;

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
            let report = fault.report();
            assert_eq!((report.body.code, report.status.as_u16()), (code, status), "{fault}");
        }
    }

    /// A folder of records that takes nothing is, to a client, a full disk.
    #[test]
    fn a_record_that_cannot_be_written_is_refused_as_on_a_full_disk() {
        for (kind, code) in [
            (io::ErrorKind::StorageFull, Code::StorageFull),
            (io::ErrorKind::ReadOnlyFilesystem, Code::StorageFull),
            (io::ErrorKind::PermissionDenied, Code::StorageFull),
            (io::ErrorKind::NotFound, Code::Internal),
        ] {
            let error = RecordError { path: "episodes/a-1.jsonl".into(), cause: kind.into() };
            let report = Fault::Session(error.into()).report();
            assert_eq!(report.body.code, code, "{kind}");
        }
    }

    #[test]
    fn a_scene_that_a_device_has_no_room_for_may_be_tried_again() {
        let error = RenderError::DeviceMemory { needed_bytes: 2 << 30, limit_bytes: 1 << 30 };
        let fault = Fault::Session(error.into());
        let Refusal { code, field, .. } = fault.report().body;
        assert_eq!((code, field.as_deref()), (Code::Busy, Some("twin")));
        assert!(fault.to_string().contains("2147483648"), "{fault}");
    }

    /// The protocol's page has the same codes with the same status, and no other.
    #[test]
    fn the_page_of_the_protocol_has_the_same_table() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../protocol/README.md");
        let page = std::fs::read_to_string(path).unwrap();
        let section = page
            .split("\n## Errors")
            .nth(1)
            .expect("a section on errors")
            .split("\n## ")
            .next()
            .expect("split gives at least one part");
        // The codes of the page are compared with those of the type, both sorted: neither may have
        // one more.
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
            table.push((name, super::status(code).as_u16()));
        }
        table.sort();
        assert_eq!(rows, table);
    }
}
