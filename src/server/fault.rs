//! Why a request or a connection was refused. `convert::fault` gives each fault its wire code and
//! its HTTP status.

use std::io;
use std::path::PathBuf;

use wildcity_push::PushError;
use wildcity_scene::appearance::AppearanceError;
use wildcity_scene::geometry::{CameraError, PoseError};
use wildcity_scene::rig::RigError;
use wildcity_session::SessionError;
use wildcity_twin::store::StoreError;

/// Why a request or a connection was refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Fault {
    #[error("not JSON: {0}")]
    MalformedJson(String),
    /// JSON, but not a request.
    #[error("not a request: {reason}")]
    InvalidRequest {
        /// The field at fault, for example `rig.cameras[2].width`, if any.
        field: Option<String>,
        reason: String,
    },
    #[error("requests are JSON text frames; only the server sends binary ones")]
    UnexpectedBinary,
    /// A message has more bytes than a request may have.
    #[error("a message of {bytes} bytes; at most {limit} are accepted")]
    MessageTooLarge { bytes: usize, limit: usize },
    /// The bytes are not WebSocket.
    #[error("not WebSocket: {0}")]
    BrokenFrame(String),
    /// A text message, or the reason of a Close frame, is not UTF-8.
    #[error("a text message is not valid UTF-8")]
    NotUtf8,
    /// The request's number is neither the next one nor a repeated one.
    #[error("{field} is {seq}; {expected}")]
    SeqOutOfOrder {
        /// `seq` or `last_seq`.
        field: &'static str,
        seq: u64,
        expected: String,
    },
    /// A request before `hello`, or a second `hello`.
    #[error("{0}")]
    WrongOrder(&'static str),
    /// Server and client have no protocol version in common.
    #[error("this server speaks {server}; the client offers {}", offered.join(", "))]
    UnsupportedProtocol { server: &'static str, offered: Vec<String> },
    /// The connection already has an open session, or it has none although the request needs one.
    #[error("{0}")]
    SessionState(&'static str),
    /// There is no session to resume.
    #[error("there is no session {name:?} to resume; it ended, or was never opened")]
    UnknownSession {
        /// The field of the request that names it.
        field: String,
        /// The name asked for.
        name: String,
    },
    /// There is no session of this name from which another one could be opened.
    #[error("there is no session {name:?} of this token; it ended, or was never opened")]
    NoSuchSession {
        /// The field of the request that names it.
        field: &'static str,
        /// The name asked for.
        name: String,
    },
    /// The connection does not have that session.
    #[error("this connection has no session {name:?}; it has {}", list(open))]
    NotOnConnection {
        /// The name asked for.
        name: String,
        /// The names of its sessions.
        open: Vec<String>,
    },
    /// A list names a session twice.
    #[error("{field}: the session {name:?} is in the list already")]
    SessionTwice { field: String, name: String },
    /// The sessions to resume together did not belong to one connection.
    #[error(
        "{field}: the session {name:?} was not on the connection of the first: its last request was {seq}"
    )]
    OtherConnection {
        /// The field of the request that names it.
        field: String,
        /// The name asked for.
        name: String,
        /// Number of its last request.
        seq: u64,
    },
    /// The twin has no trajectory of this name.
    #[error("the twin has no trajectory {name:?}; it has {}", known.join(", "))]
    UnknownTrajectory {
        /// The field of the request that names it.
        field: String,
        /// The name asked for.
        name: String,
        /// The names of the twin's trajectories.
        known: Vec<String>,
    },
    /// Another session has the name.
    #[error("there is a session {name:?} already; resume it, or choose another name")]
    SessionExists {
        /// The name asked for.
        name: String,
    },
    /// A text is not a name.
    #[error(
        "{name:?} is not a name: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    InvalidName { field: String, name: String },
    /// The numbers of a pose are invalid.
    #[error("{field}: {cause}")]
    Pose {
        /// The pose, as `poses[3]`.
        field: String,
        cause: PoseError,
    },
    /// NaN or infinity in a pose, which JSON cannot express.
    #[error("{field} is not finite; a pose needs finite numbers")]
    PoseNotFinite {
        /// The number, as `pose.xyz[0]`.
        field: String,
    },
    /// The numbers of a camera are invalid.
    #[error("{field}: {cause}")]
    Camera {
        /// The camera, as `rig.cameras[2]`.
        field: String,
        cause: CameraError,
    },
    /// The exposure or the overlay of a camera cannot be used.
    #[error("{field}: {cause}")]
    Appearance {
        /// The field, as `rig.cameras[2].overlay`.
        field: String,
        cause: AppearanceError,
    },
    /// The cameras do not form a valid rig.
    #[error("{cause}")]
    Rig { field: String, cause: RigError },
    /// A count has reached its maximum.
    #[error("there are {limit} {what} already; try again later")]
    Busy {
        /// Name of the counted objects.
        what: &'static str,
        limit: usize,
    },
    /// The client was silent for too long.
    #[error("no {0} came in time")]
    TimedOut(&'static str),
    /// Another connection took over the session or the upload.
    #[error("the session was resumed by another connection")]
    Replaced,
    /// The request has no token, or an unknown one.
    #[error("the request has no valid token: send Authorization: Bearer TOKEN")]
    Unauthorized,
    /// The ticket is invalid.
    #[error(
        "the ticket was used already, is older than 30 s, or was never issued: POST /v1/tickets"
    )]
    UnknownTicket,
    /// There is no such session to watch, or it belongs to another token.
    #[error("there is no session {name:?} of this token to watch; GET /v1/sessions lists them")]
    NothingToWatch {
        /// The name asked for.
        name: String,
    },
    /// The watched session ended.
    #[error("the session ended")]
    SessionEnded,
    /// A watcher sent something.
    #[error("a watcher sends nothing")]
    WatcherSent,
    /// There is no recorded episode of this name.
    #[error("there is no recorded episode {name:?}; GET /v1/episodes lists them")]
    NoEpisode {
        /// The name asked for.
        name: String,
    },
    /// The episode has no MCAP file.
    #[error(
        "episode {name:?} has no MCAP file: {reason}; `wildcity episode export {name}` makes one of its record"
    )]
    NoMcap {
        /// The name of the episode.
        name: String,
        reason: String,
    },
    /// The token's role or twins do not allow the request.
    #[error("this token may not do that: {reason}")]
    Forbidden {
        /// The field or header that decides it.
        field: &'static str,
        reason: String,
    },
    /// The request's host name is not one of the server's names.
    #[error(
        "the host name {host:?} is not accepted, only {served}; to add it, start the server with --origin \
         https://NAME"
    )]
    ForbiddenHost {
        /// The header `Host`.
        host: String,
        /// The names that are accepted.
        served: &'static str,
    },
    /// A header that is allowed once occurs more than once.
    #[error("the header {header} is there more than once")]
    HeaderTwice { header: &'static str },
    /// A web page of another machine sent the request.
    #[error(
        "pages from {origin} are refused; only those of this machine and of --origin are accepted"
    )]
    ForbiddenOrigin {
        /// The header `Origin`.
        origin: String,
    },
    /// The address of sessions was requested without an upgrade.
    #[error("this address is a WebSocket: send an upgrade (RFC 6455)")]
    NoUpgrade,
    /// A header of the WebSocket handshake is wrong.
    #[error("the header {header} {must}")]
    Handshake { header: &'static str, must: &'static str },
    /// The handshake does not offer the protocol's name.
    #[error("offer the subprotocol {protocol} in the header sec-websocket-protocol")]
    NoSubprotocol { protocol: &'static str },
    /// The client cannot have observations in shared memory.
    #[error("no shared memory: {reason}")]
    NoSharedMemory {
        /// The field at fault.
        field: &'static str,
        /// The reason, and the remedy.
        reason: String,
    },
    /// There is no route of this path.
    #[error("there is no {path}; protocol/README.md lists the routes")]
    NoRoute { path: String },
    /// The route does not have this method.
    #[error("{path} has no method {method}; protocol/README.md lists the routes")]
    NoMethod { method: String, path: String },
    /// There is no upload of this id.
    #[error(
        "there is no upload {id:?}: it was never begun, did not match its digest, or is too old"
    )]
    UnknownUpload {
        /// The id asked for.
        id: String,
        /// The field of the body that has it, if any.
        field: Option<String>,
    },
    /// The bytes do not continue the upload.
    #[error("the upload has {held} bytes, Upload-Offset is {given}: go on from {held}")]
    UploadOffset {
        given: u64,
        /// The offset at which the upload continues.
        held: u64,
    },
    /// An upload differs from its announcement.
    #[error("{what} is {found}, but {promised} was promised: send it again")]
    UploadDigest {
        /// The digest or size that differs.
        what: &'static str,
        promised: String,
        found: String,
    },
    /// The disk or the space for uploads is full.
    #[error("no room for the upload: {reason}")]
    StorageFull {
        /// The resource that is full.
        reason: String,
    },
    /// This server has no directory for uploads.
    #[error("this server takes no uploads: {reason}")]
    NoUploads { reason: String },
    /// A field of a body is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        field: String,
        /// Its value, and what is accepted.
        must: String,
    },
    /// A file of the spool cannot be read now; a repetition may succeed.
    #[error("cannot read the spool: {cause}")]
    SpoolRead {
        /// The operating system's error.
        cause: io::Error,
    },
    /// A file of the spool cannot be written.
    #[error("cannot write to the spool: {cause}")]
    SpoolWrite {
        /// The operating system's error.
        cause: io::Error,
    },
    /// The audit log cannot be written.
    #[error(
        "the audit log {} cannot be written, so nothing is changed: {cause}",
        path.display()
    )]
    Audit {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    #[error("the server is shutting down, and its sessions end: open a new one when it is back")]
    ShuttingDown,
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The push was refused, or failed.
    #[error(transparent)]
    Push(#[from] PushError),
    /// A defect of the program.
    #[error("internal: {0}")]
    Internal(String),
}

impl From<StoreError> for Fault {
    fn from(error: StoreError) -> Self {
        Self::Session(error.into())
    }
}

impl Fault {
    /// Whether the connection must be closed after this fault.
    pub(crate) fn is_fatal(&self) -> bool {
        matches!(
            self,
            // After the first three the position in the stream of bytes is unknown, so that no
            // further message can be read. After the others the connection has no use.
            Self::MessageTooLarge { .. }
                | Self::BrokenFrame(_)
                | Self::NotUtf8
                | Self::TimedOut(_)
                | Self::Replaced
                | Self::ShuttingDown
        )
    }
}

fn list(names: &[String]) -> String {
    match names {
        // An empty list would end the sentence with nothing.
        [] => "none".to_owned(),
        names => names.join(", "),
    }
}

/// Whether an error means that a disk, or a user's quota of it, is full.
pub(crate) fn is_full(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
