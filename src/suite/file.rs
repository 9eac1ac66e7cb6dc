//! The suite file `wildcity.suite/1`.

use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use wildcity_score::own::Criterion;
use wildcity_sim::scenario::{Document, FileError, ScenarioFile, check_format};

use crate::error::SuiteError;
use crate::limits;

/// A suite: the scenarios, the agent that drives them, and the rendered images.
///
/// ```json
/// {"format": "wildcity.suite/1", "name": "streets",
///  "scenarios": ["straight.json", "pedestrian.json"],
///  "agent": "log", "cameras": ["front"], "size": [320, 180], "seeds": [0, 9]}
/// ```
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SuiteFile {
    /// Name of the format: `wildcity.suite/1`.
    pub format: String,
    /// Name of the suite.
    pub name: String,
    #[serde(default)]
    pub note: Option<String>,
    /// Scenario files, relative to the suite's file.
    pub scenarios: Vec<PathBuf>,
    /// The agent: `log`, `stand`, `idm`, or a command.
    #[serde(default)]
    pub agent: Option<String>,
    /// The first and the last seed of every scenario that has no sweep of seeds.
    #[serde(default)]
    pub seeds: Option<[u64; 2]>,
    /// The cameras that are rendered for built-in agents; if absent, all of the twin's rig.
    #[serde(default)]
    pub cameras: Option<Vec<String>>,
    /// Width and height of their images, in pixels; if absent, those of the rig.
    #[serde(default)]
    pub size: Option<[u64; 2]>,
    /// Simulated time of a step, in microseconds; if absent, 100000.
    #[serde(default)]
    pub dt_us: Option<i64>,
    /// Lower limit of the pass rate, which the lower end of its interval must reach; if absent,
    /// every episode must pass.
    #[serde(default)]
    pub at_least: Option<f64>,
    /// Criteria that need not be judged for a pass, by their names ([`Criterion`]): scenarios
    /// without a map cannot be judged by `off_road`. And `off_model`: episodes that leave the
    /// trained area are no mistake of the run. If absent, an episode passes only if all criteria
    /// were judged.
    #[serde(default)]
    pub accept_unjudged: Vec<String>,
    #[serde(skip)]
    pub path: PathBuf,
}

/// The name in [`SuiteFile::accept_unjudged`] for episodes that leave the trained area.
pub(crate) const OFF_MODEL: &str = "off_model";

/// A scenario of a suite.
#[derive(Clone, Debug, PartialEq)]
pub struct SuiteScenario {
    pub path: PathBuf,
    pub document: Document,
}

impl SuiteFile {
    /// The format that this build reads.
    pub const FORMAT: &str = "wildcity.suite/1";

    /// Reads a suite with all of its scenarios. A scenario's file is a suite of only that scenario.
    ///
    /// # Errors
    /// Names the file and the place of the first mistake.
    pub fn read(path: &Path) -> Result<(Self, Vec<SuiteScenario>), SuiteError> {
        let bytes = read(path, limits::FILE_BYTES)?;
        let wrong = |cause| SuiteError::File { path: path.to_owned(), cause };
        let value: serde_json::Value = serde_json::from_slice(&bytes)
            .map_err(|error| wrong(FileError::new("suite", format!("not JSON: {error}"))))?;
        // The format decides and not the name of the file, so that a scenario can be run by itself.
        if value.get("format").and_then(serde_json::Value::as_str) == Some(ScenarioFile::FORMAT) {
            let document = Document::from_json(value).map_err(wrong)?;
            let suite = Self::single(path);
            return Ok((suite, vec![SuiteScenario { path: path.to_owned(), document }]));
        }
        let mut suite: Self = serde_path_to_error::deserialize(value).map_err(|error| {
            let at = error.path().to_string();
            wrong(FileError::new(at, error.into_inner().to_string()))
        })?;
        suite.path = path.to_owned();
        suite.check().map_err(wrong)?;
        // Scenarios are beside the suite and not in the working directory.
        let dir = path.parent().unwrap_or(Path::new("."));
        let mut scenarios = Vec::new();
        for (index, file) in suite.scenarios.iter().enumerate() {
            let path = dir.join(file);
            let wrong = |cause| SuiteError::File { path: path.clone(), cause };
            // A missing scenario is a mistake of the suite; one that is malformed is a mistake of
            // its own file.
            let bytes = read(&path, limits::FILE_BYTES).map_err(|error| {
                let cause = FileError::new(format!("scenarios[{index}]"), error.to_string());
                SuiteError::File { path: suite.path.clone(), cause }
            })?;
            let document = Document::parse(&bytes).map_err(wrong)?;
            if path.parent() != Some(dir) {
                check_alone(&document).map_err(wrong)?;
            }
            scenarios.push(SuiteScenario { path, document });
        }
        Ok((suite, scenarios))
    }

    /// The suite of one scenario.
    fn single(path: &Path) -> Self {
        let name = path.file_stem().map(|name| name.to_string_lossy().into_owned());
        Self {
            format: Self::FORMAT.to_owned(),
            name: name.unwrap_or_default(),
            note: None,
            scenarios: vec![path.to_owned()],
            agent: None,
            seeds: None,
            cameras: None,
            size: None,
            dt_us: None,
            at_least: None,
            accept_unjudged: Vec::new(),
            path: path.to_owned(),
        }
    }

    fn check(&self) -> Result<(), FileError> {
        check_format(Some(&self.format), Self::FORMAT)?;
        if self.scenarios.is_empty() {
            return Err(FileError::new("scenarios", "is empty; name at least one scenario"));
        }
        if let Some([first, last]) = self.seeds
            && first > last
        {
            let message = format!("[{first}, {last}]; write the first and the last seed");
            return Err(FileError::new("seeds", message));
        }
        // Before the range becomes a list: 2^64 seeds take all memory.
        let most = limits::EPISODES as u64;
        if let Some([first, last]) = self.seeds
            && last - first >= most
        {
            let message = format!("[{first}, {last}] are more than {most} seeds; name fewer");
            return Err(FileError::new("seeds", message));
        }
        check_criteria(&self.accept_unjudged)
            .map_err(|message| FileError::new("accept_unjudged", message))?;
        match self.at_least {
            Some(rate) if !(0.0..=1.0).contains(&rate) => {
                Err(FileError::new("at_least", format!("{rate:?}; a rate is from 0 to 1")))
            }
            _ => Ok(()),
        }
    }
}

/// Checks names of criteria that need not be judged. The error names the first that is none, and
/// those that there are.
pub fn check_criteria(names: &[String]) -> Result<(), String> {
    let mut known = Criterion::ALL.map(Criterion::name).to_vec();
    known.push(OFF_MODEL);
    match names.iter().find(|name| !known.contains(&name.as_str())) {
        None => Ok(()),
        Some(unknown) => Err(format!("{unknown:?} is no criterion; there is {}", known.join(", "))),
    }
}

/// Refuses a scenario that names files in its own directory, because sessions look for them in the
/// directory of the suite.
fn check_alone(document: &Document) -> Result<(), FileError> {
    let file = document.with(&document.first_values())?;
    let fields = [("map.file", file.map.is_some()), ("tracks.file", file.tracks.is_some())];
    match fields.into_iter().find(|(_, is_named)| *is_named) {
        None => Ok(()),
        Some((field, _)) => {
            let message = "is looked for beside the suite: put the scenario there too";
            Err(FileError::new(field, message))
        }
    }
}

/// Reads a file of at most `limit_bytes`.
pub(crate) fn read(path: &Path, limit_bytes: u64) -> Result<Vec<u8>, SuiteError> {
    let failed = |cause| SuiteError::Io { what: "read", path: path.to_owned(), cause };
    // The size is looked at first, so that a wrong path to a large file is not read into memory.
    let bytes = fs::metadata(path).map_err(failed)?.len();
    if bytes > limit_bytes {
        return Err(SuiteError::TooLarge { path: path.to_owned(), bytes, limit_bytes });
    }
    fs::read(path).map_err(failed)
}
