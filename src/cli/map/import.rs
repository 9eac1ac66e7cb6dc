//! `wildcity map import`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use crate::cli::output;
use wildcity_convert::{geojson, opendrive};
use wildcity_twin::ingest;

/// Read a map from OpenDRIVE or GeoJSON.
///
/// OpenDRIVE: coordinates are those of the twin, at most 16 km from its origin. GeoJSON: features with the property
/// layer, which is `lane`, `drivable`, `intersection`, `crosswalk`, `stop_line` or a layer of nuPlan; coordinates are
/// metres of the twin, or degrees with --origin.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity map import town.xodr --out town.map.json
  wildcity map import town.geojson --origin 11.58,48.14 --out town.map.json")]
pub(in crate::cli) struct Import {
    /// The file; its format is detected from its content.
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Longitude and latitude of the twin's origin in degrees, for GeoJSON in degrees.
    #[arg(long, value_name = "LON,LAT", value_parser = origin, allow_hyphen_values = true)]
    origin: Option<[f64; 2]>,

    /// Map file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let context = || format!("{}", self.file.display());
        let bytes = ingest::read_whole(&self.file, wildcity_convert::TEXT_BYTES as u64);
        let bytes = bytes.with_context(context)?;
        let is_json = bytes.trim_ascii_start().first() == Some(&b'{');
        let (map, warnings) = match is_json {
            true => (geojson::read(&bytes, self.origin).with_context(context)?, Vec::new()),
            false => {
                anyhow::ensure!(
                    self.origin.is_none(),
                    "--origin is for GeoJSON; {} is not GeoJSON",
                    self.file.display()
                );
                let imported = opendrive::read(&bytes).with_context(context)?;
                (imported.map, imported.warnings)
            }
        };
        output::write(&self.out, map.to_json().as_bytes())?;
        let mut out = io::stdout().lock();
        for warning in &warnings {
            writeln!(out, "note: {warning}")?;
        }
        writeln!(
            out,
            "{}: {} lanes, {} areas",
            self.out.display(),
            map.lanes.len(),
            map.areas.len()
        )?;
        Ok(())
    }
}

fn origin(text: &str) -> Result<[f64; 2], String> {
    let expected = || "expected longitude and latitude, for example 11.58,48.14".to_owned();
    let (longitude, latitude) = text.split_once(',').ok_or_else(expected)?;
    let degrees = |text: &str| text.trim().parse().map_err(|_| expected());
    Ok([degrees(longitude)?, degrees(latitude)?])
}
