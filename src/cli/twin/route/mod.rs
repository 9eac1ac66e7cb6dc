//! `wildcity twin route`.

mod associate;
mod capture;
mod cut;
mod files;
mod interpolate;
mod measure;
mod subsample;

/// Measure a recorded drive, cut it, match its clock with another clock, or make one from camera
/// poses.
///
/// Drives are JSON files as `wildcity import --trajectory` reads them. The results are such files
/// too, in the same world.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin route measure log.json
  wildcity twin route subsample log.json --step-m 0.5 --out sparse.json
  wildcity twin route cut log.json --length-m 100 --out cuts")]
pub(super) struct Route {
    #[command(subcommand)]
    subcommand: Subcommand,
}

crate::cli::subcommands! {
    Subcommand;
    Measure(measure::Measure),
    Subsample(subsample::Subsample),
    Cut(cut::Cut),
    Associate(associate::Associate),
    Interpolate(interpolate::Interpolate),
    FromColmap(capture::FromColmap),
    FromNerfstudio(capture::FromNerfstudio),
}

impl Route {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
