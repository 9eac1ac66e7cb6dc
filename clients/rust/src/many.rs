//! Decoding of the answer to `step_many`: observations of several sessions in one message.

use safetensors::{Dtype, SafeTensors};
use tokio_tungstenite::tungstenite::Bytes;

use wildcity_protocol::observation::{ManyMetadata, SessionAnswer, SessionRefusal};

use crate::error::FrameError;
use crate::observation::{Observation, check_header_length};

/// Result of the step of one session.
#[derive(Clone, Debug)]
pub struct Stepped {
    /// Name of the session.
    pub session: String,
    /// Its observation, or why its step was refused: then the session is unchanged.
    pub result: Result<Observation, SessionRefusal>,
}

/// The answer to `step_many`.
#[derive(Clone, Debug)]
pub(crate) struct Many {
    /// Number of the request.
    pub(crate) seq: u64,
    /// In the order of the request.
    pub(crate) steps: Vec<Stepped>,
}

impl Many {
    /// Decodes a binary message. The observations are parts of it, without a copy.
    pub(crate) fn decode(message: &Bytes) -> Result<Self, FrameError> {
        check_header_length(message)?;
        let (header_bytes, tensors) =
            SafeTensors::read_metadata(message).map_err(FrameError::Layout)?;
        let texts = tensors.metadata().as_ref();
        let text = texts.and_then(|texts| texts.get("many")).ok_or(FrameError::NoObservation)?;
        let metadata: ManyMetadata = serde_json::from_str(text).map_err(FrameError::Observation)?;
        // A safetensors file begins with the length of its header, in eight bytes.
        let data_start = size_of::<u64>() + header_bytes;
        let stepped = |SessionAnswer { session, tensor, error }: SessionAnswer| {
            let result = match (tensor, error) {
                (None, Some(refusal)) => Err(refusal),
                (Some(name), None) => {
                    let info = tensors
                        .info(&name)
                        .ok_or_else(|| FrameError::Missing { name: name.clone() })?;
                    if info.dtype != Dtype::U8 || info.shape.len() != 1 {
                        return Err(FrameError::Tensor {
                            name,
                            found: format!("{} {:?}", info.dtype, info.shape),
                            expected: "U8 [n]".to_owned(),
                        });
                    }
                    let (start, end) = info.data_offsets;
                    // Each observation is a part of the same buffer: nothing is copied.
                    // `read_metadata` has checked that all offsets are within it.
                    let frame = message.slice(data_start + start..data_start + end);
                    let observation = Observation::decode(frame)?;
                    let found = &observation.metadata().session;
                    if *found != session {
                        let found = format!("an observation of {found:?}");
                        let expected = format!("one of {session:?}");
                        return Err(FrameError::Tensor { name, found, expected });
                    }
                    Ok(observation)
                }
                // Neither, or both: an answer is one of two.
                (_, _) => return Err(FrameError::Missing { name: format!("session/{session}") }),
            };
            Ok(Stepped { session, result })
        };
        let steps = metadata.answers.into_iter().map(stepped).collect::<Result<_, FrameError>>()?;
        Ok(Self { seq: metadata.seq, steps })
    }
}
