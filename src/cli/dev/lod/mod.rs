//! `wildcity dev lod`.

mod comparison;

use std::io::{self, Write};
use std::path::PathBuf;

use wildcity_scene::Manifest;
use wildcity_twin::store::Version;

use comparison::Comparison;

use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output;

/// Show the levels of detail of a twin: Gaussians, bytes, and geometric error of each.
///
/// With --out it also renders images: for each camera a PNG with full detail next to the image at
/// every --tau, and the PSNR between them in dB.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Lod {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    #[command(flatten)]
    twins: Twins,

    /// Directory for the images; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// JSON list of cameras in the twin's axes, as `wildcity render --cameras` reads it [default:
    /// the twin's rig, or the preset `vehicle6`, in the middle of the twin's first trajectory]
    #[arg(long, value_name = "FILE", requires = "out")]
    cameras: Option<PathBuf>,

    /// Largest error of a level of detail on the screen, in pixels.
    #[arg(long, value_name = "PX", value_delimiter = ',', default_values_t = [0.5, 1.0, 2.0, 4.0])]
    tau: Vec<f64>,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity dev lod street
  wildcity dev lod street --out levels --tau 1,4
  wildcity dev lod street --out levels --cameras views.json";

impl Lod {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        table(&mut output::stdout(), &version)?;
        let Some(out) = &self.out else { return Ok(()) };
        let comparison = Comparison {
            taus_px: &self.tau,
            cameras: self.cameras.as_deref(),
            backend: &*self.backend.backend()?,
        };
        comparison.write(catalog, &version, out)
    }
}

/// A row of the table: one level.
#[derive(Clone, Debug, Default)]
struct Row {
    gaussians: u64,
    bytes: u64,
    errors_m: Vec<f32>,
}

fn table(out: &mut impl Write, version: &Version) -> io::Result<()> {
    let manifest = &version.manifest;
    let rows = rows(manifest);
    let all: u64 = rows.iter().map(|row| row.gaussians).sum();
    let stored: u64 = rows.iter().map(|row| row.bytes).sum();
    writeln!(
        out,
        "twin {} version {}, record {}: {all} Gaussians in {}, {stored} bytes",
        manifest.twin,
        version.number,
        manifest.record,
        output::counted(rows.len(), "level")
    )?;
    writeln!(
        out,
        "{:>5} {:>7} {:>11} {:>7} {:>12} {:>7}  error of a block, m: min, median, max",
        "level", "blocks", "Gaussians", "share", "bytes", "B each"
    )?;
    for (level, Row { gaussians, bytes, mut errors_m }) in rows.into_iter().enumerate() {
        errors_m.sort_by(f32::total_cmp);
        // A level between others may have no block.
        if errors_m.is_empty() {
            continue;
        }
        let last = (errors_m.len() - 1) as f64;
        let quantile_m = |share: f64| errors_m[(last * share).round() as usize];
        let share = 100.0 * gaussians as f64 / manifest.gaussians() as f64;
        writeln!(
            out,
            "{level:>5} {:>7} {gaussians:>11} {share:>6.1}% {bytes:>12} {:>7.1}  {:.3} {:.3} {:.3}",
            errors_m.len(),
            bytes as f64 / gaussians as f64,
            quantile_m(0.0),
            quantile_m(0.5),
            quantile_m(1.0),
        )?;
    }
    Ok(())
}

/// One row per level, from level 0 on. Every level has sections.
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
