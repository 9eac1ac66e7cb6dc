//! Errors of the session client.

use std::time::Duration;

use safetensors::SafeTensorError;

use wildcity_protocol::error::Code;

/// Why a call of the session client failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The client could not connect.
    #[error("cannot connect to {url}: {reason}")]
    Connect {
        /// Address of the server, as it was given.
        url: String,
        /// What failed: the address, the token, TLS or the network.
        reason: String,
    },
    /// The server refused the request. Nothing changed, and the request can be sent again.
    #[error("refused, {code:?}: {message}")]
    Refused {
        /// Code of the error.
        code: Code,
        /// Description of the error and of its remedy.
        message: String,
        /// The field at fault, for example `pose.q[2]`.
        field: Option<String>,
        /// Whether the server closed the connection after this error.
        fatal: bool,
    },
    /// No answer came within the time limit. The client closed the connection.
    #[error("no answer within {0:?}")]
    TimedOut(Duration),
    /// The connection is lost. `reconnect` may continue the session.
    #[error("disconnected: {0}")]
    Disconnected(String),
    /// The server sent another kind of answer. The client closed the connection.
    #[error("expected {expected}, got {got}")]
    UnexpectedAnswer {
        /// The kind of answer that the protocol requires.
        expected: &'static str,
        /// The answer that came.
        got: String,
    },
    /// The answer has the number of another request. The client closed the connection.
    #[error("expected an answer to request {expected}, got one to {got:?}")]
    SeqMismatch {
        /// Number of the request.
        expected: u64,
        /// Number of the answer.
        got: Option<u64>,
    },
    /// The server's memory cannot be used. The client closed the connection.
    #[error("shared memory: {0}")]
    SharedMemory(String),
    /// The request cannot be written as JSON.
    #[error("cannot write the request: {0}")]
    Request(serde_json::Error),
    /// A text frame is not an answer. The client closed the connection.
    #[error("cannot read an answer: {0}")]
    Answer(serde_json::Error),
    /// A binary frame is not an observation. The client closed the connection.
    #[error("cannot read an observation: {0}")]
    Frame(FrameError),
}

/// Why a binary frame is not a valid observation.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// The header is longer than the client accepts.
    #[error("the header is {bytes} bytes; at most {limit} are accepted")]
    HeaderTooLong {
        /// Header length in the frame.
        bytes: u64,
        /// Largest header length that the client accepts.
        limit: u64,
    },
    /// The frame is not in safetensors layout: it is truncated, its header is not JSON, or tensors
    /// overlap or reach beyond the end.
    #[error("not in safetensors layout: {0}")]
    Layout(SafeTensorError),
    /// `__metadata__` has no `observation`.
    #[error("the header's __metadata__ has no observation")]
    NoObservation,
    /// `__metadata__.observation` is not the JSON object that the protocol defines.
    #[error("cannot read __metadata__.observation: {0}")]
    Observation(serde_json::Error),
    /// A tensor that the metadata names is missing.
    #[error("there is no tensor {name:?}")]
    Missing {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor has another type or shape than the metadata requires.
    #[error("tensor {name:?} is {found}; expected {expected}")]
    Tensor {
        /// Name of the tensor.
        name: String,
        /// Its type and shape.
        found: String,
        /// The type and shape that the metadata requires.
        expected: String,
    },
    /// A JPEG or PNG file cannot be decoded.
    #[error("image {name:?} cannot be decoded: {reason}")]
    Image {
        /// Name of the tensor.
        name: String,
        /// What the decoder found wrong in the file.
        reason: String,
    },
    /// Pixels, or the images' hashes, do not have the hash that the metadata names.
    #[error("{name:?} hashes to {found}, not to {expected}")]
    Hash {
        /// Name of a tensor, or `frame_hash`.
        name: String,
        /// BLAKE3 of the received data, in hex.
        found: String,
        /// BLAKE3 that the metadata names, in hex.
        expected: String,
    },
}
