//! `wildcity twin drive`.

use std::path::PathBuf;

use wildcity_scene::align::Alignment;
use wildcity_twin::store::Edit;

use super::{blind, change};
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::input_files::read_trajectories;
use crate::cli::twin::find_rig;

/// Give a twin recorded drives and a rig: makes a new version with the same Gaussians.
///
/// A drive replaces the drive of the same name; other drives stay. Open sessions keep the version
/// that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin drive street --trajectory log.json
  wildcity twin drive street --trajectory capture/capture.json --rig capture/rig.json")]
#[command(group = clap::ArgGroup::new("what").args(["trajectory", "rig"]).required(true).multiple(true))]
pub(in crate::cli) struct Drive {
    #[command(flatten)]
    edited: EditedTwin,

    /// JSON file of a drive, in the twin's axes and metres, as `wildcity import --help` shows it.
    /// May be given again.
    #[arg(long, value_name = "FILE")]
    trajectory: Vec<PathBuf>,

    /// The vehicle's cameras: a preset (see `wildcity twin rig show`), or a JSON file as
    /// `wildcity import --help` shows it.
    #[arg(long, value_name = "RIG")]
    rig: Option<String>,

    #[command(flatten)]
    twins: Twins,
}

impl Drive {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let trajectories = read_trajectories(&self.trajectory)?;
        let rig = self.rig.as_deref().map(find_rig).transpose()?;
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let alignment = Alignment::IDENTITY;
        let edit = Edit { alignment, trajectories, rig };
        let version = catalog.edit(&base, edit, &mut |_, _| {})?;
        blind::warn(&catalog, &version)?;
        let names: Vec<&str> =
            version.manifest.trajectories.iter().map(|drive| drive.name.as_str()).collect();
        let drives = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let rig = version.manifest.rig.as_ref().map_or("none", |rig| rig.name.as_str());
        change::print(&version, &format!("recorded drives: {drives}; rig: {rig}"))
    }
}
