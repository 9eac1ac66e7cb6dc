//! Reading of files: unknown fields are refused, at any depth.
//!
//! The types of this package ignore unknown fields, as clients must in answers. In a file a field
//! that is not read is a mistake of its author.

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

/// Reads a value whose every field must be known, for `#[serde(deserialize_with)]`.
///
/// # Errors
/// Names the first field that `T` does not have.
pub fn deserialize<'de, T, D>(deserializer: D) -> Result<T, D::Error>
where
    T: Serialize + DeserializeOwned,
    D: Deserializer<'de>,
{
    let given = Value::deserialize(deserializer)?;
    let read = T::deserialize(&given).map_err(D::Error::custom)?;
    let known = serde_json::to_value(&read).map_err(D::Error::custom)?;
    match unknown(&given, &known) {
        Some(field) => Err(D::Error::custom(format!("unknown field `{field}`"))),
        None => Ok(read),
    }
}

/// The first field of `given` that was not read: it is missing when the value is written again.
fn unknown(given: &Value, known: &Value) -> Option<String> {
    match (given, known) {
        (Value::Object(given), Value::Object(known)) => {
            given.iter().find_map(|(name, value)| match known.get(name) {
                // An absent value is not written.
                None => (!is_absent(value)).then(|| name.clone()),
                Some(known) => unknown(value, known).map(|field| joined(name, &field)),
            })
        }
        (Value::Array(given), Value::Array(known)) => {
            given.iter().zip(known).enumerate().find_map(|(at, (given, known))| {
                unknown(given, known).map(|field| joined(&format!("[{at}]"), &field))
            })
        }
        _ => None,
    }
}

fn joined(outer: &str, inner: &str) -> String {
    let dot = if inner.starts_with('[') { "" } else { "." };
    format!("{outer}{dot}{inner}")
}

/// Whether a value says the same as none.
fn is_absent(value: &Value) -> bool {
    match value {
        Value::Null => true,
        Value::Array(items) => items.is_empty(),
        Value::Object(fields) => fields.is_empty(),
        _ => false,
    }
}
