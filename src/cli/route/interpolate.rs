//! `wildcity route interpolate`.

use std::path::PathBuf;

use super::{read_times_us, to_json};
use crate::cli::import::read_trajectory;
use crate::cli::output;
use wildcity_scene::Trajectory;
use wildcity_scene::route::Route;
use wildcity_scene::trajectory::Keyframe;

/// Write where a drive was at given times: position linear, rotation spherical between keyframes.
///
/// A time before the first keyframe or after the last one is refused: nothing is extrapolated.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Interpolate {
    /// The drive.
    #[arg(value_name = "FILE")]
    drive: PathBuf,

    /// JSON list of times, in whole microseconds, rising.
    #[arg(long, value_name = "FILE")]
    times: PathBuf,

    /// What to write: the drive with a keyframe at each of the times.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Interpolate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        let at = |time_us| Ok(Keyframe { time_us, world_from_rig: route.pose_at(time_us)? });
        let keyframes = read_times_us(&self.times)?.into_iter().map(at);
        let keyframes = keyframes.collect::<anyhow::Result<_>>()?;
        let resampled = Trajectory { name: trajectory.name.clone(), keyframes };
        resampled.check()?;
        output::write(&self.out, &to_json(&resampled)?)
    }
}
