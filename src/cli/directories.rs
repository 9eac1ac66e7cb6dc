//! Directories of twins, episodes and uploads, and names of twins, on the command line.

use std::env;
use std::path::{Path, PathBuf};

use crate::cli::limits;
use wildcity_twin::store::{Catalog, DiskCacheSettings};

/// `--twins` and the disk cache, for every command that reads twins.
#[derive(Debug, clap::Args)]
pub struct Twins {
    /// Directory of the twins, or an object store: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or
    /// az://CONTAINER/FOLDER, with credentials from the environment (AWS_*, GOOGLE_*, AZURE_*)
    /// [default: $XDG_DATA_HOME/wildcity/twins, or ~/.local/share/wildcity/twins]
    #[arg(long, value_name = "DIR_OR_URL")]
    twins: Option<PathBuf>,

    /// Directory that caches parts of twins from an object store [default:
    /// $XDG_CACHE_HOME/wildcity, or ~/.cache/wildcity]
    #[arg(long, hide = true, value_name = "DIR")]
    cache_dir: Option<PathBuf>,

    /// Size of that cache, in GiB; 0 for no cache.
    #[arg(long, hide = true, value_name = "GIB", default_value_t = limits::CACHE_GIB)]
    cache_gib: u32,
}

impl Twins {
    /// Opens the catalog of the twins.
    pub fn catalog(&self) -> anyhow::Result<Catalog> {
        Ok(Catalog::open_cached(&self.dir()?, self.cache().as_ref())?)
    }

    /// The cache for twins from an object store. None with size 0, and without a home directory.
    pub fn cache(&self) -> Option<DiskCacheSettings> {
        let limit_bytes = u64::from(self.cache_gib) << 30;
        let default_dir = || Some(xdg_dir("XDG_CACHE_HOME", ".cache")?.join("wildcity"));
        let dir = self.cache_dir.clone().or_else(default_dir)?;
        // A limit of 0 turns the cache off.
        (limit_bytes > 0).then_some(DiskCacheSettings { dir, limit_bytes })
    }

    /// The directory or URL of `--twins`, or the user's own directory.
    pub fn dir(&self) -> anyhow::Result<PathBuf> {
        if let Some(dir) = &self.twins {
            return Ok(dir.clone());
        }
        match xdg_dir("XDG_DATA_HOME", ".local/share") {
            Some(data) => Ok(data.join("wildcity/twins")),
            None => anyhow::bail!("neither HOME nor XDG_DATA_HOME is set: give --twins DIR"),
        }
    }
}

/// `--episodes`, for every command that records episodes.
#[derive(Debug, clap::Args)]
pub struct Episodes {
    /// Directory where episodes are recorded [default: $XDG_STATE_HOME/wildcity/episodes, or
    /// ~/.local/state/wildcity/episodes]
    #[arg(long, value_name = "DIR")]
    episodes: Option<PathBuf>,
}

impl Episodes {
    /// Whether the user's own directory is meant, and does not exist yet: nothing was recorded.
    pub fn is_unused(&self) -> anyhow::Result<bool> {
        Ok(self.episodes.is_none() && !self.dir()?.try_exists()?)
    }

    /// The directory of `--episodes`, or the user's own.
    pub fn dir(&self) -> anyhow::Result<PathBuf> {
        state_dir(self.episodes.as_ref(), "episodes")
    }
}

/// `--scenarios`, for the server.
#[derive(Debug, clap::Args)]
pub struct Scenarios {
    /// Directory of the scenarios that sessions can open by name: NAME.json, with the tracks and
    /// maps that they name [default: $XDG_DATA_HOME/wildcity/scenarios, or
    /// ~/.local/share/wildcity/scenarios]
    #[arg(long, value_name = "DIR")]
    scenarios: Option<PathBuf>,
}

impl Scenarios {
    /// The directory that was given, if it does not exist.
    pub fn missing(&self) -> Option<&Path> {
        self.scenarios.as_deref().filter(|dir| !dir.is_dir())
    }

    /// The directory of `--scenarios`, or the user's own.
    pub fn dir(&self) -> anyhow::Result<PathBuf> {
        if let Some(dir) = &self.scenarios {
            return Ok(dir.clone());
        }
        match xdg_dir("XDG_DATA_HOME", ".local/share") {
            Some(data) => Ok(data.join("wildcity/scenarios")),
            None => anyhow::bail!("neither HOME nor XDG_DATA_HOME is set: give --scenarios DIR"),
        }
    }
}

/// `--uploads`, for every command that accepts uploads.
#[derive(Debug, clap::Args)]
pub struct Uploads {
    /// Directory where uploads are kept until they are pushed; only one server at a time may use it
    /// [default: $XDG_STATE_HOME/wildcity/uploads, or ~/.local/state/wildcity/uploads]
    #[arg(long, value_name = "DIR")]
    uploads: Option<PathBuf>,
}

impl Uploads {
    /// The directory of `--uploads`, or the user's own.
    pub fn dir(&self) -> anyhow::Result<PathBuf> {
        state_dir(self.uploads.as_ref(), "uploads")
    }
}

/// The directories of a server, for every command that starts one with the user's own.
#[derive(Debug, clap::Args)]
pub struct ServerDirectories {
    #[command(flatten)]
    pub twins: Twins,

    #[command(flatten)]
    pub episodes: Episodes,

    #[command(flatten)]
    pub scenarios: Scenarios,

    #[command(flatten)]
    pub uploads: Uploads,
}

impl ServerDirectories {
    /// All of them: each that is given, or the user's own.
    pub fn all(&self) -> anyhow::Result<wildcity_server::Directories> {
        Ok(wildcity_server::Directories {
            twins: self.twins.dir()?,
            episodes: self.episodes.dir()?,
            scenarios: self.scenarios.dir()?,
            uploads: self.uploads.dir()?,
        })
    }
}

/// The directory that an option gives, or the user's own directory of the same name.
fn state_dir(given: Option<&PathBuf>, name: &str) -> anyhow::Result<PathBuf> {
    if let Some(dir) = given {
        return Ok(dir.clone());
    }
    match xdg_dir("XDG_STATE_HOME", ".local/state") {
        Some(state) => Ok(state.join("wildcity").join(name)),
        None => anyhow::bail!("neither HOME nor XDG_STATE_HOME is set: give --{name} DIR"),
    }
}

/// A directory of the XDG base directory specification: from its variable, or below HOME. Written
/// by hand, because that is shorter than using a crate.
fn xdg_dir(variable: &str, below_home: &str) -> Option<PathBuf> {
    let set = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    // The XDG specification treats an empty variable as one that is not set.
    set(variable).or_else(|| set("HOME").map(|home| home.join(below_home)))
}

/// A twin and perhaps one of its versions: `street`, or `street@3`.
#[derive(Clone, Debug)]
pub struct TwinVersion {
    pub name: String,
    /// None for the latest version.
    pub number: Option<u64>,
}

/// The twin that an edit changes.
#[derive(Debug, clap::Args)]
pub struct EditedTwin {
    /// The twin: NAME, or NAME@NUMBER for the version that the edit is made from [default: the
    /// latest]. Changes of later versions are kept; an edit that would overwrite one of them is
    /// refused.
    #[arg(value_name = "TWIN")]
    pub twin: TwinVersion,
}

impl std::str::FromStr for TwinVersion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((name, number)) = text.split_once('@') else {
            return Ok(Self { name: text.to_owned(), number: None });
        };
        let number = number.parse().map_err(|error| {
            format!("version {number:?}: {error}; expected NAME@NUMBER, for example street@3")
        })?;
        Ok(Self { name: name.to_owned(), number: Some(number) })
    }
}
