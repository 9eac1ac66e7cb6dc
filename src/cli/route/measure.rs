//! `wildcity route measure`.

use std::io::{self, Write};
use std::path::PathBuf;

use serde_json::json;

use crate::cli::import::read_trajectory;
use wildcity_scene::route::Route;

/// Show how long a drive is, and its chunks of 5 km.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Measure {
    /// The drive.
    #[arg(value_name = "FILE")]
    drive: PathBuf,

    /// Print one JSON object, with the station of every keyframe.
    #[arg(long)]
    json: bool,
}

impl Measure {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        let (keyframes, length_m) = (&trajectory.keyframes, route.length_m());
        let [from_us, to_us] = [keyframes[0], keyframes[keyframes.len() - 1]].map(|k| k.time_us);
        let seconds = to_us.abs_diff(from_us) as f64 * 1e-6;
        let chunks = route.chunks();
        let mut out = io::stdout().lock();
        if self.json {
            let chunk = |chunk: &wildcity_scene::route::RouteChunk| {
                json!({
                    "number": chunk.number,
                    "keyframes": [chunk.keyframes.start, chunk.keyframes.end],
                    "stations_m": chunk.stations_m,
                })
            };
            let report = json!({
                "name": trajectory.name,
                "length_m": length_m,
                "seconds": seconds,
                "stations_m": route.stations_m(),
                "chunks": chunks.iter().map(chunk).collect::<Vec<_>>(),
            });
            writeln!(out, "{report}")?;
            return Ok(());
        }
        writeln!(
            out,
            "{}: {} keyframes, {length_m:.1} m in {seconds:.1} s",
            trajectory.name,
            keyframes.len()
        )?;
        for chunk in chunks {
            let [from_m, to_m] = chunk.stations_m;
            let count = chunk.keyframes.len();
            writeln!(
                out,
                "chunk {:<4} {from_m:>10.1} to {to_m:>10.1} m, {count} keyframes",
                chunk.number
            )?;
        }
        Ok(())
    }
}
