//! Mistakes in messages and bodies, as faults.

use wildcity_protocol::decode::{Inbound, Mistake, MistakeKind, decode};

use crate::fault::Fault;

impl From<Mistake> for Fault {
    fn from(Mistake { kind, field, reason }: Mistake) -> Self {
        match (kind, field) {
            // Text that is no JSON has no fields.
            (MistakeKind::NotJson, _) => Self::MalformedJson(reason),
            (MistakeKind::PoseNotFinite, Some(field)) => Self::PoseNotFinite { field },
            (MistakeKind::OutOfRange, Some(field)) => {
                // The reason begins with the field, and so does the fault's message.
                let must = reason.strip_prefix(&format!("{field} is ")).unwrap_or(&reason);
                Self::OutOfRange { must: must.to_owned(), field }
            }
            (MistakeKind::Defect, _) => Self::Internal(reason),
            // Also the kinds above without a field, which the decoder does not make.
            (_, field) => Self::InvalidRequest { field, reason },
        }
    }
}

/// Reads the body of an HTTP request.
pub(super) fn read_body<T: Inbound>(body: &[u8]) -> Result<T, Fault> {
    let text =
        std::str::from_utf8(body).map_err(|error| Fault::MalformedJson(error.to_string()))?;
    decode(text).map_err(|refused| refused.mistake.into())
}
