//! The closed list of error codes.

use serde::{Deserialize, Serialize};

/// What went wrong. The list is closed: a new code is a new protocol version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Code {
    /// The text frame is not JSON, or is nested too deeply.
    MalformedJson,
    /// The JSON is not a request: unknown type, missing, unknown or mistyped field.
    InvalidRequest,
    /// A binary frame from the client; only the server sends those.
    UnexpectedBinary,
    /// The message is larger than `limits.message_bytes`.
    MessageTooLarge,
    /// `seq` is not the next number, nor the last one repeated.
    SeqOutOfOrder,
    /// The request needs a `hello` first, or comes a second time.
    WrongOrder,
    /// No common protocol version.
    UnsupportedProtocol,
    /// A session is open already on this connection, or none is.
    SessionState,
    /// There is no twin of this name.
    UnknownTwin,
    /// The twin has no such version.
    UnknownVersion,
    /// The twin could not be loaded.
    TwinDamaged,
    /// There is no rig preset of this name.
    UnknownRig,
    /// The rig has no camera of this name.
    UnknownCamera,
    /// The twin has no trajectory of this name.
    UnknownTrajectory,
    /// There is no session of this name to resume.
    UnknownSession,
    /// A session of this name exists already.
    SessionExists,
    /// A name is not 1 to 64 of `[a-z0-9._-]`.
    InvalidName,
    /// A component of a pose is NaN or infinite.
    PoseNotFinite,
    /// A pose is not a rotation, or too far away.
    PoseInvalid,
    /// A camera's size or intrinsics cannot be used.
    CameraInvalid,
    /// A number or count is outside its limits.
    OutOfRange,
    /// The answer would be larger than the limits allow.
    AnswerTooLarge,
    /// Too many sessions or connections.
    Busy,
    /// The answer did not come within the deadline; nothing changed.
    DeadlineExceeded,
    /// The client was silent, or did not read, for too long.
    TimedOut,
    /// The server is shutting down.
    ShuttingDown,
    /// A token is needed, and none was given that the server knows.
    Unauthorized,
    /// The token does not go that far.
    Forbidden,
    /// There is no upload of this id.
    UnknownUpload,
    /// An upload goes on elsewhere than at the given offset.
    UploadOffset,
    /// An upload is not what its digest or size promises.
    UploadDigest,
    /// No room for the upload.
    StorageFull,
    /// There is no push of this id.
    UnknownPush,
    /// The cells were changed by somebody else since the base version.
    Conflict,
    /// The pushed Gaussians cannot be used.
    PushRefused,
    /// A fault of the server.
    Internal,
}
