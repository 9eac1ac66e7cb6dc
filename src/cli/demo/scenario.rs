//! The scenarios of the demo.

use serde_json::{Map, Value};

use wildcity_twin::store::StoredActor;

/// A scenario of the demo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum DemoScenario {
    /// A van overtakes, moves into the ego's lane and brakes; there is an oncoming car.
    CutIn,
    /// Cars ahead, oncoming cars, and a pedestrian on the crosswalk.
    Traffic,
}

impl DemoScenario {
    fn text(self) -> &'static str {
        match self {
            Self::CutIn => include_str!("../../../scenes/cut-in.json"),
            Self::Traffic => include_str!("../../../scenes/traffic.json"),
        }
    }

    /// Number of steps until all its events have happened.
    pub(super) fn steps(self) -> u32 {
        match self {
            Self::CutIn => 100,
            Self::Traffic => 280,
        }
    }

    /// The scenario with the hashes of these assets in place of their names: other assets of the
    /// user may have the same names.
    pub(super) fn with_assets(self, assets: &[StoredActor]) -> anyhow::Result<Map<String, Value>> {
        let mut file: Map<String, Value> = serde_json::from_str(self.text())?;
        let actors = file.get_mut("actors").and_then(Value::as_array_mut);
        for actor in actors.into_iter().flatten() {
            let name = actor["asset"].as_str().unwrap_or_default();
            if let Some(asset) = assets.iter().find(|asset| asset.description.name == name) {
                // By hash, because a catalog may have several assets of one name.
                actor["asset"] = asset.hash.clone().into();
            }
        }
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_generate::ActorModel;

    #[test]
    fn every_actor_of_the_demo_is_drawn() {
        for scenario in [DemoScenario::CutIn, DemoScenario::Traffic] {
            let file: Value = serde_json::from_str(scenario.text()).unwrap();
            for actor in file["actors"].as_array().unwrap() {
                let asset = actor["asset"].as_str().unwrap_or_default();
                assert!(ActorModel::NAMES.contains(&asset), "{scenario:?}: {actor}");
            }
        }
    }
}
