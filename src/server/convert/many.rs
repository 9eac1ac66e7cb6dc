//! The answer to `step_many`: observations of several sessions in one message.
//!
//! The message has safetensors layout. Each observation is a tensor of bytes, the same bytes as a
//! message with only this observation. So nothing is copied: this module makes the header, and the
//! observations are sent after it from their own buffers.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use crate::fault::Fault;
use crate::sessions::ManyAnswer;
use wildcity_protocol::http::Refusal;
use wildcity_protocol::observation::{ManyMetadata, SessionAnswer, SessionRefusal};
use wildcity_session::Observation;

use super::answer::text;

/// Result of the step of one session.
pub(crate) struct Stepped {
    pub(crate) session: String,
    pub(crate) result: Result<Arc<Observation>, Fault>,
}

/// The answer, of steps in the order of the request.
pub(crate) fn many(seq: u64, steps: Vec<Stepped>) -> Result<ManyAnswer, Fault> {
    let mut header = BTreeMap::new();
    let mut answers = Vec::new();
    let mut frames = Vec::new();
    // `end` is the length of all observations so far: the tensors follow each other without gaps,
    // as safetensors requires.
    let mut end = 0;
    for (index, Stepped { session, result }) in steps.into_iter().enumerate() {
        match result {
            Ok(frame) => {
                let bytes = frame.buffer.bytes().len();
                let tensor = format!("session/{session}");
                let data_offsets = [end, end + bytes];
                end += bytes;
                let info = TensorInfo { dtype: "U8", shape: [bytes], data_offsets };
                header.insert(tensor.clone(), Entry::Tensor(info));
                answers.push(SessionAnswer { session, tensor: Some(tensor), error: None });
                frames.push(frame);
            }
            Err(fault) => {
                let error = Some(refusal(index, &fault));
                answers.push(SessionAnswer { session, tensor: None, error });
            }
        }
    }
    // JSON within JSON: safetensors allows only texts as metadata.
    let metadata = text(&ManyMetadata { seq, answers })?;
    header.insert("__metadata__".to_owned(), Entry::Metadata { many: metadata });
    let json = text(&header)?;
    // With the 8 bytes of its length before it, the data begins at a multiple of 8.
    let padded = json.len().next_multiple_of(8);
    let mut header = (padded as u64).to_le_bytes().to_vec();
    header.extend(json.as_bytes());
    header.resize(size_of::<u64>() + padded, b' ');
    Ok(ManyAnswer { header, frames })
}

/// A refusal whose field is that of the whole request.
fn refusal(index: usize, fault: &Fault) -> SessionRefusal {
    let Refusal { code, message, field, .. } = fault.report().body;
    // A step in a list has no type. A step that does not fit the state of a session is a fault of
    // the field `session`.
    let field = field
        .map(|field| if field == "type" { "session".to_owned() } else { field })
        .map(|field| format!("steps[{index}].{field}"));
    SessionRefusal { code, message, field }
}

#[derive(Serialize)]
#[serde(untagged)]
enum Entry {
    Metadata { many: String },
    Tensor(TensorInfo),
}

#[derive(Serialize)]
struct TensorInfo {
    dtype: &'static str,
    shape: [usize; 1],
    data_offsets: [usize; 2],
}
