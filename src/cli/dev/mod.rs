//! `wildcity dev`: tools that measure and debug the program itself.

#[cfg(feature = "gpu")]
mod bisect;
#[cfg(feature = "gpu")]
mod devices;
mod lod;
mod repair;
#[cfg(feature = "stress")]
mod stress;

#[cfg(feature = "stress")]
pub(super) use stress::{BackendName, candidate};

/// Measure and debug: GPUs, wrong images, levels of detail, models that repair images.
///
/// `wildcity-bench`, which measures speed, is a program of its own that releases do not have: in
/// the source of wildcity, run cargo run --release -p wildcity-bench.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity dev devices
  wildcity dev bisect street --cameras views.json
  wildcity dev lod street")]
pub(super) struct Dev {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    #[cfg(feature = "gpu")]
    Devices(devices::Devices),
    #[cfg(feature = "gpu")]
    Bisect(bisect::Bisect),
    #[cfg(feature = "stress")]
    Stress(stress::Stress),
    Lod(lod::Lod),
    Repair(repair::Repair),
}

impl Dev {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
