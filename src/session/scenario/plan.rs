//! What the scenarios of a twin look like from above, before one of them is opened.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use wildcity_sim::map::{LaneKind, MapFile};

use super::load::{ScenarioSource, Scenarios};
use crate::limits;

/// The scenarios that play in a twin, and the lanes of their maps.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TwinScenarios {
    pub scenarios: Vec<PlannedScenario>,
    /// By the name of a map: outlines of its lanes for cars, each a ring of x and y, in metres.
    pub maps: BTreeMap<String, Vec<Vec<[f64; 2]>>>,
    /// Maps that cannot be read here, or that are too large.
    pub omitted_maps: BTreeSet<String>,
    /// Scenarios of the server that were not looked at: only the first
    /// [`limits::PLANNED_SCENARIOS`] are.
    pub omitted_scenarios: usize,
}

/// A scenario of a twin.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct PlannedScenario {
    pub name: String,
    /// The file of its map, if it names one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<String>,
}

impl Scenarios {
    /// The scenarios that play in a twin, in order. A scenario that cannot be read is not listed:
    /// it says no twin. A map is omitted that cannot be read, that has more than
    /// [`limits::PLANNED_MAP_BYTES`], or with which all have more than
    /// [`limits::PLANNED_MAPS_BYTES`]; opening the scenario says what is wrong.
    /// `None` if the listing is not wanted any more, which is asked before each file.
    pub fn in_twin(&self, twin: &str, is_wanted: &dyn Fn() -> bool) -> Option<TwinScenarios> {
        let names = self.names();
        let omitted_scenarios = names.len().saturating_sub(limits::PLANNED_SCENARIOS);
        let mut found = TwinScenarios { omitted_scenarios, ..TwinScenarios::default() };
        let mut left_bytes = limits::PLANNED_MAPS_BYTES;
        for name in names.into_iter().take(limits::PLANNED_SCENARIOS) {
            if !is_wanted() {
                return None;
            }
            let source = ScenarioSource::Named(name.clone());
            let Ok(file) = self.file(&source, &BTreeMap::new()) else { continue };
            if file.twin.name != twin {
                continue;
            }
            let map = file.map.map(|pin| pin.file);
            if let Some(map) = map.as_ref().filter(|map| !found.has_tried(map)) {
                match self.lanes(map, &mut left_bytes) {
                    Some(lanes) => {
                        found.maps.insert(map.clone(), lanes);
                    }
                    None => {
                        found.omitted_maps.insert(map.clone());
                    }
                }
            }
            found.scenarios.push(PlannedScenario { name, map });
        }
        Some(found)
    }

    /// The lanes of a map; `None` if it cannot be read, or is longer than a map may be or than what
    /// is left for maps.
    fn lanes(&self, map: &str, left_bytes: &mut usize) -> Option<Vec<Vec<[f64; 2]>>> {
        let most_bytes = limits::PLANNED_MAP_BYTES.min(*left_bytes);
        let bytes = self.read("map.file", map, most_bytes).ok()?;
        // Also of a map that cannot be parsed: it is read but once.
        *left_bytes -= bytes.len();
        Some(outlines(&MapFile::parse(&bytes).ok()?))
    }
}

impl TwinScenarios {
    /// Whether a map was looked at.
    fn has_tried(&self, map: &str) -> bool {
        self.maps.contains_key(map) || self.omitted_maps.contains(map)
    }
}

/// Each lane for cars as a ring: its left edge forward, and its right one backward.
fn outlines(map: &MapFile) -> Vec<Vec<[f64; 2]>> {
    let flat = |point: &[f64; 3]| [point[0], point[1]];
    let driving = map.lanes.iter().filter(|lane| lane.kind == LaneKind::Driving);
    driving
        .map(|lane| lane.left.iter().chain(lane.right.iter().rev()).map(flat).collect())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_listing_ends_when_nobody_wants_it() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a", "b"] {
            let text = format!(
                r#"{{"format": "wildcity.scenario/1", "name": "{name}", "twin": {{"name": "t"}}, "actors": []}}"#
            );
            std::fs::write(dir.path().join(format!("{name}.json")), text).unwrap();
        }
        let scenarios = Scenarios::in_dir(dir.path());
        assert_eq!(scenarios.in_twin("t", &|| true).unwrap().scenarios.len(), 2);
        // Wanted for the first file alone.
        let asked = std::cell::Cell::new(0);
        let is_wanted = || asked.replace(asked.get() + 1) == 0;
        assert_eq!(scenarios.in_twin("t", &is_wanted), None);
        assert_eq!(asked.get(), 2);
    }
}
