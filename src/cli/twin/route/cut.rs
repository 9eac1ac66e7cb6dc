//! `wildcity twin route cut`.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::PathBuf;

use serde_json::json;

use super::files::to_json;
use crate::cli::input_files::read_trajectory;
use crate::cli::output;
use wildcity_scene::route::{self, Route};

/// Cut a drive into shorter drives of given lengths, in the same world.
///
/// Writes DIR/<name>-<length>-<number>.json for each cut, with a clock that starts at 0, and
/// DIR/index.json with the name of each cut, its stations on the drive in metres, and its start on
/// the drive's clock in microseconds.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin route cut log.json --out cuts
  wildcity twin route cut log.json --length-m 50,200 --stride-m 25 --out cuts")]
pub(in crate::cli) struct Cut {
    /// The drive: a JSON file as `wildcity import --trajectory` reads it.
    #[arg(value_name = "DRIVE")]
    drive: PathBuf,

    /// Lengths of the cuts, in metres.
    #[arg(long, value_name = "M", value_delimiter = ',', default_values_t = route::SUB_TRAJECTORY_LENGTHS_M)]
    length_m: Vec<f64>,

    /// Distance from the start of one cut to the start of the next, in metres [default: the length,
    /// so that cuts do not overlap]
    #[arg(long, value_name = "M")]
    stride_m: Option<f64>,

    /// Directory for the files; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Cut {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        // Before anything is written: the second of two equal names would replace the first.
        self.check_labels()?;
        output::create_dir(&self.out)?;
        let mut index = Vec::new();
        for &length_m in &self.length_m {
            let before = index.len();
            for cut in route::sub_trajectories(&route, length_m, self.stride_m.unwrap_or(length_m))?
            {
                let cut = cut?;
                let name = &cut.trajectory.name;
                output::write(&self.out.join(format!("{name}.json")), &to_json(&cut.trajectory)?)?;
                index.push(json!({
                    "name": name,
                    "stations_m": cut.stations_m,
                    "from_us": cut.from_us,
                }));
            }
            writeln!(output::stdout(), "{:>6} of {length_m} m", index.len() - before)?;
        }
        let index = json!({ "drive": trajectory.name, "cuts": index });
        output::write(&self.out.join("index.json"), format!("{index:#}\n").as_bytes())
    }

    /// Checks that the cuts of two lengths do not have the same file names.
    fn check_labels(&self) -> anyhow::Result<()> {
        let mut labels = BTreeSet::new();
        for &length_m in &self.length_m {
            let label = route::length_label(length_m);
            let is_new = labels.insert(label.clone());
            anyhow::ensure!(
                is_new,
                "--length-m: two lengths would both be written to files called {label}; give each once"
            );
        }
        Ok(())
    }
}
