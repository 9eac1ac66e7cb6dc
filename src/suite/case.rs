//! One episode of a suite before it is driven.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::Deserialize as _;

use wildcity_episode::{DriveStart, ScenarioLine, scenario_line};
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_session::options::{Encoding, ImagePart, Open, Outputs, ScenarioChoice};
use wildcity_session::{
    LoadedScenario, Scenarios, StoredAssets, limits as session, scenario_start,
};
use wildcity_sim::scenario::{Case as Seeded, FileError, Scenario, ScenarioFile, Values};
use wildcity_twin::store::{Catalog, Version};

use crate::cameras;
use crate::error::SuiteError;
use crate::file::{SuiteFile, SuiteScenario};
use crate::limits;

/// A scenario with chosen values and a seed, checked against its twin.
#[derive(Clone, Debug)]
pub struct Case {
    /// Its name, which is that of its session: `SCENARIO-SEED`, or `SCENARIO-COMBINATION-SEED` of a
    /// sweep.
    pub name: String,
    /// Name of the scenario.
    pub scenario: String,
    pub seed: u64,
    /// The values of the sweep.
    pub values: Values,
    /// The scenario with the values of its sweep, resolved against the twin.
    pub resolved: Arc<Scenario>,
    /// The line that heads its record.
    pub line: Arc<ScenarioLine>,
    /// Options of its session.
    pub options: Open,
    /// Where the ego starts, `world_from_rig`.
    pub start: Pose,
    /// The recorded drive that the episode starts on, or that is its route, if there is one.
    pub drive: Option<Arc<Trajectory>>,
    /// Time of that drive at the start of the episode, in microseconds.
    pub drive_start_us: i64,
    /// Steps after which it ends at the latest.
    pub steps: u64,
    /// BLAKE3 of the version's manifest.
    pub version_hash: String,
}

/// Parts of the scenarios to ignore.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CaseOptions {
    /// Versions that scenarios name: the latest versions are used.
    pub latest: bool,
    /// All actors: only the twin remains, on which the agent `log` must pass.
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
    let assets = StoredAssets::new(catalog);
    let mut versions = Versions { catalog, latest: options.latest, opened: BTreeMap::new() };
    let mut cases = Vec::new();
    for scenario in scenarios {
        let mut combinations: Vec<Values> = Vec::new();
        for case in seeded(suite, scenario) {
            // Seeds vary fastest, so that the present combination is the last one of the list.
            if combinations.last() != Some(&case.values) {
                combinations.push(case.values.clone());
            }
            let file = chosen(scenario, &case.values, options.bare)?;
            let name = if case.values.is_empty() {
                format!("{}-{}", file.name, case.seed)
            } else {
                format!("{}-{}-{}", file.name, combinations.len() - 1, case.seed)
            };
            let version = versions.find(&file, suite)?;
            let pinned = (&version.manifest, version.hash.as_str());
            let dir = scenario.path.parent().unwrap_or(Path::new(""));
            let loaded = Scenarios::in_dir(dir)
                .resolve(file, case.seed, pinned, options.latest, &assets)
                .map_err(|cause| SuiteError::Scenario { path: scenario.path.clone(), cause })?;
            let case = Case::new(suite, (scenario.path.as_path(), name), case, loaded, &version)?;
            cases.push(case);
            // Checked for each case, before the rest of a far too long list is resolved.
            if cases.len() > limits::EPISODES {
                return Err(SuiteError::TooMany { count: cases.len() });
            }
        }
    }
    cases.sort_by(|a, b| a.name.cmp(&b.name));
    // Sorted by name, so that equal names are neighbours.
    match cases.windows(2).find(|pair| pair[0].name == pair[1].name) {
        Some(pair) => Err(SuiteError::SameName { name: pair[0].name.clone() }),
        None => Ok(cases),
    }
}

/// A scenario with the values of its sweep; with `bare`, without its actors.
fn chosen(
    scenario: &SuiteScenario,
    values: &Values,
    bare: bool,
) -> Result<ScenarioFile, SuiteError> {
    let wrong = |cause| SuiteError::File { path: scenario.path.clone(), cause };
    let mut file = scenario.document.with(values).map_err(wrong)?;
    // The tracks go as well: recorded actors are actors.
    if bare {
        file.actors.clear();
        file.tracks = None;
    }
    Ok(file)
}

/// The combinations of a scenario; with the seeds of the suite if the scenario has none.
fn seeded(suite: &SuiteFile, scenario: &SuiteScenario) -> Vec<Seeded> {
    let own = scenario.document.cases();
    // Without a sweep of seeds, every case has seed 0.
    let has_own_seeds = own.iter().any(|case| case.seed != 0);
    match (suite.seeds, has_own_seeds) {
        (Some([first, last]), false) => own
            .into_iter()
            .flat_map(|case| {
                (first..=last).map(move |seed| Seeded { seed, values: case.values.clone() })
            })
            .collect(),
        _ => own,
    }
}

/// The versions that the scenarios of a suite play in, each opened once.
struct Versions<'a> {
    catalog: &'a Catalog,
    /// Whether the versions that scenarios name are ignored.
    latest: bool,
    /// By the name of the twin and the hash that the scenario names.
    opened: BTreeMap<(String, Option<String>), Arc<Version>>,
}

impl Versions<'_> {
    /// The version that a scenario names; the latest if it names none. It must have the cameras of
    /// the suite.
    fn find(&mut self, file: &ScenarioFile, suite: &SuiteFile) -> Result<Arc<Version>, SuiteError> {
        let wanted = file.twin.version_hash.clone().filter(|_| !self.latest);
        // The key has the wish and not the version found, so that two scenarios without a wish
        // share the latest.
        let key = (file.twin.name.clone(), wanted);
        if let Some(version) = self.opened.get(&key) {
            return Ok(version.clone());
        }
        let version = Arc::new(self.open(file, key.1.as_deref())?);
        // Once for each version, before it is remembered.
        cameras::check(suite, &version)?;
        self.opened.insert(key, version.clone());
        Ok(version)
    }

    fn open(&self, file: &ScenarioFile, wanted: Option<&str>) -> Result<Version, SuiteError> {
        let twin = &file.twin.name;
        let Some(wanted) = wanted else { return Ok(self.catalog.version(twin, None)?) };
        let versions = self.catalog.versions(twin)?;
        // From the latest on: a rollback gives an old hash another number.
        match versions.into_iter().rev().find(|entry| entry.hash == wanted) {
            Some(entry) => Ok(self.catalog.version(twin, Some(entry.number))?),
            None => Err(SuiteError::NoVersion {
                scenario: file.name.clone(),
                twin: twin.clone(),
                wanted: wanted.to_owned(),
            }),
        }
    }
}

impl Case {
    fn new(
        suite: &SuiteFile,
        (path, name): (&Path, String),
        Seeded { seed, values }: Seeded,
        loaded: LoadedScenario,
        version: &Version,
    ) -> Result<Self, SuiteError> {
        let start = scenario_start(&loaded, &version.manifest)
            .map_err(Box::new)
            .map_err(|cause| SuiteError::Start { path: path.to_owned(), cause })?;
        let LoadedScenario { scenario: resolved, map, hash, .. } = loaded;
        let drives = &version.manifest.trajectories;
        let on_drive = DriveStart::new(&resolved, drives);
        let line = scenario_line(&resolved, map.as_ref(), &hash, drives);
        line.check().map_err(|message| SuiteError::File {
            path: path.to_owned(),
            cause: FileError::new("map", format!("is too large: {message}")),
        })?;
        let dt_us = suite.dt_us.unwrap_or(session::DT_US);
        let steps = match line.limit_us {
            // Rounded up, so that the last step ends at the limit or beyond it and not before.
            Some(limit_us) => (limit_us.max(0) as u64).div_ceil(dt_us.max(1) as u64),
            None => limits::STEPS,
        };
        let scenario = ScenarioChoice::deserialize(&line.scenario).map_err(|error| {
            let cause = FileError::new("scenario", error.to_string());
            SuiteError::File { path: path.to_owned(), cause }
        })?;
        let options = Open {
            version: Some(version.number),
            seed,
            dt_us: Some(dt_us),
            // The resolved scenario has its seed, so that the session samples the same jitter.
            scenario: Some(scenario),
            outputs: outputs(suite, version),
            ..Open::twin(resolved.file.twin.name.clone())
        };
        Ok(Self {
            name,
            scenario: resolved.file.name.clone(),
            seed,
            values,
            line: Arc::new(line),
            options,
            start,
            drive_start_us: on_drive.as_ref().map_or(0, |on_drive| on_drive.start_us),
            drive: on_drive.map(|on_drive| Arc::new(on_drive.drive.clone())),
            steps,
            version_hash: version.hash.clone(),
            resolved: Arc::new(resolved),
        })
    }
}

/// The cameras and sizes of the suite, as raw pixels: no agent looks at them, so none are encoded.
fn outputs(suite: &SuiteFile, version: &Version) -> Outputs {
    let mut outputs = Outputs::colour(Encoding::Raw);
    // Without a drive there is nothing to compare an image with.
    outputs.trust = Some(!version.manifest.trajectories.is_empty());
    outputs.cameras.clone_from(&suite.cameras);
    // A size applies to each camera, so that the cameras must be known by name.
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
