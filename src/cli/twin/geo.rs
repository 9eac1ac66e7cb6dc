//! `wildcity twin geo`.

use crate::cli::directories::{EditedTwin, Twins};
use wildcity_scene::geo::GeoAnchor;

use super::change;

/// Set the place of a twin on the earth, or remove it: makes a new version with the same Gaussians.
///
/// Observations of the version then have latitude, longitude and heading. Open sessions keep the
/// version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
#[command(group = clap::ArgGroup::new("action").args(["anchor", "remove"]).required(true))]
pub(in crate::cli) struct Geo {
    #[command(flatten)]
    edited: EditedTwin,

    /// Place of the twin's origin: LATITUDE,LONGITUDE[,ALTITUDE], or
    /// EPSG:CODE,EASTING,NORTHING[,ALTITUDE].
    #[arg(value_name = "ANCHOR", allow_hyphen_values = true)]
    anchor: Option<GeoAnchor>,

    /// Remove the place.
    #[arg(long)]
    remove: bool,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity twin geo street 52.5162,13.3777,34
  wildcity twin geo street EPSG:32633,391779,5820076
  wildcity twin geo street --remove";

impl Geo {
    pub(in crate::cli) fn run(self) -> anyhow::Result<()> {
        let anchor = self.anchor;
        let version = change::commit(&self.twins, &self.edited.twin, |_, change| {
            change.geo = Some(anchor);
            Ok(())
        })?;
        let anchor = version.manifest.geo.as_ref();
        let what = anchor.map_or(Ok("no place on the earth".to_owned()), serde_json::to_string)?;
        change::print(&version, &what)
    }
}
