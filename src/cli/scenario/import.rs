//! `wildcity scenario import`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use crate::cli::output;
use wildcity_convert::openscenario;
use wildcity_twin::ingest;

/// Read a scenario of OpenSCENARIO XML 1.0 to 1.3.
///
/// The import supports parameters with formulas, vehicles, pedestrians and objects, positions, speeds, trajectories,
/// and events with conditions on time, speed, distance, driven distance and started events. It refuses any other part,
/// with its name and line, because the scenario would be different without it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario import cut-in.xosc --twin street --out cut-in.json
  wildcity scenario import cut-in.xosc --twin street --ego Hero --out cut-in.json")]
pub(in crate::cli) struct Import {
    /// The OpenSCENARIO file.
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Name of the twin in which the scenario takes place. Positions of the file are in its axes.
    #[arg(long, value_name = "NAME")]
    twin: String,

    /// Name of the entity that the agent drives.
    #[arg(long, value_name = "NAME", default_value = "Ego")]
    ego: String,

    /// Scenario file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Import {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let context = || format!("{}", self.file.display());
        let bytes = ingest::read_whole(&self.file, openscenario_bytes()).with_context(context)?;
        let name = self.out.file_stem().and_then(|stem| stem.to_str()).unwrap_or("scenario");
        let settings = openscenario::Settings {
            name: name.to_owned(),
            twin: self.twin.clone(),
            ego: self.ego.clone(),
        };
        let scenario = openscenario::read(&bytes, &settings).with_context(context)?;
        let mut text = serde_json::to_vec_pretty(&scenario)?;
        text.push(b'\n');
        output::write(&self.out, &text)?;
        writeln!(
            io::stdout().lock(),
            "{}: {} actors; next: wildcity scenario check {}",
            self.out.display(),
            scenario.actors.len(),
            self.out.display()
        )?;
        Ok(())
    }
}

fn openscenario_bytes() -> u64 {
    wildcity_convert::TEXT_BYTES as u64
}
