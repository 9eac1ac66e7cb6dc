//! `wildcity twin sky`.

use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::profile_options::ProfileOptions;
use crate::cli::sky_source::SkySource;
use wildcity_twin::store::NewSky;

use super::change;

/// Add, replace or remove the sky of a twin: makes a new version with the same Gaussians, and with
/// changes of the render profile, such as the sky's error.
///
/// Open sessions keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("action").args(["sky", "remove"]).required(true))]
pub(in crate::cli) struct Sky {
    #[command(flatten)]
    edited: EditedTwin,

    #[command(flatten)]
    source: SkySource,

    /// Remove the sky.
    #[arg(long)]
    remove: bool,

    #[command(flatten)]
    profile: ProfileOptions,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin sky street --sky evening.safetensors --sky-axes y-down-z-forward
  wildcity twin sky street --sky panorama.jpg --set sky_error=0.01
  wildcity twin sky street --remove";

impl Sky {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let sky = self.source.read("identity")?.map(NewSky::Put);
        let changes = self.profile.load()?;
        let version = change::commit(&self.twins, &self.edited.twin, |base, change| {
            change.sky = Some(sky);
            change.profile = Some(changes.apply(base.profile)?);
            Ok(())
        })?;
        let what = version
            .manifest
            .sky
            .as_ref()
            .map_or("no sky".to_owned(), |sky| format!("a sky of {} bytes", sky.bytes));
        change::print(&version, &what)
    }
}
