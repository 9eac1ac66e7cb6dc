//! The vectors of contacts and scores in the real data: inputs, and results of the published
//! definitions.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use serde_json::Value;

use crate::data;

/// A case of a vector file.
#[derive(Debug)]
pub(crate) struct Case {
    /// Its name.
    pub(crate) name: String,
    /// The input.
    pub(crate) input: Value,
    /// The expected result.
    pub(crate) expected: Value,
}

/// The cases of `scores/<file>.json` whose names start with `prefix`; `None` without the data.
///
/// # Panics
/// If there is no such case, because the test would then assert nothing.
pub(crate) fn cases(file: &str, prefix: &str) -> Option<Vec<Case>> {
    let path = data::real(&format!("scores/{file}.json"))?;
    let text = std::fs::read_to_string(path).unwrap();
    let mut all: Value = serde_json::from_str(&text).unwrap();
    let cases: Vec<Case> = all["cases"]
        .as_array_mut()
        .unwrap()
        .iter_mut()
        .map(|case| Case {
            name: case["name"].as_str().unwrap().to_owned(),
            input: case["input"].take(),
            expected: case["expected"].take(),
        })
        .filter(|case| case.name.starts_with(prefix))
        .collect();
    assert!(!cases.is_empty(), "no case of {file}.json starts with {prefix:?}");
    Some(cases)
}

/// A number of a case.
pub(crate) fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// A list of numbers.
pub(crate) fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

/// Checks a number to 1e-9 of its size, or of 1.
///
/// # Panics
/// If it is another.
pub(crate) fn assert_near(found: f64, expected: &Value, what: &str) {
    let wanted = number(expected);
    let near = (found - wanted).abs() <= 1e-9 * wanted.abs().max(1.0);
    assert!(near, "{what}: {found:?}, not {wanted:?}");
}
