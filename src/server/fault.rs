//! What a request, or a whole connection, can be refused for. `convert` gives each its wire code.

use std::io;

use wildcity_scene::appearance::AppearanceError;
use wildcity_scene::geometry::{CameraError, PoseError};
use wildcity_scene::rig::RigError;
use wildcity_session::SessionError;
use wildcity_twin::ingest::IngestError;
use wildcity_twin::store::StoreError;

/// Why a request was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
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
    /// More bytes than a request may have.
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
    /// A number was left out, or comes again too late.
    #[error("seq is {seq}; {expected}")]
    SeqOutOfOrder {
        /// The number given.
        seq: u64,
        /// The numbers accepted.
        expected: String,
    },
    /// Before `hello`, or a second one.
    #[error("{0}")]
    WrongOrder(&'static str),
    /// No common version.
    #[error("this server speaks {server}; the client offers {}", offered.join(", "))]
    UnsupportedProtocol {
        /// What the server speaks.
        server: &'static str,
        /// What the client speaks.
        offered: Vec<String>,
    },
    /// A session is open, or none.
    #[error("{0}")]
    SessionState(&'static str),
    /// Nothing to resume.
    #[error("there is no session {name:?} to resume; it ended, or was never opened")]
    UnknownSession {
        /// The name asked for.
        name: String,
    },
    /// The name is taken.
    #[error("there is a session {name:?} already; resume it, or choose another name")]
    SessionExists {
        /// The name asked for.
        name: String,
    },
    /// Not a name.
    #[error("{name:?} is not a name: 1 to 64 of a-z 0-9 . _ - are, not starting with .")]
    InvalidName {
        /// The field.
        field: String,
        /// The refused text.
        name: String,
    },
    /// Not a pose.
    #[error("{field}: {cause}")]
    Pose {
        /// The pose, as `poses[3]`.
        field: String,
        /// What is wrong with it.
        cause: PoseError,
    },
    /// NaN or infinity where JSON has no number.
    #[error("{field} is not finite; poses and actions need finite numbers")]
    NotFinite {
        /// The number, as `pose.xyz[0]`.
        field: String,
    },
    /// Not a camera.
    #[error("{field}: {cause}")]
    Camera {
        /// The camera, as `rig.cameras[2]`.
        field: String,
        /// What is wrong with it.
        cause: CameraError,
    },
    /// Not what a camera makes of an image.
    #[error("{field}: {cause}")]
    Appearance {
        /// The field, as `rig.cameras[2].overlay`.
        field: String,
        /// What is wrong with it.
        cause: AppearanceError,
    },
    /// Not a rig.
    #[error("{cause}")]
    Rig {
        /// The field.
        field: String,
        /// What is wrong with it.
        cause: RigError,
    },
    /// Too much at once.
    #[error("there are {limit} {what} already; try again later")]
    Busy {
        /// Of what.
        what: &'static str,
        /// How many there are.
        limit: usize,
    },
    /// Silent for too long.
    #[error("no {0} came in time")]
    TimedOut(&'static str),
    /// Somebody resumed the session elsewhere.
    #[error("the session was resumed by another connection")]
    Replaced,
    /// No token, or one that is not known.
    #[error("a token is needed that this server knows: send Authorization: Bearer TOKEN")]
    Unauthorized,
    /// The token allows less.
    #[error("this token may not do that: {reason}")]
    Forbidden {
        /// What it lacks.
        reason: String,
    },
    /// Nothing to append to.
    #[error("there is no upload {id:?}: it was never begun, did not fit its digest, or is too old")]
    UnknownUpload {
        /// The id asked for.
        id: String,
    },
    /// Bytes for another place.
    #[error("the upload has {held} bytes, Upload-Offset is {given}: go on from {held}")]
    UploadOffset {
        /// The offset given.
        given: u64,
        /// Where it goes on.
        held: u64,
    },
    /// Not what was announced.
    #[error("{what} is {found}, but {promised} was promised: send it again")]
    UploadDigest {
        /// The digest of what, or its size.
        what: &'static str,
        /// As announced.
        promised: String,
        /// As it came.
        found: String,
    },
    /// No room.
    #[error("no room for the upload: {reason}")]
    StorageFull {
        /// What is full.
        reason: String,
    },
    /// This server keeps none.
    #[error("this server takes no uploads: {reason}")]
    NoUploads {
        /// Why not.
        reason: String,
    },
    /// Nothing to tell.
    #[error("there is no push {id:?} of twin {twin:?} any more; send it again")]
    UnknownPush {
        /// The id asked for.
        id: String,
        /// The twin.
        twin: String,
    },
    /// The push's content cannot be accepted.
    #[error("{reason}")]
    Content {
        /// Why not.
        reason: String,
        /// The cells at fault, if cells are.
        cells: Vec<[i32; 2]>,
    },
    /// A field of a body is outside its limits.
    #[error("{field} is {must}")]
    OutOfRange {
        /// The field.
        field: String,
        /// What it is, and what is accepted.
        must: String,
    },
    /// The disk.
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
    /// Whether what was pushed is at fault, or the base that it was made from: the same again would
    /// be refused again. Everything else may pass.
    pub(super) fn is_content(&self) -> bool {
        match self {
            Self::Content { .. } | Self::OutOfRange { .. } => true,
            Self::Session(SessionError::Twin(StoreError::Overlap { .. })) => true,
            Self::Session(SessionError::Twin(error)) => is_content(error),
            _ => false,
        }
    }

    /// Whether the connection cannot go on.
    pub(super) fn is_fatal(&self) -> bool {
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

/// Whether a commit was refused for what it holds.
pub(super) fn is_content(error: &StoreError) -> bool {
    match error {
        StoreError::Gaussians(error) => !matches!(error, IngestError::File(_)),
        StoreError::Clamped { .. }
        | StoreError::Profile(_)
        | StoreError::FieldMismatch { .. }
        | StoreError::ManifestSize { .. } => true,
        _ => false,
    }
}

/// Whether a disk, or what somebody may have of it, is full.
pub(super) fn is_full(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
