//! `wildcity scenario from-log`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use serde_json::{Value, json};

use wildcity_log::{Log, Poses, Tracks};
use wildcity_scene::route::Route;
use wildcity_sim::scenario::ScenarioFile;

use crate::cli::output::{self, counted};

/// Make a scenario of a part of a log: the ego starts where the vehicle was, and every recorded
/// object repeats its track.
///
/// An object is drawn as the generated asset of its class whose size is the nearest. The route is
/// the drive of the log, which `wildcity import --log` gives the twin. Writes the scenario, and
/// beside it NAME.tracks.json and, if the log has a map, NAME.map.json.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario from-log log --twin street --at 12.5 --out merge.json
  wildcity scenario from-log log --twin street --at 12.5 --duration 30 --out merge.json")]
pub(in crate::cli) struct FromLog {
    /// Folder of the log.
    #[arg(value_name = "LOG")]
    log: PathBuf,

    /// Name of the twin, which has the drive of the log.
    #[arg(long, value_name = "NAME")]
    twin: String,

    /// When the scenario begins, in seconds on the log's clock.
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    at: f64,

    /// How long it is, in seconds; at most until the last pose.
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    duration: f64,

    /// Scenario file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Tracks begin this much before the scenario and end this much after it, in microseconds.
const AROUND_US: i64 = 2_000_000;

/// Time over which the speed at the start is measured, in microseconds.
const SPEED_US: i64 = 200_000;

impl FromLog {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let log = Log::open(&self.log)?;
        let poses = log.poses()?;
        let [first_us, last_us] = poses.span_us();
        let start_us = (1e6 * self.at).round() as i64;
        let is_within = self.at.is_finite() && (first_us..last_us).contains(&start_us);
        let [first_s, last_s] = [first_us, last_us].map(|us| us as f64 / 1e6);
        ensure!(is_within, "--at {}: the log has poses from {first_s} to {last_s} s", self.at);
        let is_long = self.duration > 0.0 && self.duration.is_finite();
        ensure!(is_long, "--duration {}: give more than 0 s", self.duration);
        let end_us = last_us.min(start_us.saturating_add((1e6 * self.duration).round() as i64));

        let span_us = [start_us.saturating_sub(AROUND_US), end_us.saturating_add(AROUND_US)];
        let tracks = Tracks::read(&log, span_us)?;
        let name = self.out.file_stem().and_then(|stem| stem.to_str());
        let stem = name.with_context(|| format!("--out {} has no name", self.out.display()))?;
        let beside = |end: &str| format!("{stem}.{end}.json");
        let tracks_name = (!tracks.is_empty()).then(|| beside("tracks"));
        let map = log.map()?;
        let map_name = map.is_some().then(|| beside("map"));

        let place = Place { start_us, end_us, names: [tracks_name.clone(), map_name.clone()] };
        let scenario = self.scenario(&log, &poses, stem, &place)?;
        if let Some(name) = tracks_name {
            let file = tracks.recorded_actors();
            file.check().context("the tracks of the log")?;
            output::write(&self.out.with_file_name(name), &serde_json::to_vec(&file)?)?;
        }
        if let (Some(name), Some(map)) = (map_name, map) {
            output::write(&self.out.with_file_name(name), map.to_json().as_bytes())?;
        }
        output::write(&self.out, format!("{scenario:#}\n").as_bytes())?;
        let out = self.out.display();
        let actors = counted(tracks.len(), "recorded actor");
        writeln!(output::stdout(), "{out}: {actors}; next: wildcity scenario check {out}")?;
        Ok(())
    }

    fn scenario(
        &self,
        log: &Log,
        poses: &Poses,
        name: &str,
        place: &Place,
    ) -> anyhow::Result<Value> {
        let Place { start_us, end_us, names: [tracks, map] } = place;
        let drive = poses.drive(log.header.name.clone());
        let route = Route::new(&drive)?;
        let station_m = route.station_at(*start_us);
        let moved_m = route.station_at(start_us.saturating_add(SPEED_US)) - station_m;
        let speed = moved_m / (SPEED_US as f64 / 1e6);
        let mut scenario = json!({
            "format": ScenarioFile::FORMAT,
            "name": name,
            "twin": {"name": self.twin},
            "ego": {
                "start": {"trajectory": drive.name, "station_m": station_m},
                "dynamics": {"model": "dynamic", "speed": speed},
            },
            "route": {"trajectory": drive.name},
            "end": {"time_s": (end_us - start_us) as f64 / 1e6},
        });
        if let Some(file) = tracks {
            scenario["tracks"] = json!({"file": file, "start_us": start_us});
        }
        if let Some(file) = map {
            scenario["map"] = json!({"file": file});
        }
        Ok(scenario)
    }
}

/// The time of a scenario, and the names of its tracks and its map.
struct Place {
    start_us: i64,
    end_us: i64,
    names: [Option<String>; 2],
}
