//! The twin of a benchmark, in an engine of this process.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use wildcity::cli::backend_options::{self, BackendOptions};
use wildcity::cli::directories::{TwinVersion, Twins};
use wildcity_server::{Config, Directories, Limits};
use wildcity_session::options::{Open, Outputs};
use wildcity_session::{Engine, EngineSettings, Scenarios};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

#[derive(Debug, clap::Args)]
pub(super) struct BenchedTwin {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    pub(super) twin: TwinVersion,

    #[command(flatten)]
    pub(super) twins: Twins,

    #[command(flatten)]
    pub(super) backend: BackendOptions,

    /// Memory for the twin, in GiB [default: three quarters of the machine's]
    #[arg(long, value_name = "GIB", value_parser = backend_options::gib)]
    pub(super) memory_gib: Option<f64>,
}

impl BenchedTwin {
    /// Starts an engine that records to a directory, and finds the twin.
    pub(super) fn start(&self, episodes: &Path) -> anyhow::Result<(Arc<Engine>, Version)> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        Ok((self.engine(catalog, episodes)?, version))
    }

    /// Starts an engine on the twins of a catalog that records to a directory.
    pub(super) fn engine(&self, catalog: Catalog, episodes: &Path) -> anyhow::Result<Arc<Engine>> {
        let limit_bytes = self.memory_gib.map(backend_options::bytes_of_gib);
        let engine = Engine::start(EngineSettings {
            cache: Cache::limited(catalog, limit_bytes),
            episodes: episodes.to_owned(),
            scenarios: Scenarios::in_dir(""),
            backend: Arc::from(self.backend.backend()?),
            step_timeout: wildcity_protocol::limits::STEP_TIMEOUT,
            repairs: Arc::default(),
            mcap: false,
        })?;
        Ok(engine)
    }

    /// A server for this process on a directory or URL of twins. Records, scenarios and uploads lie
    /// below `scratch`.
    pub(super) fn server(&self, twins: PathBuf, scratch: &Path) -> anyhow::Result<Config> {
        let directories = Directories {
            twins,
            episodes: scratch.join("episodes"),
            scenarios: scratch.join("scenarios"),
            uploads: scratch.join("uploads"),
        };
        let resident_bytes = self.memory_gib.map(backend_options::bytes_of_gib);
        Ok(Config {
            cache: self.twins.cache(),
            limits: Limits { resident_bytes, ..Limits::default() },
            ..Config::local(directories, Arc::from(self.backend.backend()?))
        })
    }

    /// Options of a session on the twin.
    pub(super) fn session(&self, outputs: Outputs) -> Open {
        Open { version: self.twin.number, outputs, ..Open::twin(&self.twin.name) }
    }
}
