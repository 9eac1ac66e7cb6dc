//! Where twins lie unless told otherwise.

use std::env;
use std::path::PathBuf;

use crate::cli::limits;
use wildcity_twin::store::{Catalog, DiskCacheSettings};

/// `--twins`, for every command that has it.
#[derive(Debug, clap::Args)]
pub(super) struct Twins {
    /// Directory of the twins, or s3://BUCKET/FOLDER, gs://.. or az://.., with credentials from the
    /// environment (AWS_*, GOOGLE_*, AZURE_*) [default: $XDG_DATA_HOME/wildcity/twins, or
    /// ~/.local/share/wildcity/twins]
    #[arg(long, value_name = "PLACE")]
    twins: Option<PathBuf>,

    /// Directory that keeps parts of twins from elsewhere [default: $XDG_CACHE_HOME/wildcity, or
    /// ~/.cache/wildcity]
    #[arg(long, value_name = "DIR")]
    cache_dir: Option<PathBuf>,

    /// How much it keeps, in GiB; 0 for nothing.
    #[arg(long, value_name = "N", default_value_t = limits::CACHE_GIB)]
    cache_gib: u32,
}

impl Twins {
    /// The twins there.
    pub(super) fn catalog(&self) -> anyhow::Result<Catalog> {
        Ok(Catalog::open_cached(&self.dir()?, self.cache().as_ref())?)
    }

    /// Where parts of remote twins are kept: nowhere without a home.
    pub(super) fn cache(&self) -> Option<DiskCacheSettings> {
        let limit_bytes = u64::from(self.cache_gib) << 30;
        let own = || Some(user_dir("XDG_CACHE_HOME", ".cache")?.join("wildcity"));
        let dir = self.cache_dir.clone().or_else(own)?;
        (limit_bytes > 0).then_some(DiskCacheSettings { dir, limit_bytes })
    }

    /// The place given, or the user's own directory.
    pub(super) fn dir(&self) -> anyhow::Result<PathBuf> {
        if let Some(dir) = &self.twins {
            return Ok(dir.clone());
        }
        match user_dir("XDG_DATA_HOME", ".local/share") {
            Some(data) => Ok(data.join("wildcity/twins")),
            None => anyhow::bail!("neither HOME nor XDG_DATA_HOME is set: give --twins DIR"),
        }
    }
}

/// `--episodes`, for every command that records.
#[derive(Debug, clap::Args)]
pub(super) struct Episodes {
    /// Directory where episodes are recorded [default: $XDG_STATE_HOME/wildcity/episodes, or
    /// ~/.local/state/wildcity/episodes]
    #[arg(long, value_name = "DIR")]
    episodes: Option<PathBuf>,
}

impl Episodes {
    /// The directory given, or the user's own.
    pub(super) fn dir(&self) -> anyhow::Result<PathBuf> {
        state_dir(self.episodes.as_ref(), "episodes")
    }
}

/// `--uploads`, for every command that takes them.
#[derive(Debug, clap::Args)]
pub(super) struct Uploads {
    /// Directory where uploads are kept until they are pushed, one server's at a time [default:
    /// $XDG_STATE_HOME/wildcity/uploads, or ~/.local/state/wildcity/uploads]
    #[arg(long, value_name = "DIR")]
    uploads: Option<PathBuf>,
}

impl Uploads {
    /// The directory given, or the user's own.
    pub(super) fn dir(&self) -> anyhow::Result<PathBuf> {
        state_dir(self.uploads.as_ref(), "uploads")
    }
}

/// The directory given with an option, or the one of the same name among the user's own.
fn state_dir(given: Option<&PathBuf>, name: &str) -> anyhow::Result<PathBuf> {
    if let Some(dir) = given {
        return Ok(dir.clone());
    }
    match user_dir("XDG_STATE_HOME", ".local/state") {
        Some(state) => Ok(state.join("wildcity").join(name)),
        None => anyhow::bail!("neither HOME nor XDG_STATE_HOME is set: give --{name} DIR"),
    }
}

/// A directory of the XDG base directory specification: from the environment, or below HOME. By
/// hand, because a crate would be longer to call, and would look up a home in the user database
/// where HOME is unset.
fn user_dir(variable: &str, below_home: &str) -> Option<PathBuf> {
    let set = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set(variable).or_else(|| set("HOME").map(|home| home.join(below_home)))
}

/// A twin and perhaps one of its versions, as `street` or `street@3`.
#[derive(Clone, Debug)]
pub(super) struct TwinVersion {
    pub(super) name: String,
    /// None for the latest.
    pub(super) number: Option<u64>,
}

impl std::str::FromStr for TwinVersion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((name, number)) = text.split_once('@') else {
            return Ok(Self { name: text.to_owned(), number: None });
        };
        let number = number.parse().map_err(|e| format!("version {number:?}: {e}"))?;
        Ok(Self { name: name.to_owned(), number: Some(number) })
    }
}
