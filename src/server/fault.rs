//! Why a request or a connection was refused. `convert::fault` gives each fault its wire code and its
//! HTTP status.

use std::io;

use wildcity_push::PushError;
use wildcity_scene::appearance::AppearanceError;
use wildcity_scene::geometry::{CameraError, PoseError};
use wildcity_scene::rig::RigError;
use wildcity_session::SessionError;
use wildcity_twin::store::StoreError;

/// Why a request or a connection was refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Fault {
    /// Not JSON.
    #[error("not JSON: {0}")]
    MalformedJson(String),
    /// JSON, but not a request.
    #[error("not a request: {reason}")]
    InvalidRequest {
        /// The field at fault, as `rig.cameras[2].width`, if one is.
        field: Option<String>,
        /// What is wrong.
        reason: String,
    },
    /// A binary message.
    #[error("requests are JSON text frames; only the server sends binary ones")]
    UnexpectedBinary,
    /// A message has more bytes than a request may have.
    #[error("a message of {bytes} bytes; at most {limit} are accepted")]
    MessageTooLarge {
        /// Bytes announced.
        bytes: usize,
        /// Bytes accepted.
        limit: usize,
    },
    /// The bytes are not WebSocket.
    #[error("not WebSocket: {0}")]
    BrokenFrame(String),
    /// The request's number is neither the next one nor a repeated one.
    #[error("seq is {seq}; {expected}")]
    SeqOutOfOrder {
        /// The number given.
        seq: u64,
        /// The numbers accepted.
        expected: String,
    },
    /// A request before `hello`, or a second `hello`.
    #[error("{0}")]
    WrongOrder(&'static str),
    /// Server and client have no protocol version in common.
    #[error("this server speaks {server}; the client offers {}", offered.join(", "))]
    UnsupportedProtocol {
        /// The server's version.
        server: &'static str,
        /// The client's versions.
        offered: Vec<String>,
    },
    /// The connection already has an open session, or it has none although the request needs one.
    #[error("{0}")]
    SessionState(&'static str),
    /// There is no session to resume.
    #[error("there is no session {name:?} to resume; it ended, or was never opened")]
    UnknownSession {
        /// The name asked for.
        name: String,
    },
    /// There is no recorded episode of this name.
    #[error("there is no recorded episode {name:?}; `GET /v1/episodes` lists them")]
    UnknownEpisode {
        /// The name asked for.
        name: String,
    },
    /// There is no session of that name to open another one from.
    #[error("there is no session {name:?} of this token; it ended, or was never opened")]
    NoSuchSession {
        /// The field of the request that names it.
        field: &'static str,
        /// The name asked for.
        name: String,
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
    InvalidName {
        /// The field.
        field: String,
        /// The refused text.
        name: String,
    },
    /// The numbers of a pose are invalid.
    #[error("{field}: {cause}")]
    Pose {
        /// The pose, as `poses[3]`.
        field: String,
        /// What is wrong with it.
        cause: PoseError,
    },
    /// NaN or infinity, which JSON cannot express.
    #[error("{field} is not finite; poses and actions need finite numbers")]
    NotFinite {
        /// The number, as `pose.xyz[0]`.
        field: String,
    },
    /// The numbers of a camera are invalid.
    #[error("{field}: {cause}")]
    Camera {
        /// The camera, as `rig.cameras[2]`.
        field: String,
        /// What is wrong with it.
        cause: CameraError,
    },
    /// The exposure or the overlay of a camera cannot be used.
    #[error("{field}: {cause}")]
    Appearance {
        /// The field, as `rig.cameras[2].overlay`.
        field: String,
        /// What is wrong with it.
        cause: AppearanceError,
    },
    /// The cameras do not form a valid rig.
    #[error("{cause}")]
    Rig {
        /// The field.
        field: String,
        /// What is wrong with it.
        cause: RigError,
    },
    /// A count has reached its maximum.
    #[error("there are {limit} {what} already; try again later")]
    Busy {
        /// What is counted.
        what: &'static str,
        /// The maximum.
        limit: usize,
    },
    /// The client was silent for too long.
    #[error("no {0} came in time")]
    TimedOut(&'static str),
    /// Another connection took over the session or the upload.
    #[error("the session was resumed by another connection")]
    Replaced,
    /// The request has no token, or one that the server does not know.
    #[error("a token is needed that this server knows: send Authorization: Bearer TOKEN")]
    Unauthorized,
    /// The token's role or twins do not allow the request.
    #[error("this token may not do that: {reason}")]
    Forbidden {
        /// What it lacks.
        reason: String,
    },
    /// There is no upload of this id.
    #[error(
        "there is no upload {id:?}: it was never begun, did not match its digest, or is too old"
    )]
    UnknownUpload {
        /// The id asked for.
        id: String,
    },
    /// The bytes do not continue the upload.
    #[error("the upload has {held} bytes, Upload-Offset is {given}: go on from {held}")]
    UploadOffset {
        /// The offset given.
        given: u64,
        /// The offset at which the upload continues.
        held: u64,
    },
    /// An upload is not what was announced.
    #[error("{what} is {found}, but {promised} was promised: send it again")]
    UploadDigest {
        /// The digest or size that differs.
        what: &'static str,
        /// As announced.
        promised: String,
        /// As received.
        found: String,
    },
    /// The disk or the space for uploads is full.
    #[error("no room for the upload: {reason}")]
    StorageFull {
        /// What is full.
        reason: String,
    },
    /// This server has no directory for uploads.
    #[error("this server takes no uploads: {reason}")]
    NoUploads {
        /// Why not.
        reason: String,
    },
    /// A field of a body is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        /// The field.
        field: String,
        /// Its value, and what is accepted.
        must: String,
    },
    /// A file of the spool cannot be read or written.
    #[error("cannot {action} the spool: {cause}")]
    Spool {
        /// What was tried.
        action: &'static str,
        /// What the operating system says.
        cause: io::Error,
    },
    /// The server stops.
    #[error("the server is shutting down; resume or start again when it is back")]
    ShuttingDown,
    /// The session refused.
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
            Self::MessageTooLarge { .. }
                | Self::BrokenFrame(_)
                | Self::TimedOut(_)
                | Self::Replaced
                | Self::ShuttingDown
        )
    }
}

/// Whether an error says that a disk, or a user's quota of it, is full.
pub(crate) fn is_full(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
