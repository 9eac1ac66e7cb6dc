//! Scenarios: files by name with their tracks and maps, and the traffic of a session's episodes.

pub(crate) mod assets;
mod default_assets;
pub(crate) mod load;
pub(crate) mod past;
mod plan;
mod traffic;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::Value;

use wildcity_options::Start;
use wildcity_sim::scenario::{EgoStart, ScenarioFile};
use wildcity_twin::store::Version;

pub use assets::StoredAssets;
pub use default_assets::generated_actors;
pub use load::{LoadedScenario, ScenarioError, ScenarioSource, Scenarios};
pub use plan::{PlannedScenario, TwinScenarios};
pub(crate) use traffic::settle;
pub use traffic::{EpisodeTraffic, Event, EventKind};

use self::assets::{ActorAssets, GeneratedActors};
use crate::engine::Engine;
use crate::error::SessionError;

/// The scenario of an episode, and the assets of its actors.
#[derive(Clone, Debug)]
pub(crate) struct EpisodeScenario {
    pub(crate) loaded: Arc<LoadedScenario>,
    pub(crate) assets: ActorAssets,
}

/// The scenario of a session, from which each episode is set up with its own seed.
#[derive(Clone, Debug)]
pub(crate) struct SessionScenario {
    scenarios: Scenarios,
    /// With the values of its sweep, without a seed.
    file: ScenarioFile,
    /// Whether episodes start where the scenario's ego section says, because the request named no
    /// start.
    gives_start: bool,
    generated: GeneratedActors,
}

impl SessionScenario {
    /// Reads a scenario. Values that are not given are the first of its sweep.
    pub(crate) fn read(
        scenarios: Scenarios,
        source: &ScenarioSource,
        values: &BTreeMap<String, Value>,
        gives_start: bool,
    ) -> Result<Self, ScenarioError> {
        let file = scenarios.file(source, values)?;
        let scenarios = scenarios.for_source(source);
        Ok(Self { scenarios, file, gives_start, generated: Arc::default() })
    }

    /// The scenario of an episode with a seed, and the assets of its actors, in memory, which
    /// counts as that of answers.
    ///
    /// # Errors
    /// It cannot be read or resolved, or too little memory is left for it.
    pub(crate) fn for_episode(
        &self,
        seed: u64,
        version: &Version,
        engine: &Engine,
    ) -> Result<EpisodeScenario, SessionError> {
        let cache = engine.cache();
        let pinned = (&version.manifest, version.hash.as_str());
        let file = self.file.clone();
        let assets = StoredAssets::sharing(cache.catalog(), self.generated.clone());
        // Pinned, never the latest: all episodes of a session play in the same files.
        let loaded = self.scenarios.resolve(file, seed, pinned, false, &assets)?;
        let share = engine
            .answer_budget()
            .reserve(loaded.memory_bytes)
            .map_err(|_| SessionError::Busy { what: "too little memory is left for scenarios" })?;
        let actors = loaded.scenario.traffic.actors.iter();
        let assets = ActorAssets::load(cache, actors.map(|actor| actor.spec.asset.as_deref()))?;
        let assets = assets.with_share(share);
        Ok(EpisodeScenario { loaded: Arc::new(loaded), assets })
    }

    /// Takes the assets of an episode for all that follow: a name may stand for another asset
    /// later.
    pub(crate) fn pin_assets(&mut self, first: &LoadedScenario) {
        // Both come from the same file, so that actors are in the same order.
        for (actor, pinned) in self.file.actors.iter_mut().zip(&first.scenario.file.actors) {
            actor.asset.clone_from(&pinned.asset);
            // An actor that got its asset by its size keeps this size.
            actor.size = pinned.size;
        }
    }

    /// The start of an episode, if the scenario gives it.
    pub(crate) fn start(&self, loaded: &LoadedScenario) -> Option<Start> {
        loaded.scenario.start.as_ref().filter(|_| self.gives_start).map(requested_start)
    }
}

/// The start of a scenario, as a request has it.
pub(crate) fn requested_start(start: &EgoStart) -> Start {
    match start {
        EgoStart::Pose(pose) => Start::Pose { pose: (*pose).into() },
        EgoStart::Station { trajectory, station_m } => {
            Start::Station { trajectory: trajectory.clone(), station_m: *station_m }
        }
    }
}
