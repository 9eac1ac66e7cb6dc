//! `wildcity twin route subsample`.

use std::io::Write;
use std::path::PathBuf;

use super::files::to_json;
use crate::cli::input_files::read_trajectory;
use crate::cli::output;
use wildcity_scene::route::{self, Route};

/// Drop keyframes of a drive that are closer together than a given distance.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity twin route subsample log.json --step-m 0.5 --out sparse.json")]
pub(in crate::cli) struct Subsample {
    /// The drive: a JSON file as `wildcity import --trajectory` reads it.
    #[arg(value_name = "DRIVE")]
    drive: PathBuf,

    /// Least straight-line distance between two kept poses, in metres.
    #[arg(long, value_name = "M", default_value_t = route::KEYFRAME_SPACING_M)]
    step_m: f64,

    /// JSON file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Subsample {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let kept = Route::new(&trajectory)?.subsample(self.step_m)?;
        output::write(&self.out, &to_json(&kept)?)?;
        let kept_count = kept.keyframes.len();
        let all = output::counted(trajectory.keyframes.len(), "keyframe");
        writeln!(output::stdout(), "{kept_count} of {all}")?;
        Ok(())
    }
}
