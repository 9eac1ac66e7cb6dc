//! `wildcity route`.

mod associate;
mod cut;
mod interpolate;
mod measure;
mod subsample;

use std::path::Path;

use anyhow::Context;

use crate::cli::limits;
use wildcity_scene::Trajectory;
use wildcity_twin::ingest;

/// Measure a recorded drive, cut it, and match its clock with another one.
///
/// Drives are the JSON files that `wildcity import --trajectory` reads, and what is made of them is
/// such files again, in the same world.
#[derive(Debug, clap::Args)]
pub(super) struct Route {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Measure(measure::Measure),
    Subsample(subsample::Subsample),
    Cut(cut::Cut),
    Associate(associate::Associate),
    Interpolate(interpolate::Interpolate),
}

impl Route {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Measure(measure) => measure.run(),
            What::Subsample(subsample) => subsample.run(),
            What::Cut(cut) => cut.run(),
            What::Associate(associate) => associate.run(),
            What::Interpolate(interpolate) => interpolate.run(),
        }
    }
}

/// Reads the times of another clock: a JSON list of whole microseconds.
fn read_times_us(path: &Path) -> anyhow::Result<Vec<i64>> {
    let text = ingest::read_whole(path, limits::SETTINGS_FILE_BYTES);
    let text = text.with_context(|| format!("{}", path.display()))?;
    serde_json::from_slice(&text).with_context(|| {
        format!("cannot read {} as a JSON list of whole microseconds", path.display())
    })
}

/// A drive as its file has it.
fn to_json(trajectory: &Trajectory) -> anyhow::Result<Vec<u8>> {
    let mut text = serde_json::to_vec(trajectory)?;
    text.push(b'\n');
    Ok(text)
}
