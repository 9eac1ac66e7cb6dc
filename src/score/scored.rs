//! A score of an episode: its value, or the reason why it has none.

use std::collections::BTreeMap;

use serde::Serialize;

/// Why a score has no value: the input that the record lacks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Missing {
    /// As a sentence: `needs a map of the lanes`.
    pub reason: String,
}

/// A value, or the reason why there is none.
pub type Measured = Result<f64, Missing>;

/// A score of one episode.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Its name and version: `alpasim.scene@3032e0c`, `wildcity.verdict@3`.
    pub name: &'static str,
    /// Its value; null if it lacks an input.
    pub value: Option<f64>,
    /// Why it has no value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The values that it was computed from: sub-scores, measures, thresholds; null for missing
    /// ones.
    pub parts: BTreeMap<&'static str, Option<f64>>,
}

impl Missing {
    /// A missing input, with the reason why it is missing.
    pub fn new(reason: impl Into<String>) -> Self {
        Self { reason: reason.into() }
    }
}

impl Score {
    /// A score from its value and its parts.
    pub fn new(
        name: &'static str,
        value: Measured,
        parts: impl IntoIterator<Item = (&'static str, Option<f64>)>,
    ) -> Self {
        // JSON has no infinity, and no score is infinite.
        let value = value.and_then(|value| {
            if value.is_finite() { Ok(value) } else { Err(Missing::new("is not a finite number")) }
        });
        let reason = value.as_ref().err().map(|missing| missing.reason.clone());
        // Infinite parts, such as a time to contact that never comes, are null as well.
        let finite = |part: Option<f64>| part.filter(|part| part.is_finite());
        let parts = parts.into_iter().map(|(name, part)| (name, finite(part))).collect();
        Self { name, value: value.ok(), reason, parts }
    }
}
