//! Reads scenarios, and the files that they name, from one directory.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::Value;

use wildcity_options::ScenarioChoice;
use wildcity_scene::Manifest;
use wildcity_scene::rig::is_name;
use wildcity_sim::limits::{MAP_BYTES, SCENARIO_BYTES};
use wildcity_sim::map::{LaneSurface, Map, MapFile};
use wildcity_sim::scenario::{
    Assets, Document, FileError, Scenario, ScenarioFile, Surroundings, TracksFile,
};
use wildcity_sim::traffic::{Behaviour, Course};

/// A directory of scenarios: `NAME.json`, and the tracks and maps that they name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scenarios {
    dir: PathBuf,
    /// Whether files are named by a scenario of a client and not of the directory.
    is_inline: bool,
}

/// Where the document of a scenario comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum ScenarioSource {
    /// A file of the server's directory, by its name without `.json`.
    Named(String),
    /// The scenario itself, as JSON.
    Inline(Value),
}

impl ScenarioSource {
    /// A scenario's name, its name with values, or the scenario itself, which has a format; and the
    /// values of its sweep.
    ///
    /// # Errors
    /// [`ScenarioError::Choice`]: an object is none of these.
    pub fn from_choice(
        choice: ScenarioChoice,
    ) -> Result<(Self, BTreeMap<String, Value>), ScenarioError> {
        let mut object = match choice {
            ScenarioChoice::Name(name) => return Ok((Self::Named(name), BTreeMap::new())),
            ScenarioChoice::Object(object) => object,
        };
        if object.contains_key("format") {
            return Ok((Self::Inline(Value::Object(object)), BTreeMap::new()));
        }
        let wrong = |field: &str, reason| ScenarioError::Choice {
            field: format!("scenario{field}"),
            reason,
        };
        let name = match object.remove("name") {
            Some(Value::String(name)) => name,
            Some(_) => {
                return Err(wrong(".name", "write the name of one of the server's scenarios"));
            }
            None => {
                // An empty object may be meant as either form.
                let field = if object.is_empty() { "" } else { ".name" };
                let reason = "write the format of a scenario, or the name of one of the server's";
                return Err(wrong(field, reason));
            }
        };
        let values = match object.remove("values") {
            None => serde_json::Map::new(),
            Some(Value::Object(values)) => values,
            Some(_) => {
                return Err(wrong(".values", "write an object of values by their names"));
            }
        };
        // What was read is removed, so that the rest is unknown.
        if let Some(field) = object.keys().next() {
            let field = format!(".{field}");
            return Err(wrong(&field, "there is no such field; name and values are"));
        }
        Ok((Self::Named(name), values.into_iter().collect()))
    }
}

/// A scenario that was read for a seed and a version of its twin.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedScenario {
    pub scenario: Scenario,
    /// Its lanes, if it names a map.
    pub map: Option<Map>,
    /// BLAKE3 of the resolved scenario's JSON, in hex: the identity of its episodes.
    pub hash: String,
    /// Hashes that differ from those that the scenario names; always empty unless they are ignored.
    pub unpinned: Vec<String>,
    /// About how much memory it takes, in bytes: of its actors and triggers, and of its map and its
    /// tracks, which take several times the bytes of their files.
    pub(crate) memory_bytes: u64,
}

impl LoadedScenario {
    /// The road under the lanes of its map, if it names one.
    pub(crate) fn lanes(&self) -> Option<&LaneSurface> {
        self.map.as_ref().map(Map::surface)
    }
}

/// Why a scenario cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScenarioError {
    /// The object of the request is neither a scenario nor a name with values.
    #[error("not a request: {field}: {reason}")]
    Choice {
        /// The field of the request, as on the wire.
        field: String,
        reason: &'static str,
    },
    /// There is no file of this name.
    #[error("there is no scenario {name:?}; there is {}", joined(known))]
    Unknown {
        name: String,
        /// The names of the directory.
        known: Vec<String>,
    },
    /// There is no such scenario for a client that may not know the others.
    #[error("there is no scenario of this name that plays in this twin")]
    NotForTwin,
    /// A file cannot be read.
    #[error("{field}: cannot read {file:?}: {reason}")]
    Read {
        /// The field of the scenario that names it.
        field: &'static str,
        /// The name of the file.
        file: String,
        /// The operating system's message.
        reason: String,
    },
    /// A mistake in a file.
    #[error("{}", file_message(file, cause))]
    File {
        /// Which file: `scenario`, or its name.
        file: String,
        /// The place and the mistake.
        cause: FileError,
    },
    /// A file or a twin differs from the one that the scenario was made for.
    #[error(
        "{field} is {wanted}, and there is {found}: take what the scenario names, correct the hash, or use \
         --latest"
    )]
    Hash {
        /// The field that names the hash.
        field: &'static str,
        /// The hash that the scenario names.
        wanted: String,
        /// The hash that was found.
        found: String,
    },
    /// The scenario plays in another twin.
    #[error("the scenario plays in twin {wanted:?}, and {requested:?} was opened: open {wanted:?}")]
    Twin { wanted: String, requested: String },
}

/// The place of a mistake is said once if it is the file itself.
fn file_message(file: &str, cause: &FileError) -> String {
    if cause.path == file { cause.to_string() } else { format!("{file}: {cause}") }
}

impl ScenarioError {
    /// The field at fault, from the scenario on.
    pub fn field(&self) -> String {
        match self {
            Self::Choice { field, .. } => field.clone(),
            Self::Unknown { .. } | Self::NotForTwin => "scenario".to_owned(),
            Self::Read { field, .. } | Self::Hash { field, .. } => format!("scenario.{field}"),
            // The path of a mistake in the file as a whole is that of the file.
            Self::File { file, cause } if file == "scenario" && cause.path != *file => {
                format!("scenario.{}", cause.path)
            }
            Self::File { .. } => "scenario".to_owned(),
            Self::Twin { .. } => "scenario.twin.name".to_owned(),
        }
    }
}

impl Scenarios {
    /// The scenarios of a directory, which need not exist.
    pub fn in_dir(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into(), is_inline: false }
    }

    /// The directory as an inline scenario sees it: a client may name any file of it, and what is
    /// wrong with one is the same for all, so that it learns nothing of others.
    pub(crate) fn for_source(self, source: &ScenarioSource) -> Self {
        Self { is_inline: matches!(source, ScenarioSource::Inline(_)), ..self }
    }

    /// The names of the scenarios, in order.
    pub fn names(&self) -> Vec<String> {
        // A directory that cannot be read has no scenarios.
        let entries = std::fs::read_dir(&self.dir).into_iter().flatten().flatten();
        let files = entries.map(|entry| entry.path());
        let scenarios = files.filter(|path| path.extension().is_some_and(|name| name == "json"));
        let is_scenario = |path: &PathBuf| {
            // Tracks and maps are JSON as well. They are distinguished by a prefix, without reading
            // the whole files.
            let mut head = vec![0; 4096];
            let read = File::open(path).and_then(|mut file| file.read(&mut head));
            read.is_ok_and(|count| {
                String::from_utf8_lossy(&head[..count]).contains(ScenarioFile::FORMAT)
            })
        };
        let stem = |path: PathBuf| Some(path.file_stem()?.to_str()?.to_owned());
        let mut names: Vec<String> = scenarios.filter(is_scenario).filter_map(stem).collect();
        names.sort();
        names
    }

    /// Reads a scenario with its sweep.
    ///
    /// # Errors
    /// There is no such file, or it is malformed.
    pub fn document(&self, source: &ScenarioSource) -> Result<Document, ScenarioError> {
        let parsed = match source {
            ScenarioSource::Inline(value) => Document::from_json(value.clone()),
            ScenarioSource::Named(name) => {
                let file = format!("{name}.json");
                let unknown = || ScenarioError::Unknown { name: name.clone(), known: self.names() };
                let path = self.dir.join(&file);
                // What is no name is not looked up: it could be a path.
                if !is_name(name) || !path.is_file() {
                    return Err(unknown());
                }
                Document::parse(&self.read("scenario", &file, SCENARIO_BYTES)?)
            }
        };
        parsed.map_err(|cause| ScenarioError::File { file: "scenario".to_owned(), cause })
    }

    /// Resolves a scenario in a version of its twin. With `latest`, hashes that differ are noted
    /// and not refused.
    ///
    /// # Errors
    /// A mistake in the scenario or in a file that it names, or a hash that differs.
    pub fn resolve(
        &self,
        mut file: ScenarioFile,
        seed: u64,
        (manifest, version_hash): (&Manifest, &str),
        latest: bool,
        assets: &dyn Assets,
    ) -> Result<LoadedScenario, ScenarioError> {
        if file.twin.name != manifest.twin {
            return Err(ScenarioError::Twin {
                wanted: file.twin.name,
                requested: manifest.twin.clone(),
            });
        }
        let mut pins = Pins { latest, unpinned: Vec::new() };
        let mut file_bytes = 0;
        // In the order in which a wrong version would show: another twin explains all other
        // mistakes.
        pins.check("twin.version_hash", &mut file.twin.version_hash, version_hash)?;
        let wrong = |file: &str| {
            let file = file.to_owned();
            move |cause| ScenarioError::File { file, cause }
        };
        let map = match &mut file.map {
            None => None,
            Some(pin) => {
                let named = pin.file.clone();
                let found = self.read("map.file", &pin.file, MAP_BYTES).and_then(|bytes| {
                    // The hash before the contents, so that a file which was changed is reported
                    // as such.
                    pins.check("map.hash", &mut pin.hash, &hash_bytes(&bytes))?;
                    file_bytes += bytes.len();
                    MapFile::parse(&bytes).and_then(Map::new).map_err(wrong(&named))
                });
                Some(found.map_err(|error| self.shown("map.file", &named, error))?)
            }
        };
        let tracks = match &mut file.tracks {
            None => None,
            Some(section) => {
                let named = section.file.clone();
                let found = self.read("tracks.file", &section.file, MAP_BYTES).and_then(|bytes| {
                    pins.check("tracks.hash", &mut section.hash, &hash_bytes(&bytes))?;
                    file_bytes += bytes.len();
                    TracksFile::parse(&bytes).map_err(wrong(&named))
                });
                Some(found.map_err(|error| self.shown("tracks.file", &named, error))?)
            }
        };
        let around = Surroundings {
            drives: &manifest.trajectories,
            tracks: tracks.as_ref(),
            map: map.as_ref(),
            assets,
        };
        let scenario = Scenario::resolve(file, seed, &around).map_err(wrong("scenario"))?;
        // Serializing plain values into memory cannot fail. If it did, only the hash would differ.
        let json = serde_json::to_vec(&scenario.file).unwrap_or_default();
        let actors = &scenario.traffic.actors;
        let triggers: usize = actors.iter().map(|actor| actor.script.len()).sum();
        // Drives and lines are shared by actors, and courses along lanes are not.
        let courses: BTreeMap<*const Course, usize> = actors
            .iter()
            .filter_map(|actor| match &actor.behaviour {
                Behaviour::Follow(follow) => Some(&follow.courses),
                Behaviour::Track(_) | Behaviour::Attack { .. } => None,
            })
            .flatten()
            .map(|course| (Arc::as_ptr(course), course.places()))
            .collect();
        let places: usize = courses.values().sum();
        // Measured: 32 MiB for 256 actors with 46 triggers each, and 115 MiB for a map of 16 MiB. A
        // place of a course has a pose of 56 bytes, a station of 8, and a share of the boxes.
        let memory_bytes =
            (triggers * 3072 + actors.len() * 8192 + 8 * file_bytes + places * 120) as u64;
        let hash = hash_bytes(&json);
        let unpinned = pins.unpinned;
        Ok(LoadedScenario { hash, scenario, map, unpinned, memory_bytes })
    }

    /// Reads and resolves a scenario with the first value of each of its sweep's names.
    ///
    /// # Errors
    /// As [`Self::document`] and [`Self::resolve`].
    pub fn load(
        &self,
        source: &ScenarioSource,
        values: &BTreeMap<String, Value>,
        seed: u64,
        version: (&Manifest, &str),
        assets: &dyn Assets,
    ) -> Result<LoadedScenario, ScenarioError> {
        let file = self.file(source, values)?;
        self.resolve(file, seed, version, false, assets)
    }

    /// A scenario with values of its sweep; the first ones where they are absent.
    pub(crate) fn file(
        &self,
        source: &ScenarioSource,
        values: &BTreeMap<String, Value>,
    ) -> Result<ScenarioFile, ScenarioError> {
        let document = self.document(source)?;
        let mut chosen = document.first_values();
        // Given values replace the first ones of the same names.
        let given = values.iter().map(|(name, value)| (name.clone(), Arc::new(value.clone())));
        chosen.extend(given);
        document
            .with(&chosen)
            .map_err(|cause| ScenarioError::File { file: "scenario".to_owned(), cause })
    }

    /// What a client is told about a file that its scenario names.
    fn shown(&self, field: &'static str, file: &str, error: ScenarioError) -> ScenarioError {
        if !self.is_inline {
            return error;
        }
        // The field is `map.file` or `tracks.file`.
        let kind = field.trim_end_matches(".file");
        let reason = format!("there is no {kind} of this name that fits the scenario");
        ScenarioError::Read { field, file: file.to_owned(), reason }
    }

    pub(super) fn read(
        &self,
        field: &'static str,
        file: &str,
        limit_bytes: usize,
    ) -> Result<Vec<u8>, ScenarioError> {
        let failed = |reason: String| ScenarioError::Read { field, file: file.to_owned(), reason };
        // A name has no slash, so it stays within the directory.
        if !is_name(file) {
            return Err(failed("write the name of a file in the scenario's directory".to_owned()));
        }
        read_at_most(&self.dir.join(file), limit_bytes).map_err(failed)
    }
}

/// Compares hashes with those that a scenario names, and fills in those that it does not.
struct Pins {
    latest: bool,
    unpinned: Vec<String>,
}

impl Pins {
    fn check(
        &mut self,
        field: &'static str,
        wanted: &mut Option<String>,
        found: &str,
    ) -> Result<(), ScenarioError> {
        match wanted {
            Some(hash) if hash != found && self.latest => {
                self.unpinned.push(format!("{field} is {hash}, and {found} was used"));
            }
            Some(hash) if hash != found => {
                let wanted = hash.clone();
                return Err(ScenarioError::Hash { field, wanted, found: found.to_owned() });
            }
            _ => {}
        }
        // From here on the scenario names what was used, and its own hash covers that.
        *wanted = Some(found.to_owned());
        Ok(())
    }
}

fn hash_bytes(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

fn read_at_most(path: &Path, limit_bytes: usize) -> Result<Vec<u8>, String> {
    let metadata = std::fs::metadata(path).map_err(|error| error.to_string())?;
    // Opening a pipe may wait for ever, and reading a device may never end.
    if !metadata.is_file() {
        return Err("it is not a file".to_owned());
    }
    let file = File::open(path).map_err(|error| error.to_string())?;
    let mut bytes = Vec::new();
    // A byte more than the limit, to tell a file at the limit from a longer one.
    let read = file.take(limit_bytes as u64 + 1).read_to_end(&mut bytes);
    read.map_err(|error| error.to_string())?;
    if bytes.len() > limit_bytes {
        return Err(format!("it has more than {limit_bytes} bytes"));
    }
    Ok(bytes)
}

fn joined(names: &[String]) -> String {
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}
