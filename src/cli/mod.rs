//! The command line: one file, or one folder, for each subcommand.
//!
//! A command reads its options, calls the packages below, and prints. Long work shows a progress
//! bar on standard error if that is a terminal; results go to standard output. Exit codes: 0 for
//! success, 1 for a failure, 2 for a command line that cannot be parsed, and for `episode` also for
//! a file that is missing or of another kind; `episode run` has more, which its help lists.
//!
//! Each package has an error enum. Its `Display` text says everything, down to the text of the
//! operating system. So an error is printed once, with its causes, and the commands add only the
//! flag or the file that it belongs to. Numbers from outside are printed with `{:?}`, which writes
//! 1e300 as such and not as 301 digits.

use std::process::ExitCode;

mod actor;
mod alpasim;
mod augment;
pub mod backend_options;
mod bisect;
mod demo;
mod devices;
pub mod directories;
mod doctor;
mod drive;
mod episode;
mod eval;
pub mod exit;
mod file_notes;
mod import;
mod input_files;
mod inspect;
pub mod limits;
mod lod;
mod map;
pub mod output;
mod packed_folder;
mod placement;
mod profile_options;
pub mod progress;
mod push;
mod real_images;
mod render;
mod repair;
mod repair_options;
mod replay;
mod report;
mod rig;
mod route;
mod scenario;
pub mod scene_source;
mod serve;
mod sky_source;
mod stress;
mod time;
mod twin;
mod view;

use clap::{Parser, Subcommand};

/// A closed-loop driving simulator server for city twins made of 3D Gaussians.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true, after_long_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "\
Examples:
  wildcity demo                                   (build a street, drive through it, look at images)
  wildcity demo --view                            (drive through it by hand, in the browser)
  wildcity import street.ply --twin street --axes y-down-z-forward
  wildcity serve                                  (then an agent can open the twin \"street\")
  wildcity help import                            (options and examples of one command)";

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    // It has the most options.
    Serve(Box<serve::Serve>),
    View(view::View),
    Import(import::Import),
    Inspect(inspect::Inspect),
    Push(push::Push),
    Lod(lod::Lod),
    Twin(twin::Twin),
    Actor(actor::Actor),
    Render(render::Render),
    Eval(Box<eval::Eval>),
    Repair(repair::Repair),
    Augment(Box<augment::Augment>),
    Drive(drive::Drive),
    Alpasim(alpasim::Alpasim),
    Replay(replay::Replay),
    Episode(episode::Episode),
    Rig(rig::RigCommand),
    Route(route::Route),
    Scenario(scenario::ScenarioCommand),
    Map(map::MapCommand),
    /// Moved to the program `wildcity-bench`.
    #[command(hide = true, disable_help_flag = true)]
    Bench(Moved),
    Bisect(bisect::Bisect),
    Stress(stress::Stress),
    Report(report::Command),
    Devices(devices::Devices),
    Doctor(doctor::Doctor),
}

/// The arguments of a command that is elsewhere.
#[derive(Debug, clap::Args)]
struct Moved {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _arguments: Vec<String>,
}

/// Parses the command line, runs the command, and returns the exit code: 0 for success, 1 for a
/// failure, and 3 for a recording that is cut (`replay --verify`). A command line that cannot be
/// parsed ends the process with code 2.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match arguments.command {
        Command::Demo(command) => command.run(),
        Command::Serve(command) => command.run(),
        Command::View(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Inspect(command) => command.run(),
        Command::Push(command) => command.run(),
        Command::Lod(command) => command.run(),
        Command::Twin(command) => command.run(),
        Command::Actor(command) => command.run(),
        Command::Render(command) => command.run(),
        Command::Eval(command) => command.run(),
        Command::Repair(command) => command.run(),
        Command::Augment(command) => command.run(),
        Command::Drive(command) => command.run(),
        Command::Alpasim(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Episode(command) => command.run(),
        Command::Rig(command) => command.run(),
        Command::Route(command) => command.run(),
        Command::Scenario(command) => command.run(),
        Command::Map(command) => command.run(),
        Command::Bench(_) => Err(anyhow::anyhow!(
            "wildcity bench is a program of its own: in the source of wildcity, run cargo run \
             --release -p wildcity-bench -- and the arguments after \"bench\""
        )),
        Command::Bisect(command) => command.run(),
        Command::Stress(command) => command.run(),
        Command::Report(command) => command.run(),
        Command::Devices(command) => command.run(),
        Command::Doctor(command) => command.run(),
    };
    exit::code(result)
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
        help::check(&Arguments::command(), 60);
    }

    #[test]
    fn profile_is_a_file_and_set_is_a_field_on_every_command() {
        let mut counts = [0; 2];
        for (path, command) in help::leaf_commands(&Arguments::command()) {
            for argument in command.get_arguments() {
                let names = argument.get_value_names().unwrap_or_default();
                let names: Vec<&str> = names.iter().map(|name| name.as_str()).collect();
                let expected = match argument.get_long() {
                    Some("profile") => (0, ["FILE"]),
                    Some("set") => (1, ["FIELD=VALUE"]),
                    _ => continue,
                };
                counts[expected.0] += 1;
                assert_eq!(names, expected.1, "{path} --{}", argument.get_long().unwrap());
            }
        }
        // serve, import, render, eval, bisect; and push instead of serve.
        assert_eq!(counts, [5, 5]);
    }
}
