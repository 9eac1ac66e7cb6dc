//! A scenario with its sweep: from text to one file for each combination of values.
//!
//! A value stands in the document once, however many `"$name"` it replaces. The size of a scenario
//! with its values is computed from their sizes, and refused, before anything is copied.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde_json::Value;

use super::error::{FileError, check_format, json, typed};
use super::file::ScenarioFile;
use super::size::{Size, Values, sweep_name};
use crate::limits;

/// A scenario whose `$name` values are not chosen yet.
#[derive(Clone, Debug, PartialEq)]
pub struct Document {
    value: Value,
    sweep: Sweep,
}

/// Values as a file has them: nothing is shared.
pub fn written_values(values: &Values) -> BTreeMap<String, Value> {
    values.iter().map(|(name, value)| (name.clone(), Value::clone(value))).collect()
}

/// One combination of a sweep.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Case {
    pub seed: u64,
    pub values: Values,
}

/// The sweep of a document.
#[derive(Clone, Debug, Default, PartialEq)]
struct Sweep {
    /// First and last seed.
    seeds: Option<[u64; 2]>,
    /// The values of each `$name`.
    values: BTreeMap<String, Vec<Arc<Value>>>,
}

impl Document {
    /// Reads a scenario's JSON, and checks that each `$name` has values and each value is used.
    ///
    /// # Errors
    /// Names the place of the first mistake.
    pub fn parse(bytes: &[u8]) -> Result<Self, FileError> {
        Self::from_json(json(bytes, "scenario", limits::SCENARIO_BYTES)?)
    }

    /// Reads a document from JSON that is parsed already.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn from_json(mut value: Value) -> Result<Self, FileError> {
        // The format first: another format's file would fail with a misleading message below.
        check_format(value.get("format").and_then(Value::as_str), ScenarioFile::FORMAT)?;
        // Before the sweep is taken out, so that it may have notes as well.
        remove_notes(&mut value);
        let sweep = match value.as_object_mut().and_then(|fields| fields.remove("sweep")) {
            None => Sweep::default(),
            Some(sweep) => sweep_from(sweep)?,
        };
        let document = Self { value, sweep };
        document.check_sweep()?;
        Ok(document)
    }

    /// Every combination of the sweep: seeds vary fastest, then the values of the last name.
    pub fn cases(&self) -> Vec<Case> {
        // Starts with one combination of nothing, so that a sweep without values has one case.
        let mut combinations = vec![Values::new()];
        // After each name, `combinations` has every choice for the names so far. The check has
        // bounded the product.
        for (name, values) in &self.sweep.values {
            let mut longer = Vec::with_capacity(combinations.len() * values.len());
            // The outer loop is over what exists, so that the last name varies fastest.
            for combination in &combinations {
                for value in values {
                    let mut with = combination.clone();
                    with.insert(name.clone(), value.clone());
                    longer.push(with);
                }
            }
            combinations = longer;
        }
        let [first, last] = self.sweep.seeds.unwrap_or([0, 0]);
        let seeded =
            |values: Values| (first..=last).map(move |seed| Case { seed, values: values.clone() });
        combinations.into_iter().flat_map(seeded).collect()
    }

    /// The first value of each name.
    pub fn first_values(&self) -> Values {
        let values = self.sweep.values.iter();
        values.map(|(name, values)| (name.clone(), values[0].clone())).collect()
    }

    /// The scenario with chosen values.
    ///
    /// # Errors
    /// A name has no value, or the file with these values is malformed or too large.
    pub fn with(&self, values: &Values) -> Result<ScenarioFile, FileError> {
        // Before the copy: one value of a kilobyte may stand in thousands of places.
        Size::with_values(&self.value, values).check()?;
        let mut value = self.value.clone();
        replace_names(&mut value, values, &mut String::new())?;
        typed(value, "scenario")
    }

    fn check_sweep(&self) -> Result<(), FileError> {
        // First the names in use, then each name of the sweep against them, at last each name in
        // use against the sweep.
        let mut used = BTreeSet::new();
        collect_names(&self.value, &mut used);
        if self.sweep.values.len() > limits::SWEEP_NAMES {
            let count = self.sweep.values.len();
            let most = limits::SWEEP_NAMES;
            let message = format!("{count} names; at most {most} are accepted");
            return Err(FileError::new("sweep", message));
        }
        let mut count: u64 = 1;
        for (name, values) in &self.sweep.values {
            let path = format!("sweep.{name}");
            if values.is_empty() {
                return Err(FileError::new(path, "has no values; list at least one"));
            }
            if !used.contains(name) {
                let message = format!("is not used: write \"${name}\" in place of a value");
                return Err(FileError::new(path, message));
            }
            // Saturating, because the product of a few long lists exceeds 64 bits; it is compared
            // with a small limit.
            count = count.saturating_mul(values.len() as u64);
        }
        if let Some([first, last]) = self.sweep.seeds {
            if first > last {
                let message = format!("[{first}, {last}]; write the first and the last seed");
                return Err(FileError::new("sweep.seeds", message));
            }
            // The subtraction is safe, because first <= last. All seeds are 2^64, hence the
            // saturating addition.
            count = count.saturating_mul((last - first).saturating_add(1));
        }
        if count > limits::SWEEP_CASES {
            let message = format!("{count} combinations; at most {} are run", limits::SWEEP_CASES);
            return Err(FileError::new("sweep", message));
        }
        match used.iter().find(|name| !self.sweep.values.contains_key(*name)) {
            None => Ok(()),
            Some(name) => {
                let message = format!("has no values for \"${name}\"; list them as {name:?}: [..]");
                Err(FileError::new("sweep", message))
            }
        }
    }
}

/// The sweep, field by field, since the path within a flattened map would be lost.
fn sweep_from(value: Value) -> Result<Sweep, FileError> {
    let Value::Object(fields) = value else {
        let message = "is no object; write {\"seeds\": [0, 9], \"NAME\": [values]}";
        return Err(FileError::new("sweep", message));
    };
    let mut sweep = Sweep::default();
    for (name, value) in fields {
        let path = format!("sweep.{name}");
        if name == "seeds" {
            sweep.seeds = Some(typed(value, &path)?);
        } else {
            let values: Vec<Value> = typed(value, &path)?;
            sweep.values.insert(name, values.into_iter().map(Arc::new).collect());
        }
    }
    Ok(sweep)
}

/// Removes the comments of all objects.
fn remove_notes(value: &mut Value) {
    match value {
        Value::Object(fields) => {
            fields.remove("note");
            fields.values_mut().for_each(remove_notes);
        }
        Value::Array(items) => items.iter_mut().for_each(remove_notes),
        _ => {}
    }
}

fn collect_names(value: &Value, names: &mut BTreeSet<String>) {
    match value {
        // Only a whole string is a name: `$` within a text stays as it is.
        Value::String(text) => names.extend(sweep_name(text).map(str::to_owned)),
        Value::Array(items) => items.iter().for_each(|item| collect_names(item, names)),
        Value::Object(fields) => fields.values().for_each(|item| collect_names(item, names)),
        _ => {}
    }
}

fn replace_names(value: &mut Value, values: &Values, path: &mut String) -> Result<(), FileError> {
    let length = path.len();
    match value {
        Value::String(text) => {
            if let Some(name) = sweep_name(text) {
                let Some(chosen) = values.get(name) else {
                    let message =
                        format!("\"${name}\" has no value: give one, or a sweep over {name:?}");
                    return Err(FileError::new(path.trim_start_matches('.'), message));
                };
                // A chosen value is not searched again: it cannot refer to another name.
                *value = Value::clone(chosen);
            }
        }
        Value::Array(items) => {
            for (index, item) in items.iter_mut().enumerate() {
                path.push_str(&format!("[{index}]"));
                replace_names(item, values, path)?;
                // Back to the path of this value, for the next item and for the caller.
                path.truncate(length);
            }
        }
        Value::Object(fields) => {
            for (name, item) in fields.iter_mut() {
                path.push('.');
                path.push_str(name);
                replace_names(item, values, path)?;
                path.truncate(length);
            }
        }
        _ => {}
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn scenario(sweep: Value, speed: Value) -> Value {
        json!({"format": "wildcity.scenario/1", "name": "cut-in", "note": "a comment",
               "twin": {"name": "street", "note": "another"},
               "actors": [{"name": "van", "idm": {"along": "log", "station_m": 5, "speed": speed}}],
               "sweep": sweep})
    }

    #[test]
    fn a_sweep_has_every_combination() {
        let sweep = json!({"seeds": [3, 4], "v": [6, 8, 10]});
        let document = Document::from_json(scenario(sweep, json!("$v"))).unwrap();
        let cases = document.cases();
        assert_eq!(cases.len(), 6);
        // Seeds vary fastest, so the second case has the first value and the second seed.
        assert_eq!((cases[1].seed, &cases[1].values["v"]), (4, &Arc::new(json!(6))));
        let file = document.with(&cases[5].values).unwrap();
        assert_eq!(file.actors[0].idm.as_ref().unwrap().speed, 10.0);
    }

    #[test]
    fn mistakes_name_their_place() {
        let path = |value: Value| {
            let document = match Document::from_json(value) {
                Err(error) => return error.path,
                Ok(document) => document,
            };
            document.with(&document.first_values()).unwrap_err().path
        };
        assert_eq!(path(json!({"format": "other"})), "format");
        assert_eq!(path(scenario(json!({"v": []}), json!("$v"))), "sweep.v");
        assert_eq!(path(scenario(json!({"v": [1]}), json!(3))), "sweep.v");
        assert_eq!(path(scenario(json!({}), json!("$v"))), "sweep");
        assert_eq!(path(scenario(json!({"v": 3}), json!("$v"))), "sweep.v");
        assert_eq!(path(scenario(json!({"seeds": [2, 1]}), json!(3))), "sweep.seeds");
        // 2^64 seeds: the count must saturate and not wrap to 0.
        assert_eq!(path(scenario(json!({"seeds": [0, u64::MAX]}), json!(3))), "sweep");
        assert_eq!(path(scenario(json!({"v": ["fast"]}), json!("$v"))), "actors[0].idm.speed");
        assert_eq!(path(scenario(Value::Null, json!(true))), "sweep");
    }

    #[test]
    fn a_value_in_many_places_is_refused_before_it_is_copied() {
        let many = |times: usize, length: usize| {
            let actors = vec![json!("$v"); times];
            Document::from_json(json!({"format": "wildcity.scenario/1", "name": "bomb",
                                       "twin": {"name": "street"}, "actors": actors,
                                       "sweep": {"v": ["x".repeat(length)]}}))
            .unwrap()
        };
        // 10,000 times 100 kB: a gigabyte from 160 kB.
        let bomb = many(10_000, 100_000);
        let refused = bomb.with(&bomb.first_values()).unwrap_err();
        assert!(refused.message.contains("with the values of its sweep"), "{refused}");
        // A scenario within the limit gets to its types, which are wrong here.
        let small = many(10, 1000);
        assert_eq!(small.with(&small.first_values()).unwrap_err().path, "actors[0]");
        // All cases share the one value.
        let cases = many(1, 1000).cases();
        assert_eq!(Arc::strong_count(&cases[0].values["v"]), 1);
    }

    #[test]
    fn a_scenario_of_many_objects_is_refused_before_its_types() {
        let parts = vec![json!({}); limits::SCENARIO_OBJECTS + 1];
        let crowd = json!({"format": "wildcity.scenario/1", "name": "crowd", "end": {"when": {"any": parts}},
                           "twin": {"name": "street"}});
        let document = Document::from_json(crowd).unwrap();
        let refused = document.with(&document.first_values()).unwrap_err();
        assert!(refused.message.contains("objects"), "{refused}");
    }
}
