//! `wildcity lod`.

mod pictures;

use std::io::{self, Write};
use std::path::PathBuf;

use wildcity_scene::Manifest;
use wildcity_twin::store::Version;

use super::backend_options::BackendOptions;
use super::directories::{TwinVersion, Twins};

/// Show a twin's levels of detail: how many Gaussians and bytes each takes, and how far off it is.
///
/// With --out it also renders what the levels do to the picture: for each camera a PNG of full
/// detail beside what is drawn at every --tau, and the signal-to-noise ratio between them.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Lod {
    /// The twin, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// Directory for pictures of full detail beside each --tau; made if it is missing.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// JSON list of cameras in the twin's axes, as for `wildcity render`. Without it the twin's rig
    /// (or the preset `vehicle6`) stands in the middle of its first trajectory.
    #[arg(long, value_name = "FILE", requires = "out")]
    cameras: Option<PathBuf>,

    /// Largest error on the screen, in pixels.
    #[arg(long, value_name = "PX", value_delimiter = ',', default_values_t = [0.5, 1.0, 2.0, 4.0])]
    tau: Vec<f64>,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity lod street
  wildcity lod street --out levels --tau 1,4
  wildcity lod street --out levels --cameras views.json";

impl Lod {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        table(&mut io::stdout().lock(), &version)?;
        match &self.out {
            Some(out) => pictures::draw(&self, catalog, &version, out),
            None => Ok(()),
        }
    }
}

/// What the table says of one level.
#[derive(Clone, Debug, Default)]
struct Row {
    gaussians: u64,
    bytes: u64,
    errors_m: Vec<f32>,
}

fn table(out: &mut impl Write, version: &Version) -> io::Result<()> {
    let manifest = &version.manifest;
    let rows = rows(manifest);
    let (all, stored) =
        rows.iter().fold((0, 0), |(all, stored), row| (all + row.gaussians, stored + row.bytes));
    writeln!(
        out,
        "twin {} version {}, record {}: {all} Gaussians in {} levels, {stored} bytes",
        manifest.twin,
        version.number,
        manifest.record,
        rows.len()
    )?;
    writeln!(
        out,
        "{:>5} {:>7} {:>11} {:>7} {:>12} {:>7}  error of a block, m: least, median, most",
        "level", "blocks", "Gaussians", "share", "bytes", "B each"
    )?;
    for (level, Row { gaussians, bytes, mut errors_m }) in rows.into_iter().enumerate() {
        errors_m.sort_by(f32::total_cmp);
        let at = |share: f64| errors_m[((errors_m.len() - 1) as f64 * share).round() as usize];
        let share = 100.0 * gaussians as f64 / manifest.gaussians() as f64;
        writeln!(
            out,
            "{level:>5} {:>7} {gaussians:>11} {share:>6.1}% {bytes:>12} {:>7.1}  {:.3} {:.3} {:.3}",
            errors_m.len(),
            bytes as f64 / gaussians as f64,
            at(0.0),
            at(0.5),
            at(1.0),
        )?;
    }
    Ok(())
}

/// One row per level; level 0 first, and none is empty.
fn rows(manifest: &Manifest) -> Vec<Row> {
    let mut rows: Vec<Row> = Vec::new();
    for section in manifest.chunks.iter().flat_map(|chunk| &chunk.sections) {
        let level = usize::from(section.level);
        if rows.len() <= level {
            rows.resize(level + 1, Row::default());
        }
        let row = &mut rows[level];
        row.gaussians += u64::from(section.count);
        row.bytes += u64::from(section.bytes);
        row.errors_m.push(section.error_m);
    }
    rows
}
