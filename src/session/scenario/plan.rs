//! What the scenarios of a twin look like from above, before one of them is opened.

use std::collections::BTreeMap;

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
    /// it says no twin. A map is left out that cannot be read, or with which all maps would have
    /// more than [`limits::PLANNED_MAP_BYTES`]; opening the scenario says what is wrong.
    pub fn in_twin(&self, twin: &str) -> TwinScenarios {
        let mut found = TwinScenarios::default();
        let mut left_bytes = limits::PLANNED_MAP_BYTES;
        for name in self.names() {
            let source = ScenarioSource::Named(name.clone());
            let Ok(file) = self.file(&source, &BTreeMap::new()) else { continue };
            if file.twin.name != twin {
                continue;
            }
            let map = file.map.map(|pin| pin.file);
            if let Some(map) = map.as_ref().filter(|map| !found.maps.contains_key(*map))
                && let Ok(bytes) = self.read("map.file", map, left_bytes)
                && let Ok(parsed) = MapFile::parse(&bytes)
            {
                left_bytes -= bytes.len();
                found.maps.insert(map.clone(), outlines(&parsed));
            }
            found.scenarios.push(PlannedScenario { name, map });
        }
        found
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
