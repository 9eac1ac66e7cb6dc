//! `wildcity twin route associate`.

use std::io::Write;
use std::path::PathBuf;

use serde_json::json;

use super::files::read_times_us;
use crate::cli::input_files::read_trajectory;
use crate::cli::output;
use wildcity_scene::route;

/// Match the keyframes of a drive with the times of another clock, for example those of a camera's
/// images.
///
/// A time and a keyframe match if each is the other's nearest, and they are at most --tolerance-us
/// apart. Prints one JSON object: the pairs with their residuals (keyframe time minus time), the
/// times without a keyframe, and the median and the largest residual, all in microseconds.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity twin route associate log.json --times images.json --tolerance-us 20000 | jq .residual_us_median")]
pub(in crate::cli) struct Associate {
    /// The drive: a JSON file as `wildcity import --trajectory` reads it.
    #[arg(value_name = "DRIVE")]
    drive: PathBuf,

    /// JSON list of times, in whole microseconds, rising.
    #[arg(long, value_name = "FILE")]
    times: PathBuf,

    /// Largest difference of two matching times, in microseconds.
    #[arg(long, value_name = "US", default_value_t = 50_000)]
    tolerance_us: i64,
}

impl Associate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let times_us = read_times_us(&self.times)?;
        let keyframes_us: Vec<i64> = trajectory.keyframes.iter().map(|k| k.time_us).collect();
        let found = route::associate(&times_us, &keyframes_us, self.tolerance_us)?;
        let mut residuals_us: Vec<i64> = found.pairs.iter().map(|pair| pair.residual_us).collect();
        // With their signs: the median then shows a constant difference of the two clocks.
        residuals_us.sort_unstable();
        let pairs = found.pairs.iter().map(|pair| {
            json!({
                "time_us": times_us[pair.first],
                "keyframe": pair.second,
                "residual_us": pair.residual_us,
            })
        });
        let report = json!({
            "pairs": pairs.collect::<Vec<_>>(),
            "alone_us": found.unmatched.iter().map(|&at| times_us[at]).collect::<Vec<_>>(),
            "residual_us_median": residuals_us.get(residuals_us.len() / 2),
            "residual_us_largest": residuals_us.iter().map(|us| us.unsigned_abs()).max(),
        });
        writeln!(output::stdout(), "{report}")?;
        Ok(())
    }
}
