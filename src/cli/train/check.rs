//! `wildcity train check`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};
use serde::Serialize;

use wildcity_render::gradient::Differentiate;
use wildcity_train::check::{self, Table, Time, Vectors};

use crate::cli::backend_options::HardwareOptions;
use crate::cli::output;
use crate::cli::progress;

/// Compare the gradients of every backend on this machine with their definition.
///
/// The backends are cpu, and gpu if there is a hardware device or --device names one. The
/// definition is the reference backend, which computes in f64; the tests of the project compare its
/// derivatives with finite differences. A row is one scene: streets by every kind of camera, and
/// extremes such as needles and a thousand layers.
///
/// A number is the largest error among the derivatives by one group of parameters, divided by the
/// largest of these derivatives. (Those by rotations may all be 0, as for balls: they are divided
/// by at least a hundredth of the largest by sizes.) In the row "raster", scale stands for the
/// inverse covariance and sh for the colour.
///
/// With vectors that PyTorch computed, the reference and the backends are compared with these, too.
/// The command ends with 1 if a bound is exceeded.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Check {
    /// Gradients by PyTorch: vectors.safetensors [default: gradients/vectors.safetensors in
    /// $WILDCITY_DATA, if it is set]
    #[arg(long, value_name = "FILE")]
    vectors: Option<PathBuf>,

    /// Also measure the time of gradients against that of images.
    #[arg(long)]
    time: bool,

    /// Numbers of Gaussians to measure, for example 200000,500000,2000000
    #[arg(
        long,
        value_name = "COUNT",
        requires = "time",
        value_delimiter = ',',
        default_values_t = [200_000, 500_000, 2_000_000],
        value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=50_000_000)
    )]
    gaussians: Vec<usize>,

    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity train check
  wildcity train check --time --gaussians 200000
  wildcity train check --vectors vectors.safetensors --json > gradients.json";

#[derive(Serialize)]
struct Report {
    #[serde(flatten)]
    table: Table,
    times: Vec<Time>,
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let backends = self.hardware.differentiating()?;
        let backends: Vec<&dyn Differentiate> = backends.iter().map(AsRef::as_ref).collect();
        let in_data = || {
            let data = std::env::var_os("WILDCITY_DATA")?;
            Some(PathBuf::from(data).join("gradients/vectors.safetensors")).filter(|p| p.is_file())
        };
        let path = self.vectors.clone().or_else(in_data);
        let read = |path: PathBuf| {
            let cannot = || format!("--vectors {}", path.display());
            Vectors::new(std::fs::read(&path).with_context(cannot)?).with_context(cannot)
        };
        let vectors = path.map(read).transpose()?;
        let bar = progress::state();
        let table = Table::new(&backends, vectors.as_ref(), &mut |done, case| {
            bar.set_position(done as u64);
            bar.set_message(case.to_owned());
        })?;
        let mut times = Vec::new();
        if self.time {
            for backend in &backends {
                let mut progress = |what: &str| bar.set_message(what.to_owned());
                times.extend(check::times(*backend, &self.gaussians, &mut progress)?);
            }
        }
        bar.finish_and_clear();

        let exceeded = table.exceeded();
        let mut out = output::stdout();
        if self.json {
            writeln!(out, "{}", serde_json::to_string(&Report { table, times })?)?;
        } else {
            write!(out, "{table}")?;
            if vectors.is_none() {
                writeln!(out, "not compared with vectors of others: give --vectors to do so")?;
            }
            print_times(&mut out, &times)?;
        }
        // After the table, which shows the bounds that are exceeded.
        ensure!(exceeded == 0, "{exceeded} bounds are exceeded");
        if !self.json {
            writeln!(out, "every bound holds")?;
        }
        Ok(())
    }
}

fn print_times(out: &mut impl Write, times: &[Time]) -> io::Result<()> {
    if times.is_empty() {
        return Ok(());
    }
    writeln!(
        out,
        "\n\
         image: as it is rendered; forward: with what the way back needs, as a training step draws it;\n\
         backward: from the loss to the Gaussians; its ratios to forward and to image\n\
         backend  Gaussians  views            pairs       image     forward    backward  ratios"
    )?;
    for time in times {
        let Time { backend, gaussians, size_px: [width, height], views, visible_pairs, .. } = time;
        let Time { image_ms, forward_ms, backward_ms, .. } = time;
        let views = format!("{views} x {width}x{height}");
        writeln!(
            out,
            "{backend:7}  {gaussians:>9}  {views:14}  {visible_pairs:>8}  {image_ms:>7.1} ms  \
             {forward_ms:>7.1} ms  {backward_ms:>7.1} ms  {:.2} {:.2}",
            backward_ms / forward_ms,
            backward_ms / image_ms,
        )?;
    }
    Ok(())
}
