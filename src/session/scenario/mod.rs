//! Scenarios: files by name with the tracks and maps beside them, and the traffic of a session's episodes.

mod load;
mod traffic;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::Value;

use wildcity_sim::scenario::{ContactRule, EgoStart, FileError, ScenarioFile};
use wildcity_twin::store::Version;

pub use load::{LoadedScenario, ScenarioError, ScenarioSource, Scenarios};
pub use traffic::{EpisodeTraffic, Event, EventKind};

use crate::options::Start;

/// The scenario of a session, from which each episode is set up with its own seed.
#[derive(Clone, Debug)]
pub(crate) struct SessionScenario {
    scenarios: Scenarios,
    /// With the values of its sweep, without a seed.
    file: ScenarioFile,
}

impl SessionScenario {
    /// Reads a scenario. Values that are not given are the first of its sweep.
    pub(crate) fn read(
        scenarios: Scenarios,
        source: &ScenarioSource,
        values: &BTreeMap<String, Value>,
    ) -> Result<Self, ScenarioError> {
        let document = scenarios.document(source)?;
        let mut chosen = document.first_values();
        chosen.extend(values.iter().map(|(name, value)| (name.clone(), value.clone())));
        let wrong = |cause| ScenarioError::File { file: "scenario".to_owned(), cause };
        let file = document.with(&chosen).map_err(wrong)?;
        if file.end.contact == Some(ContactRule::Static) {
            let path = "end.contact".to_owned();
            let message = "\"static\" is not known to a session; write any, at_fault or pedestrian";
            return Err(wrong(FileError { path, message: message.to_owned() }));
        }
        Ok(Self { scenarios, file })
    }

    /// The scenario of an episode with a seed.
    pub(crate) fn of_episode(
        &self,
        seed: u64,
        version: &Version,
    ) -> Result<Arc<LoadedScenario>, ScenarioError> {
        let pinned = (&version.manifest, version.hash.as_str());
        let file = self.file.clone();
        self.scenarios.resolve(file, seed, pinned, false, &|_| None).map(Arc::new)
    }
}

impl LoadedScenario {
    /// Where the ego starts, if the scenario says.
    pub(crate) fn start(&self) -> Option<Start> {
        self.scenario.start.as_ref().map(|start| match start {
            EgoStart::Pose(pose) => Start::Pose(*pose),
            EgoStart::Station { trajectory, station_m } => {
                Start::Station { trajectory: trajectory.clone(), station_m: *station_m }
            }
        })
    }
}
