//! `wildcity route associate`.

use std::io::{self, Write};
use std::path::PathBuf;

use serde_json::json;

use super::read_times_us;
use crate::cli::import::read_trajectory;
use wildcity_scene::route;

/// Find which keyframe belongs to each time of another clock, as to the images of a camera.
///
/// A time and a keyframe belong together if each is the other's nearest and they are at most
/// --tolerance-us apart. Prints one JSON object: pairs with their residuals (keyframe minus time), the
/// times that found nothing, and the median and largest residual.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Associate {
    /// The drive.
    #[arg(value_name = "FILE")]
    drive: PathBuf,

    /// JSON list of times, in whole microseconds, rising.
    #[arg(long, value_name = "FILE")]
    times: PathBuf,

    /// Farthest that two times may be apart, in microseconds.
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
        writeln!(io::stdout().lock(), "{report}")?;
        Ok(())
    }
}
