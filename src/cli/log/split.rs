//! `wildcity log split`.

use std::io::Write;
use std::path::PathBuf;

use wildcity_log::Log;
use wildcity_log::split::{SplitSettings, split};
use wildcity_scene::route;

use crate::cli::output::{self, counted};

/// Split a log into chunks with the images of keyframes, and its drive into sub-trajectories.
///
/// Writes DIR/NAME-0000 and so on, each a log of its own: of each camera the first image of every
/// 0.5 m of the drive, every 8th of them marked as held out, and everything else of that time.
/// Files stay where they are. DIR/drives has the sub-trajectories as drives, and DIR/split.json
/// lists all of it. Rows are read once, whatever the length of the log.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity log split log --out parts
  wildcity log split log --out parts --chunk-m 1000 --length-m 50,100")]
pub(super) struct SplitCommand {
    /// Folder of the log.
    #[arg(value_name = "LOG")]
    log: PathBuf,

    /// Folder of the parts, which must not exist yet.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Distance between two images of a camera along the drive, in metres.
    #[arg(long, value_name = "M", default_value_t = route::KEYFRAME_SPACING_M, value_parser = metres)]
    keyframe_m: f64,

    /// Length of a chunk along the drive, in metres.
    #[arg(long, value_name = "M", default_value_t = route::ROUTE_CHUNK_LENGTH_M, value_parser = metres)]
    chunk_m: f64,

    /// Hold out every Nth keyframe of each camera, beginning with the first.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(2..))]
    held_out_every: u32,

    /// Lengths of the sub-trajectories, in metres.
    #[arg(long, value_name = "M", value_delimiter = ',', default_values_t = route::SUB_TRAJECTORY_LENGTHS_M)]
    length_m: Vec<f64>,
}

impl SplitCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = Log::open(&self.log)?;
        let settings = SplitSettings {
            keyframe_m: self.keyframe_m,
            chunk_m: self.chunk_m,
            held_out_every: self.held_out_every as usize,
            lengths_m: self.length_m,
        };
        let done = split(&log, &self.out, &settings)?;
        let mut out = output::stdout();
        for chunk in &done.chunks {
            let [from_m, to_m] = chunk.stations_m;
            let images = counted(chunk.images, "image");
            let held_out = chunk.held_out;
            let name = &chunk.name;
            writeln!(out, "{name}: {from_m:.0} to {to_m:.0} m, {images}, {held_out} held out")?;
        }
        writeln!(out, "{}", counted(done.drives.len(), "sub-trajectory drive"))?;
        Ok(())
    }
}

fn metres(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(length_m) if (0.01..=1e6).contains(&length_m) => Ok(length_m),
        _ => Err("expected 0.01 to 1000000 m".to_owned()),
    }
}
