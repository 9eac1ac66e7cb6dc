//! One episode of a suite before it is driven.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use serde_json::Value;

use wildcity_episode::{ActorLine, EgoLine, RoutePoint, ScenarioLine};
use wildcity_scene::Trajectory;
use wildcity_scene::route::Route;
use wildcity_session::{Encoding, ImagePart, Outputs, SessionOptions, Start, limits as session};
use wildcity_sim::map::{Map, MapFile};
use wildcity_sim::scenario::{EgoStart, FileError, FilePin, Scenario, Surroundings, TracksFile};
use wildcity_twin::store::{Catalog, Version};

use crate::error::SuiteError;
use crate::file::{SuiteFile, SuiteScenario, read};
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

/// All cases of a suite, in order of their names. With `latest`, versions that scenarios name are ignored.
///
/// # Errors
/// Names the file and the place of the first mistake, or the version that is missing.
pub fn cases(
    suite: &SuiteFile,
    scenarios: &[SuiteScenario],
    catalog: &Catalog,
    latest: bool,
) -> Result<Vec<Case>, SuiteError> {
    let mut versions: BTreeMap<(String, Option<String>), Arc<Version>> = BTreeMap::new();
    let mut cases = Vec::new();
    let mut names = BTreeSet::new();
    for scenario in scenarios {
        let wrong = |cause| SuiteError::File { path: scenario.path.clone(), cause };
        let mut combinations: Vec<BTreeMap<String, Value>> = Vec::new();
        for case in seeded(suite, scenario) {
            let file = scenario.document.with(&case.values).map_err(wrong)?;
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
            let around = Around::read(
                &scenario.path,
                file.tracks.as_ref().map(|t| &t.file),
                file.map.as_ref(),
            )?;
            let resolved = Scenario::resolve(
                file,
                case.seed,
                &Surroundings {
                    drives: &version.manifest.trajectories,
                    tracks: around.tracks.as_ref(),
                    map: around.map.as_ref(),
                    asset: &|_| None,
                },
            )
            .map_err(wrong)?;
            if !resolved.traffic.actors.is_empty() {
                let message =
                    "suites drive without other traffic yet; remove the actors and the tracks";
                return Err(wrong(FileError { path: "actors".into(), message: message.into() }));
            }
            cases.push(
                Case::new(suite, name, case.seed, case.values, resolved, &version)
                    .map_err(wrong)?,
            );
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

/// The files that a scenario names.
struct Around {
    tracks: Option<TracksFile>,
    map: Option<Map>,
}

impl Around {
    fn read(
        scenario: &Path,
        tracks: Option<&String>,
        map: Option<&FilePin>,
    ) -> Result<Self, SuiteError> {
        let dir = scenario.parent().unwrap_or(Path::new("."));
        let tracks = tracks.map(|file| {
            let path = dir.join(file);
            TracksFile::parse(&read(&path)?).map_err(|cause| SuiteError::File { path, cause })
        });
        let map = map.map(|pin| {
            let path = dir.join(&pin.file);
            let file = MapFile::parse(&read(&path)?).and_then(Map::new);
            file.map_err(|cause| SuiteError::File { path, cause })
        });
        Ok(Self { tracks: tracks.transpose()?, map: map.transpose()? })
    }
}

impl Case {
    fn new(
        suite: &SuiteFile,
        name: String,
        seed: u64,
        values: BTreeMap<String, Value>,
        resolved: Scenario,
        version: &Version,
    ) -> Result<Self, FileError> {
        let drives = &version.manifest.trajectories;
        let drive = match &resolved.start {
            Some(EgoStart::Station { trajectory, .. }) => {
                drives.iter().find(|drive| drive.name == *trajectory)
            }
            Some(EgoStart::Pose(_)) => None,
            None => drives.first(),
        };
        let station_m = match &resolved.start {
            Some(EgoStart::Station { station_m, .. }) => *station_m,
            _ => 0.0,
        };
        let drive_start_us = match drive {
            Some(drive) => {
                let route = Route::new(drive).map_err(|error| FileError {
                    path: "ego.start.trajectory".to_owned(),
                    message: error.to_string(),
                })?;
                route.at(station_m).time_us
            }
            None => 0,
        };
        let dt_us = suite.dt_us.unwrap_or(session::DT_US);
        let drive_left_us = drive
            .and_then(|drive| drive.keyframes.last())
            .map(|last| last.time_us - drive_start_us);
        let limit_us = resolved.end.time_us.or(drive_left_us);
        let steps = match limit_us {
            Some(limit_us) => (limit_us.max(0) as u64).div_ceil(dt_us.max(1) as u64),
            None => limits::STEPS,
        };
        let route = match drive {
            Some(drive) => recorded_route(drive, drive_start_us, limit_us),
            None => planned_route(&resolved, limit_us),
        };
        let file = serde_json::to_value(&resolved.file).unwrap_or_default();
        let least_progress = resolved.file.verdict.progress;
        let line = ScenarioLine {
            name: resolved.file.name.clone(),
            hash: blake3::hash(file.to_string().as_bytes()).to_hex().to_string(),
            scenario: file,
            ego: EgoLine::new(&resolved.traffic.ego_box),
            actors: resolved
                .traffic
                .actors
                .iter()
                .map(|actor| ActorLine::new(&actor.spec))
                .collect(),
            route,
            limit_us,
            least_progress: least_progress.unwrap_or(wildcity_score::own::LEAST_PROGRESS),
            lanes: Vec::new(),
            checks_static: false,
        };
        let start = resolved.start.as_ref().map(|start| match start {
            EgoStart::Pose(pose) => Start::Pose(*pose),
            EgoStart::Station { trajectory, station_m } => {
                Start::Station { trajectory: trajectory.clone(), station_m: *station_m }
            }
        });
        let options = SessionOptions {
            version: Some(version.number),
            seed,
            start,
            dynamics: resolved.dynamics.unwrap_or_default(),
            dt_us: Some(dt_us),
            warm_up_us: resolved.warm_up_us.unwrap_or(0),
            ..SessionOptions::twin(resolved.file.twin.name.clone(), outputs(suite, version))
        };
        Ok(Self {
            name,
            scenario: resolved.file.name.clone(),
            seed,
            values,
            line: Arc::new(line),
            options,
            drive: drive.cloned().map(Arc::new),
            drive_start_us,
            steps,
            version_hash: version.hash.clone(),
            resolved: Arc::new(resolved),
        })
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

/// The recorded drive from the start on, as long as the episode may take.
fn recorded_route(drive: &Trajectory, start_us: i64, limit_us: Option<i64>) -> Vec<RoutePoint> {
    let end_us = limit_us.map_or(i64::MAX, |limit_us| start_us.saturating_add(limit_us));
    let at = |time_us: i64| {
        let pose = pose_at(drive, time_us);
        RoutePoint(time_us - start_us, pose.position_m.to_array())
    };
    let between = drive.keyframes.iter().map(|key| key.time_us);
    let between = between.filter(|time_us| (start_us + 1..end_us).contains(time_us));
    let last_us = drive.keyframes.last().map_or(start_us, |last| last.time_us);
    let last_us = last_us.min(end_us).max(start_us);
    let mut route: Vec<RoutePoint> = std::iter::once(start_us).chain(between).map(at).collect();
    if route.last().is_some_and(|last| last.0 < last_us - start_us) {
        route.push(at(last_us));
    }
    route
}

/// A route that was not driven: due evenly over the time of the scenario.
fn planned_route(resolved: &Scenario, limit_us: Option<i64>) -> Vec<RoutePoint> {
    const SPACING_M: f64 = 2.0;
    let (Some(route), Some(limit_us)) = (&resolved.route, limit_us) else { return Vec::new() };
    let length_m = route.course.length_m();
    let count = (length_m / SPACING_M).ceil().max(1.0) as i64;
    let point = |k: i64| {
        let share = k as f64 / count as f64;
        let place_m = route.course.point_m(share * length_m);
        RoutePoint((share * limit_us as f64) as i64, place_m.to_array())
    };
    (0..=count).map(point).collect()
}

/// The pose of a drive at a time; constant beyond its ends.
pub(crate) fn pose_at(drive: &Trajectory, time_us: i64) -> wildcity_scene::geometry::Pose {
    let keys = &drive.keyframes;
    let after = keys.partition_point(|key| key.time_us < time_us);
    match (after.checked_sub(1).map(|before| &keys[before]), keys.get(after)) {
        (None, Some(first)) => first.world_from_rig,
        (Some(last), None) => last.world_from_rig,
        (Some(_), Some(to)) if to.time_us == time_us => to.world_from_rig,
        (Some(from), Some(to)) => {
            let t = (time_us - from.time_us) as f64 / (to.time_us - from.time_us) as f64;
            from.world_from_rig.interpolate(&to.world_from_rig, t)
        }
        (None, None) => wildcity_scene::geometry::Pose::IDENTITY,
    }
}
