//! What can go wrong between a client and its server.

use std::time::Duration;

use safetensors::SafeTensorError;

use wildcity_protocol::error::Code;

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// There is no connection to be had.
    #[error("cannot connect to {url}: {reason}")]
    Connect {
        /// Where.
        url: String,
        /// Why not.
        reason: String,
    },
    /// The server refused the request; nothing changed, and it can be sent again.
    #[error("refused, {code:?}: {message}")]
    Refused {
        /// What went wrong.
        code: Code,
        /// For people: what, and how to fix it.
        message: String,
        /// The field at fault, as `pose.q[2]`.
        field: Option<String>,
        /// Whether the connection ended with it.
        fatal: bool,
    },
    /// No answer within the time set; the connection was given up.
    #[error("no answer within {0:?}")]
    TimedOut(Duration),
    /// The connection is gone; `reconnect` may continue the session.
    #[error("disconnected: {0}")]
    Disconnected(String),
    /// The server answered something else; the connection was given up.
    #[error("expected {expected}, got {got}")]
    UnexpectedAnswer {
        /// What the protocol asks for.
        expected: &'static str,
        /// What came.
        got: String,
    },
    /// The answer belongs to another request; the connection was given up.
    #[error("expected an answer to request {expected}, got one to {got:?}")]
    SeqMismatch {
        /// The request's number.
        expected: u64,
        /// The answer's.
        got: Option<u64>,
    },
    /// The request cannot be written as JSON.
    #[error("cannot write the request: {0}")]
    Request(serde_json::Error),
    /// A text frame is no answer; the connection was given up.
    #[error("cannot read an answer: {0}")]
    Answer(serde_json::Error),
    /// A binary frame is no observation; the connection was given up.
    #[error("cannot read an observation: {0}")]
    Frame(FrameError),
}

/// Why a binary frame is not an observation.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// The header is longer than any honest one.
    #[error("the header is {bytes} bytes; at most {limit} are accepted")]
    HeaderTooLong {
        /// What the frame says.
        bytes: u64,
        /// What is accepted.
        limit: u64,
    },
    /// Not safetensors: truncated, no JSON, tensors that overlap or reach beyond the end.
    #[error("not in safetensors layout: {0}")]
    Layout(SafeTensorError),
    /// `__metadata__` has no `observation`.
    #[error("the header's __metadata__ has no observation")]
    NoObservation,
    /// `__metadata__.observation` is not what the protocol says.
    #[error("cannot read __metadata__.observation: {0}")]
    Observation(serde_json::Error),
    /// A tensor is missing.
    #[error("there is no tensor {name:?}")]
    Missing {
        /// The tensor.
        name: String,
    },
    /// A tensor has another type or shape than the observation says.
    #[error("tensor {name:?} is {found}; expected {expected}")]
    Tensor {
        /// The tensor.
        name: String,
        /// Its type and shape.
        found: String,
        /// The type and shape that the protocol asks for.
        expected: String,
    },
    /// A JPEG or PNG file cannot be decoded.
    #[error("image {name:?}: {cause}")]
    Image {
        /// The tensor.
        name: String,
        /// What the decoder says.
        cause: image::ImageError,
    },
    /// Pixels, or hashes, do not have the hash that the observation names.
    #[error("{name:?} hashes to {found}, not to {expected}")]
    Hash {
        /// A tensor, or `frame_hash`.
        name: String,
        /// BLAKE3 of what came, in hex.
        found: String,
        /// BLAKE3 that the observation names, in hex.
        expected: String,
    },
}
