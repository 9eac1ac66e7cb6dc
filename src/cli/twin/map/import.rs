//! `wildcity twin map import`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;

use crate::cli::output;
use wildcity_convert::{geojson, opendrive};
use wildcity_scene::geo::{GeoAnchor, GeoPoint, ProjectedOrigin};
use wildcity_twin::ingest;

/// Read a map from OpenDRIVE or GeoJSON.
///
/// OpenDRIVE: without --origin, coordinates are those of the twin, at most 16 km from its origin.
/// With --origin, they are those of a map projection such as UTM. The offset in the file's header
/// counts. GeoJSON: every feature has a property layer, which is `lane`, `drivable`,
/// `intersection`, `crosswalk`, `stop_line` or a layer of nuPlan; coordinates are metres of the
/// twin, or degrees with --origin.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin map import town.xodr --out town.map.json
  wildcity twin map import utm.xodr --origin 691000,5334000 --out town.map.json
  wildcity twin map import town.geojson --origin 11.58,48.14 --out town.map.json")]
pub(in crate::cli) struct Import {
    /// The file; its format is detected from its content.
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// The twin's origin: for OpenDRIVE its easting and northing in the file's projection, in
    /// metres; for GeoJSON in degrees its longitude and latitude.
    #[arg(long, value_name = "EAST,NORTH", value_parser = origin, allow_hyphen_values = true)]
    origin: Option<[f64; 2]>,

    /// Map file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let context = || format!("{}", self.file.display());
        let bytes = ingest::read_whole(&self.file, wildcity_convert::TEXT_BYTES as u64)
            .with_context(context)?;
        anyhow::ensure!(
            // Both are XML of ASAM, and easily mixed up: the message names the command for the
            // other one.
            !is_openscenario(&bytes),
            "{} is OpenSCENARIO: `wildcity scenario import` reads it",
            self.file.display()
        );
        // By content and not by name: GeoJSON has the extensions .geojson and .json, and XML begins
        // with `<`.
        let is_json = bytes.trim_ascii_start().first() == Some(&b'{');
        let (map, geo, warnings) = if is_json {
            (geojson::read(&bytes, self.origin).with_context(context)?, None, Vec::new())
        } else {
            let imported = opendrive::read(&bytes, self.origin).with_context(context)?;
            (imported.map, imported.geo, imported.warnings)
        };
        output::write(&self.out, map.to_json().as_bytes())?;
        let mut out = output::stdout();
        for warning in &warnings {
            writeln!(out, "note: {warning}")?;
        }
        writeln!(
            out,
            "{}: {}, {}",
            self.out.display(),
            output::counted(map.lanes.len(), "lane"),
            output::counted(map.areas.len(), "area")
        )?;
        if let Some(geo) = geo {
            writeln!(out, "next: wildcity twin geo TWIN {}", anchor_text(&geo))?;
        }
        Ok(())
    }
}

/// Whether the root element of an XML file is that of OpenSCENARIO.
fn is_openscenario(bytes: &[u8]) -> bool {
    // The declaration and comments may be before it.
    const HEAD_BYTES: usize = 64 << 10;
    let head = String::from_utf8_lossy(&bytes[..bytes.len().min(HEAD_BYTES)]);
    let elements = head.split('<').skip(1);
    let mut names = elements.filter(|element| !element.starts_with(['?', '!']));
    names.next().is_some_and(|root| root.starts_with("OpenSCENARIO"))
}

/// An anchor as `wildcity twin geo` reads it.
fn anchor_text(geo: &GeoAnchor) -> String {
    match geo {
        GeoAnchor::Origin(GeoPoint { latitude_deg, longitude_deg, altitude_m }) => {
            format!("{latitude_deg},{longitude_deg},{altitude_m}")
        }
        GeoAnchor::Projected(ProjectedOrigin { projection, easting_m, northing_m, altitude_m }) => {
            format!("{projection},{easting_m},{northing_m},{altitude_m}")
        }
    }
}

/// Parses the option `--origin`, as `EAST,NORTH`.
pub(in crate::cli) fn origin(text: &str) -> Result<[f64; 2], String> {
    let expected = || {
        "expected two numbers, for example 691000,5334000 in metres or 11.58,48.14 in degrees"
            .to_owned()
    };
    let (east, north) = text.split_once(',').ok_or_else(expected)?;
    let number = |text: &str| {
        let number: Option<f64> = text.trim().parse().ok();
        number.filter(|number| number.is_finite()).ok_or_else(expected)
    };
    Ok([number(east)?, number(north)?])
}
