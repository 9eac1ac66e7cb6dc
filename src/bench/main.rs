//! `wildcity-bench`: measures the speed of the renderer, of sessions, of actors and of reading
//! twins.
//!
//! A program of its own, which is not shipped: users of wildcity do not need it.

use std::process::ExitCode;

use clap::{CommandFactory as _, FromArgMatches as _};

use wildcity::cli::{exit, help_all};

mod actors;
mod benched_twin;
mod delivery;
mod drive;
mod gpu;
mod load;
mod memory;
mod processor;
mod sessions;
mod size;
mod soak;
mod step;
mod timed;

/// Measure the speed of the renderer, of sessions, of actors, and of reading twins.
#[derive(Debug, clap::Parser)]
#[command(
    version,
    arg_required_else_help = true,
    after_long_help = "\
Examples:
  wildcity-bench step street.ply --cameras cameras.json
  wildcity-bench drive street --csv steps.csv
  wildcity-bench sessions street --size 96x60
  wildcity-bench delivery street
  wildcity-bench actors street
  wildcity-bench load street
  wildcity-bench soak street"
)]
struct Bench {
    #[command(subcommand)]
    subcommand: Subcommand,
}

#[derive(Debug, clap::Subcommand)]
enum Subcommand {
    Step(step::Step),
    Gpu(gpu::Gpu),
    Drive(Box<drive::Drive>),
    Sessions(Box<sessions::Sessions>),
    Delivery(Box<delivery::Delivery>),
    Actors(Box<actors::Actors>),
    Load(load::Load),
    Soak(soak::Soak),
}

impl Bench {
    fn run(self) -> anyhow::Result<()> {
        match self.subcommand {
            Subcommand::Step(step) => step.run(),
            Subcommand::Gpu(gpu) => gpu.run(),
            Subcommand::Drive(drive) => drive.run(),
            Subcommand::Sessions(sessions) => sessions.run(),
            Subcommand::Delivery(delivery) => delivery.run(),
            Subcommand::Actors(actors) => actors.run(),
            Subcommand::Load(load) => load.run(),
            Subcommand::Soak(soak) => soak.run(),
        }
    }
}

fn main() -> ExitCode {
    // As the program that it measures.
    wildcity_heap::map_large_blocks();
    let matches = help_all::program(Bench::command(), help_all::is_asked()).get_matches();
    match Bench::from_arg_matches(&matches) {
        Ok(bench) => exit::code(bench.run()),
        Err(error) => error.exit(),
    }
}

#[cfg(test)]
#[path = "../../tests/support/help.rs"]
mod help;

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn every_command_and_option_is_explained_and_has_an_example() {
        help::check(&Bench::command(), 8);
    }
}
