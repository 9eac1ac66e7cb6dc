//! What a request, or a whole connection, can be refused for. `convert` gives each its wire code.

use crate::geometry::{CameraError, PoseError};
use crate::scene::rig::RigError;
use crate::session::SessionError;

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
    #[error("{field} is not finite; a pose needs finite numbers")]
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

impl Fault {
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
