//! `wildcity route subsample`.

use std::io::{self, Write};
use std::path::PathBuf;

use super::to_json;
use crate::cli::import::read_trajectory;
use crate::cli::output;
use wildcity_scene::route::{self, Route};

/// Keep the recorded poses of a drive that are so far apart, and drop those between.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Subsample {
    /// The drive.
    #[arg(value_name = "FILE")]
    drive: PathBuf,

    /// Least distance between two poses, in metres, as the crow flies.
    #[arg(long, value_name = "M", default_value_t = route::KEYFRAME_SPACING_M)]
    step_m: f64,

    /// What to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Subsample {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let kept = Route::new(&trajectory)?.subsample(self.step_m)?;
        output::write(&self.out, &to_json(&kept)?)?;
        let (kept, all) = (kept.keyframes.len(), trajectory.keyframes.len());
        writeln!(io::stdout(), "{kept} of {all} keyframes")?;
        Ok(())
    }
}
