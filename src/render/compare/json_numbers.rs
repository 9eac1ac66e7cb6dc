//! Serialization of numbers that JSON lacks: infinity and NaN become the strings `"inf"`, `"-inf"`
//! and `"NaN"`, as in the CSV.

use serde::{Serialize, Serializer};

/// For `#[serde(serialize_with)]`: one number.
pub fn serialize_number<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    Number(*value).serialize(serializer)
}

/// For `#[serde(serialize_with)]`: several numbers.
pub fn serialize_numbers<S: Serializer>(values: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(values.iter().copied().map(Number))
}

struct Number(f64);

impl Serialize for Number {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.0.is_finite() {
            serializer.serialize_f64(self.0)
        } else {
            serializer.collect_str(&self.0)
        }
    }
}
