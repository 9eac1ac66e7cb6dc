//! `wildcity twin sky`.

use std::io::{self, Write};

use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::sky_source::SkySource;
use wildcity_twin::store::{CommitKind, NewSky, StorageOptions, VersionChange};

/// Put a sky behind a twin, another in its place, or take it away: a new version with the same
/// Gaussians.
///
/// Agents that drive keep the version that they opened.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("what").args(["sky", "remove"]).required(true))]
pub(in crate::cli) struct Sky {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    source: SkySource,

    /// Takes the sky away.
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
        // That of the version: what it says of its Gaussians stays true.
        let provenance = base.manifest.provenance.clone();
        let storage = StorageOptions { record: base.manifest.record, ..StorageOptions::default() };
        let commit = catalog.begin(&self.twin.name, CommitKind::Import, storage)?;
        let change = VersionChange {
            profile: None,
            rig: None,
            trajectories: None,
            sky: Some(sky),
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
