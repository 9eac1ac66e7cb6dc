//! `wildcity twin sky`.

use std::io::{self, Write};

use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::sky_source::SkySource;
use wildcity_twin::store::{CommitKind, NewSky, StorageOptions, VersionChange};

/// Add, replace or remove the sky of a twin: makes a new version with the same Gaussians.
///
/// Open sessions keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("action").args(["sky", "remove"]).required(true))]
pub(in crate::cli) struct Sky {
    /// The twin: NAME, or NAME@NUMBER to start from an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    source: SkySource,

    /// Remove the sky.
    #[arg(long)]
    remove: bool,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin sky street --sky evening.safetensors --sky-axes y-down-z-forward
  wildcity twin sky street --sky panorama.jpg
  wildcity twin sky street --remove";

impl Sky {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let sky = self.source.read("identity")?.map(NewSky::Put);
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.twin.name, self.twin.number)?;
        // The Gaussians stay, and so does what the version says of their origin.
        let provenance = base.manifest.provenance.clone();
        let storage = StorageOptions { record: base.manifest.record, ..StorageOptions::default() };
        let commit = catalog.begin(&self.twin.name, CommitKind::Import, storage)?;
        let change = VersionChange {
            profile: None,
            rig: None,
            trajectories: None,
            sky: Some(sky),
            geo: None,
            provenance,
        };
        let version = commit.change(base.number, change)?;
        let what = version
            .manifest
            .sky
            .as_ref()
            .map_or("no sky".to_owned(), |sky| format!("a sky of {} bytes", sky.bytes));
        writeln!(
            io::stdout().lock(),
            "twin {} version {}: {what}\nblake3 {}",
            self.twin.name,
            version.number,
            version.hash
        )?;
        Ok(())
    }
}
