//! How large a scenario is once its values are in place, computed without a copy.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::Value;

use super::error::FileError;
use crate::limits;

/// The value of each `$name`. Copies share the values.
pub type Values = BTreeMap<String, Arc<Value>>;

/// The name of a `$name` string.
pub(super) fn sweep_name(text: &str) -> Option<&str> {
    text.strip_prefix('$').filter(|name| !name.is_empty())
}

/// The size of a scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Size {
    /// Bytes of its JSON without spaces, at least.
    bytes: usize,
    objects: usize,
}

impl Size {
    /// The size of a scenario with values in place of its names.
    pub(super) fn with_values(value: &Value, values: &Values) -> Self {
        let mut size = Self::default();
        // Each value is measured once. A name without a value is refused when it is replaced.
        let sizes = values.iter().map(|(name, value)| {
            let mut size = Self::default();
            size.add(value, &|_| None);
            (name.as_str(), size)
        });
        let by_name: BTreeMap<&str, Self> = sizes.collect();
        size.add(value, &|name| by_name.get(name).copied());
        size
    }

    /// Adds a value. `of_name` has the sizes of the values of names.
    fn add(&mut self, value: &Value, of_name: &dyn Fn(&str) -> Option<Self>) {
        // With the comma or the colon after it. All sums saturate: the sizes are compared with
        // small limits.
        self.bytes = self.bytes.saturating_add(1);
        match value {
            Value::Null | Value::Bool(_) => self.bytes = self.bytes.saturating_add(4),
            // The digits are not counted: a number takes the same memory however long it is.
            Value::Number(_) => self.bytes = self.bytes.saturating_add(1),
            Value::String(text) => {
                let of_value = sweep_name(text).and_then(of_name);
                let replaced = of_value.unwrap_or(Self { bytes: text.len() + 2, objects: 0 });
                self.bytes = self.bytes.saturating_add(replaced.bytes);
                self.objects = self.objects.saturating_add(replaced.objects);
            }
            Value::Array(items) => {
                self.bytes = self.bytes.saturating_add(1);
                items.iter().for_each(|item| self.add(item, of_name));
            }
            Value::Object(fields) => {
                self.bytes = self.bytes.saturating_add(1);
                self.objects = self.objects.saturating_add(1);
                for (name, item) in fields {
                    self.bytes = self.bytes.saturating_add(name.len() + 2);
                    self.add(item, of_name);
                }
            }
        }
    }

    /// Refuses a scenario that is too large.
    pub(super) fn check(&self) -> Result<(), FileError> {
        let refused = |count: usize, unit: &str, most: usize| {
            let message = format!(
                "{count} {unit} with the values of its sweep; at most {most} are accepted: write \
                 shorter values, or use them in fewer places"
            );
            Err(FileError::new("scenario", message))
        };
        if self.bytes > limits::SCENARIO_BYTES {
            return refused(self.bytes, "bytes", limits::SCENARIO_BYTES);
        }
        if self.objects > limits::SCENARIO_OBJECTS {
            return refused(self.objects, "objects", limits::SCENARIO_OBJECTS);
        }
        Ok(())
    }
}
