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
    let mut missing = Vec::new();
    find_missing(&given, &known, Field::default(), &mut missing);
    let is_unknown = |field: &Field| !field.is_absent || !is_read::<T>(&given, &known, field);
    match missing.into_iter().find(is_unknown) {
        Some(Field { name, .. }) => Err(D::Error::custom(format!("unknown field `{name}`"))),
        None => Ok(read),
    }
}

/// A field of a JSON value.
#[derive(Clone, Debug, Default)]
struct Field {
    name: String,
    /// Where it is (RFC 6901).
    pointer: String,
    /// Whether its value says the same as none.
    is_absent: bool,
}

/// The fields of `given` that are missing when the value is written again.
fn find_missing(given: &Value, known: &Value, at: Field, missing: &mut Vec<Field>) {
    match (given, known) {
        (Value::Object(given), Value::Object(known)) => {
            for (name, value) in given {
                let field = at.inner(name, value);
                match known.get(name) {
                    Some(known) => find_missing(value, known, field, missing),
                    None => missing.push(field),
                }
            }
        }
        (Value::Array(given), Value::Array(known)) => {
            for (index, (given, known)) in given.iter().zip(known).enumerate() {
                find_missing(given, known, at.item(index), missing);
            }
        }
        _ => {}
    }
}

/// Whether a field is read at all: then another value is refused, or written again. (An absent
/// value is not written, even of a known field.)
fn is_read<T>(given: &Value, known: &Value, field: &Field) -> bool
where
    T: Serialize + DeserializeOwned,
{
    let mut other = given.clone();
    if let Some(value) = other.pointer_mut(&field.pointer) {
        *value = Value::Bool(false);
    }
    let written = T::deserialize(&other).and_then(serde_json::to_value);
    !written.is_ok_and(|written| written == *known)
}

impl Field {
    fn inner(&self, name: &str, value: &Value) -> Self {
        let dot = if self.name.is_empty() { "" } else { "." };
        Self {
            name: format!("{}{dot}{name}", self.name),
            pointer: format!("{}/{}", self.pointer, name.replace('~', "~0").replace('/', "~1")),
            is_absent: match value {
                Value::Null => true,
                Value::Array(items) => items.is_empty(),
                Value::Object(fields) => fields.is_empty(),
                _ => false,
            },
        }
    }

    fn item(&self, index: usize) -> Self {
        Self {
            name: format!("{}[{index}]", self.name),
            pointer: format!("{}/{index}", self.pointer),
            is_absent: false,
        }
    }
}
