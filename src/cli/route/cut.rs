//! `wildcity route cut`.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;

use serde_json::json;

use super::to_json;
use crate::cli::import::read_trajectory;
use crate::cli::output;
use wildcity_scene::route::{self, Route};

/// Cut a drive into sub-trajectories of given lengths, all in the drive's own world.
///
/// Writes DIR/<name>-<length>-<number>.json for each, whose clock begins at 0, and DIR/index.json:
/// their names, stations on the drive and beginnings on its clock.
#[derive(Debug, clap::Args)]
pub(in crate::cli) struct Cut {
    /// The drive.
    #[arg(value_name = "FILE")]
    drive: PathBuf,

    /// Lengths, in metres.
    #[arg(long, value_name = "M", value_delimiter = ',', default_values_t = route::SUB_TRAJECTORY_LENGTHS_M)]
    length_m: Vec<f64>,

    /// From the start of one to the start of the next, in metres [default: the length, so that they
    /// do not overlap]
    #[arg(long, value_name = "M")]
    stride_m: Option<f64>,

    /// Directory for the files; made if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Cut {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let trajectory = read_trajectory(&self.drive)?;
        let route = Route::new(&trajectory)?;
        let mut labels = BTreeSet::new();
        for &length_m in &self.length_m {
            let label = route::length_label(length_m);
            let once = labels.insert(label.clone());
            anyhow::ensure!(
                once,
                "--length-m: two lengths would both be written to files called {label}; give each once"
            );
        }
        output::make_dir(&self.out)?;
        let mut index = Vec::new();
        for length_m in self.length_m {
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
            writeln!(io::stdout(), "{:>6} of {length_m} m", index.len() - before)?;
        }
        let index = json!({ "drive": trajectory.name, "cuts": index });
        output::write(&self.out.join("index.json"), format!("{index:#}\n").as_bytes())
    }
}
