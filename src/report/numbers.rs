//! Numbers of which JSON has none: `"inf"`, `"-inf"` and `"NaN"`, as the CSV spells them.

use serde::{Serialize, Serializer};

/// One number.
pub(super) fn number<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    Number(*value).serialize(serializer)
}

/// Several.
pub(super) fn numbers<S: Serializer>(values: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(values.iter().copied().map(Number))
}

struct Number(f64);

impl Serialize for Number {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0.is_finite() {
            true => serializer.serialize_f64(self.0),
            false => serializer.collect_str(&self.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Two {
        #[serde(serialize_with = "number")]
        one: f64,
        #[serde(serialize_with = "numbers")]
        all: Vec<f64>,
    }

    #[test]
    fn what_json_has_no_number_for_is_said() {
        let all = vec![f64::INFINITY, f64::NEG_INFINITY, f64::NAN, 40.5];
        let text = serde_json::to_string(&Two { one: f64::INFINITY, all }).unwrap();
        assert_eq!(text, r#"{"one":"inf","all":["inf","-inf","NaN",40.5]}"#);
    }
}
