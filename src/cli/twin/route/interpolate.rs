//! `wildcity twin route interpolate`.

use std::path::PathBuf;

use super::files::{read_times_us, to_json};
use crate::cli::input_files::read_trajectory;
use crate::cli::output;
use wildcity_scene::Trajectory;
use wildcity_scene::route::Route;
use wildcity_scene::trajectory::Keyframe;

/// Write the poses of a drive at given times.
///
/// Between keyframes the position is interpolated linearly and the rotation spherically. A time
/// before the first keyframe or after the last one is an error: nothing is extrapolated.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity twin route interpolate log.json --times images.json --out at_images.json")]
pub(in crate::cli) struct Interpolate {
    /// The drive: a JSON file as `wildcity import --trajectory` reads it.
    #[arg(value_name = "DRIVE")]
    drive: PathBuf,

    /// JSON list of times, in whole microseconds, rising.
    #[arg(long, value_name = "FILE")]
    times: PathBuf,

    /// JSON file to write: the drive with a keyframe at each of the times.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Interpolate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        let keyframe_at =
            |time_us| Ok(Keyframe { time_us, world_from_rig: route.pose_at(time_us)? });
        let keyframes = read_times_us(&self.times)?
            .into_iter()
            .map(keyframe_at)
            .collect::<anyhow::Result<_>>()?;
        let resampled = Trajectory { name: trajectory.name.clone(), keyframes };
        resampled.check()?;
        output::write(&self.out, &to_json(&resampled)?)
    }
}
