//! Scenarios of a server: files by name, with the tracks and maps beside them.

mod load;

pub use load::{LoadedScenario, ScenarioError, ScenarioSource, Scenarios};
