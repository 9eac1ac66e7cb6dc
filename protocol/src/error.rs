//! The closed list of error codes.

use serde::{Deserialize, Serialize};

/// Error code. The list is closed: a new code requires a new protocol version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Code {
    /// The text frame is not JSON, or is nested too deeply.
    MalformedJson,
    /// The JSON is not a request: its type is unknown, or a field is missing, unknown or of the
    /// wrong type.
    InvalidRequest,
    /// The client sent a binary frame; only the server sends those.
    UnexpectedBinary,
    /// The message is larger than `limits.message_bytes`.
    MessageTooLarge,
    /// `seq` is neither the next number nor the last one.
    SeqOutOfOrder,
    /// The request came before `hello`, or is a second `hello`.
    WrongOrder,
    /// Client and server have no protocol version in common.
    UnsupportedProtocol,
    /// The request does not fit the state of the session: a session is already open, none is open,
    /// the episode has ended, or the session's dynamics do not accept this step.
    SessionState,
    /// There is no twin of this name.
    UnknownTwin,
    /// There is no asset of an actor of this name or hash, or several have the name.
    UnknownActor,
    /// The twin has no such version.
    UnknownVersion,
    /// The twin could not be loaded or written.
    TwinDamaged,
    /// There is no rig preset of this name.
    UnknownRig,
    /// The rig has no camera of this name.
    UnknownCamera,
    /// The twin has no trajectory of this name.
    UnknownTrajectory,
    /// There is no session of this name that can be resumed.
    UnknownSession,
    /// There is no such snapshot or recorded episode, or the recorded episode cannot be continued.
    UnknownState,
    /// The server has no scenario of this name.
    UnknownScenario,
    /// The scenario is malformed, does not fit the twin, or a hash that it names differs.
    ScenarioInvalid,
    /// The server has no repair model of this name.
    UnknownRepair,
    /// The repair model cannot be loaded, or not be used for these images.
    RepairUnavailable,
    /// The repair model failed, and the session asked for an error then. Nothing changed.
    RepairFailed,
    /// The server cannot share memory with this client.
    SharedMemoryUnavailable,
    /// A session of this name already exists.
    SessionExists,
    /// A name is not 1 to 64 characters of `[a-z0-9._-]`, or starts with a dot.
    InvalidName,
    /// A component of a pose is NaN or infinite.
    PoseNotFinite,
    /// The quaternion of a pose is not a rotation, or the position is too far away.
    PoseInvalid,
    /// A camera's size or intrinsics cannot be used.
    CameraInvalid,
    /// A number or count is outside its limits.
    OutOfRange,
    /// The answer would exceed the limits.
    AnswerTooLarge,
    /// The server is at a limit: too many sessions or connections, or too little memory.
    Busy,
    /// The answer was not ready before the deadline. Nothing changed.
    DeadlineExceeded,
    /// The client sent nothing, or did not read its answer, for too long.
    TimedOut,
    /// The server is shutting down.
    ShuttingDown,
    /// The request has no token, or one that the server does not know.
    Unauthorized,
    /// The token's role or twins do not permit this request.
    Forbidden,
    /// There is no upload of this id.
    UnknownUpload,
    /// The upload does not continue at the given offset.
    UploadOffset,
    /// The uploaded bytes do not match the announced digest or size.
    UploadDigest,
    /// There is no space for the upload, or for what a push writes.
    StorageFull,
    /// There is no push of this id.
    UnknownPush,
    /// Another push changed the same cells since the base version, or an asset of another content
    /// has the name.
    Conflict,
    /// The pushed Gaussians are invalid.
    PushRefused,
    /// An internal error of the server.
    Internal,
}
