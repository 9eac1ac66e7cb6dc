//! `wildcity twin route measure`.

use std::io::Write;
use std::path::PathBuf;

use serde_json::json;

use crate::cli::input_files::read_trajectory;
use crate::cli::output;
use wildcity_scene::Trajectory;
use wildcity_scene::route::{Route, RouteChunk};

/// Show the length of a drive, and its chunks of 5 km.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin route measure log.json
  wildcity twin route measure log.json --json | jq .length_m")]
pub(in crate::cli) struct Measure {
    /// The drive: a JSON file as `wildcity import --trajectory` reads it.
    #[arg(value_name = "DRIVE")]
    drive: PathBuf,

    /// Print one JSON object, with the station of every keyframe in metres.
    #[arg(long)]
    json: bool,
}

impl Measure {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        // A file without keyframes was refused by `Route::new`.
        let first = &trajectory.keyframes[0];
        let last = &trajectory.keyframes[trajectory.keyframes.len() - 1];
        let seconds = last.time_us.abs_diff(first.time_us) as f64 * 1e-6;
        let mut out = output::stdout();
        if self.json {
            writeln!(out, "{}", json_report(&trajectory, &route, seconds))?;
            return Ok(());
        }
        writeln!(
            out,
            "{}: {}, {:.1} m in {seconds:.1} s",
            trajectory.name,
            output::counted(trajectory.keyframes.len(), "keyframe"),
            route.length_m()
        )?;
        for chunk in route.chunks() {
            let [from_m, to_m] = chunk.stations_m;
            let keyframes = output::counted(chunk.keyframes.len(), "keyframe");
            writeln!(
                out,
                "chunk {:<4} {from_m:>10.1} to {to_m:>10.1} m, {keyframes}",
                chunk.number
            )?;
        }
        Ok(())
    }
}

fn json_report(trajectory: &Trajectory, route: &Route<'_>, seconds: f64) -> serde_json::Value {
    let chunk = |chunk: &RouteChunk| {
        json!({
            "number": chunk.number,
            "keyframes": [chunk.keyframes.start, chunk.keyframes.end],
            "stations_m": chunk.stations_m,
        })
    };
    json!({
        "name": trajectory.name,
        "length_m": route.length_m(),
        "seconds": seconds,
        "stations_m": route.stations_m(),
        "chunks": route.chunks().iter().map(chunk).collect::<Vec<_>>(),
    })
}
