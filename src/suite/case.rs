//! One episode of a suite before it is driven.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use serde_json::Value;

use wildcity_episode::{DriveStart, ScenarioLine, scenario_line};
use wildcity_scene::Trajectory;
use wildcity_session::{
    Encoding, ImagePart, LoadedScenario, Outputs, ScenarioOptions, ScenarioSource, Scenarios,
    SessionOptions, Start, limits as session,
};
use wildcity_sim::scenario::{EgoStart, Scenario};
use wildcity_twin::store::{Catalog, Version};

use crate::error::SuiteError;
use crate::file::{SuiteFile, SuiteScenario};
use crate::limits;

/// A scenario with chosen values and a seed, checked against its twin.
#[derive(Clone, Debug)]
pub struct Case {
    /// Its name, which is that of its session: `SCENARIO-SEED`, or `SCENARIO-COMBINATION-SEED` of a sweep.
    pub name: String,
    /// Name of the scenario.
    pub scenario: String,
    /// The seed.
    pub seed: u64,
    /// The values of the sweep.
    pub values: BTreeMap<String, Value>,
    /// The scenario, resolved.
    pub resolved: Arc<Scenario>,
    /// The line that heads its record.
    pub line: Arc<ScenarioLine>,
    /// What is opened.
    pub options: SessionOptions,
    /// The recorded drive that the episode starts on, if it does.
    pub drive: Option<Arc<Trajectory>>,
    /// Time of that drive at the start of the episode, in microseconds.
    pub drive_start_us: i64,
    /// Steps after which it ends at the latest.
    pub steps: u64,
    /// BLAKE3 of the version's manifest.
    pub version_hash: String,
}

/// What of the scenarios is left out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CaseOptions {
    /// Versions that scenarios name: the latest ones are taken.
    pub latest: bool,
    /// All actors: what is left is the twin, on which the agent `log` must pass.
    pub bare: bool,
}

/// All cases of a suite, in order of their names.
///
/// # Errors
/// Names the file and the place of the first mistake, or the version that is missing.
pub fn cases(
    suite: &SuiteFile,
    scenarios: &[SuiteScenario],
    catalog: &Catalog,
    options: CaseOptions,
) -> Result<Vec<Case>, SuiteError> {
    let CaseOptions { latest, bare } = options;
    let mut versions: BTreeMap<(String, Option<String>), Arc<Version>> = BTreeMap::new();
    let mut cases = Vec::new();
    let mut names = BTreeSet::new();
    for scenario in scenarios {
        let wrong = |cause| SuiteError::File { path: scenario.path.clone(), cause };
        let mut combinations: Vec<BTreeMap<String, Value>> = Vec::new();
        for case in seeded(suite, scenario) {
            let mut file = scenario.document.with(&case.values).map_err(wrong)?;
            if bare {
                file.actors.clear();
                file.tracks = None;
            }
            let pin = file.twin.version_hash.clone().filter(|_| !latest);
            let key = (file.twin.name.clone(), pin.clone());
            let version = match versions.get(&key) {
                Some(version) => version.clone(),
                None => {
                    let version = Arc::new(open(catalog, &file.name, &file.twin.name, pin)?);
                    versions.insert(key, version.clone());
                    version
                }
            };
            let combination = match combinations.iter().position(|other| *other == case.values) {
                Some(combination) => combination,
                None => {
                    combinations.push(case.values.clone());
                    combinations.len() - 1
                }
            };
            let name = match case.values.is_empty() {
                true => format!("{}-{}", file.name, case.seed),
                false => format!("{}-{combination}-{}", file.name, case.seed),
            };
            if !names.insert(name.clone()) {
                return Err(SuiteError::SameName { name });
            }
            let dir = scenario.path.parent().unwrap_or(Path::new("."));
            let pinned = (&version.manifest, version.hash.as_str());
            let loaded = Scenarios::in_dir(dir)
                .resolve(file, case.seed, pinned, latest, &|_| None)
                .map_err(|cause| SuiteError::Scenario { path: scenario.path.clone(), cause })?;
            cases.push(Case::new(suite, name, case.seed, case.values, loaded, &version));
            if cases.len() > limits::EPISODES {
                return Err(SuiteError::TooMany { count: cases.len() });
            }
        }
    }
    cases.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(cases)
}

/// The combinations of a scenario; the seeds of the suite if it has none of its own.
fn seeded(suite: &SuiteFile, scenario: &SuiteScenario) -> Vec<wildcity_sim::scenario::Case> {
    let own = scenario.document.cases();
    let has_own_seeds = own.iter().any(|case| case.seed != 0);
    match (suite.seeds, has_own_seeds) {
        (Some([first, last]), false) => own
            .into_iter()
            .flat_map(|case| {
                (first..=last).map(move |seed| wildcity_sim::scenario::Case {
                    seed,
                    values: case.values.clone(),
                })
            })
            .collect(),
        _ => own,
    }
}

/// The version of a twin that a scenario names; the latest if it names none.
fn open(
    catalog: &Catalog,
    scenario: &str,
    twin: &str,
    pin: Option<String>,
) -> Result<Version, SuiteError> {
    let Some(wanted) = pin else { return Ok(catalog.version(twin, None)?) };
    let found = catalog.versions(twin)?.into_iter().rev().find(|entry| entry.hash == wanted);
    match found {
        Some(entry) => Ok(catalog.version(twin, Some(entry.number))?),
        None => Err(SuiteError::NoVersion {
            scenario: scenario.to_owned(),
            twin: twin.to_owned(),
            wanted,
        }),
    }
}

impl Case {
    fn new(
        suite: &SuiteFile,
        name: String,
        seed: u64,
        values: BTreeMap<String, Value>,
        loaded: LoadedScenario,
        version: &Version,
    ) -> Self {
        let LoadedScenario { scenario: resolved, map, hash, .. } = loaded;
        let drives = &version.manifest.trajectories;
        let start = DriveStart::of(&resolved, drives);
        let line = scenario_line(&resolved, map.as_ref(), &hash, drives);
        let dt_us = suite.dt_us.unwrap_or(session::DT_US);
        let steps = match line.limit_us {
            Some(limit_us) => (limit_us.max(0) as u64).div_ceil(dt_us.max(1) as u64),
            None => limits::STEPS,
        };
        let options = SessionOptions {
            version: Some(version.number),
            seed,
            start: resolved.start.as_ref().map(|start| match start {
                EgoStart::Pose(pose) => Start::Pose(*pose),
                EgoStart::Station { trajectory, station_m } => {
                    Start::Station { trajectory: trajectory.clone(), station_m: *station_m }
                }
            }),
            dynamics: resolved.dynamics.unwrap_or_default(),
            dt_us: Some(dt_us),
            warm_up_us: resolved.warm_up_us.unwrap_or(0),
            // The resolved scenario has its seed, so that the session draws the same jitter.
            scenario: Some(ScenarioOptions {
                source: ScenarioSource::Inline(line.scenario.clone()),
                values: BTreeMap::new(),
                dynamics: true,
                warm_up: true,
                actors: false,
            }),
            ..SessionOptions::twin(resolved.file.twin.name.clone(), outputs(suite, version))
        };
        Self {
            name,
            scenario: resolved.file.name.clone(),
            seed,
            values,
            line: Arc::new(line),
            options,
            drive_start_us: start.as_ref().map_or(0, |start| start.start_us),
            drive: start.map(|start| Arc::new(start.drive.clone())),
            steps,
            version_hash: version.hash.clone(),
            resolved: Arc::new(resolved),
        }
    }
}

/// The cameras and sizes of the suite, as raw pixels: no agent looks at them, so none are encoded.
fn outputs(suite: &SuiteFile, version: &Version) -> Outputs {
    let mut outputs = Outputs::colour(Encoding::Raw);
    outputs.trust = true;
    outputs.cameras.clone_from(&suite.cameras);
    if let Some(size) = suite.size {
        let of_rig = || {
            let rig = version.manifest.rig.as_ref();
            rig.map_or(Vec::new(), |rig| rig.cameras.iter().map(|c| c.name.clone()).collect())
        };
        let cameras = suite.cameras.clone().unwrap_or_else(of_rig);
        let part = ImagePart { crop: None, size: Some(size) };
        outputs.images = cameras.into_iter().map(|camera| (camera, part)).collect();
    }
    outputs
}
