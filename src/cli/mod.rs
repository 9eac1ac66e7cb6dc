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
#[cfg(feature = "alpasim")]
mod alpasim;
#[cfg(feature = "augment")]
mod augment;
pub mod backend_options;
#[cfg(feature = "gpu")]
mod bisect;
mod demo;
#[cfg(feature = "gpu")]
mod devices;
pub mod directories;
mod doctor;
#[cfg(feature = "alpasim")]
mod drive;
#[cfg(feature = "suite")]
mod episode;
#[cfg(feature = "eval")]
mod eval;
pub mod exit;
mod file_notes;
mod import;
mod input_files;
mod inspect;
mod left_out;
pub mod limits;
mod lod;
#[cfg(feature = "log")]
mod log;
mod map;
mod memory;
pub mod output;
#[cfg_attr(not(feature = "http"), allow(dead_code, reason = "only a push packs a folder"))]
mod packed_folder;
mod placement;
mod profile_options;
pub mod progress;
#[cfg(feature = "http")]
mod push;
mod render;
mod repair;
mod repair_options;
mod replay;
#[cfg(feature = "report")]
mod report;
mod rig;
mod route;
mod scenario;
pub mod scene_source;
mod serve;
mod sky_source;
#[cfg(feature = "stress")]
mod stress;
mod subcommands;
mod time;
#[cfg(feature = "train")]
mod train;
mod twin;
mod view;

use clap::error::ErrorKind;
use clap::{CommandFactory as _, FromArgMatches as _, Parser};

pub(crate) use subcommands::subcommands;

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

subcommands! {
    Command;
    Demo(demo::Demo),
    Serve(Box<serve::Serve>),
    View(view::View),
    Import(import::Import),
    Inspect(inspect::Inspect),
    #[cfg(feature = "http")]
    Push(push::Push),
    Lod(lod::Lod),
    #[cfg(feature = "log")]
    Log(log::LogCommand),
    Twin(twin::Twin),
    Actor(actor::Actor),
    Render(render::Render),
    #[cfg(feature = "eval")]
    Eval(Box<eval::Eval>),
    Repair(repair::Repair),
    #[cfg(feature = "augment")]
    Augment(Box<augment::Augment>),
    #[cfg(feature = "train")]
    Train(Box<train::Train>),
    #[cfg(feature = "alpasim")]
    Drive(drive::Drive),
    #[cfg(feature = "alpasim")]
    Alpasim(alpasim::Alpasim),
    Replay(replay::Replay),
    #[cfg(feature = "suite")]
    Episode(episode::Episode),
    Rig(rig::RigCommand),
    Route(route::Route),
    Scenario(scenario::ScenarioCommand),
    Map(map::MapCommand),
    Bench(Moved),
    #[cfg(feature = "gpu")]
    Bisect(bisect::Bisect),
    #[cfg(feature = "stress")]
    Stress(stress::Stress),
    #[cfg(feature = "report")]
    Report(report::Command),
    #[cfg(feature = "gpu")]
    Devices(devices::Devices),
    Doctor(doctor::Doctor),
}

/// Moved to the program `wildcity-bench`.
#[derive(Debug, clap::Args)]
#[command(hide = true, disable_help_flag = true)]
struct Moved {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _arguments: Vec<String>,
}

impl Moved {
    fn run(self) -> anyhow::Result<()> {
        anyhow::bail!(
            "wildcity bench is a program of its own: in the source of wildcity, run cargo run \
             --release -p wildcity-bench -- and the arguments after \"bench\""
        )
    }
}

/// Options of a command with their values; those without one are left out.
#[cfg(feature = "train")]
type Options = Vec<(&'static str, Option<std::ffi::OsString>)>;

/// Runs a command as from the command line, for commands that are made of others.
#[cfg(feature = "train")]
fn run_command(words: &[&std::ffi::OsStr], options: Options) -> anyhow::Result<()> {
    let mut arguments = vec!["wildcity".into()];
    arguments.extend(words.iter().map(std::ffi::OsString::from));
    for (name, value) in options {
        arguments.extend(value.into_iter().flat_map(|value| [name.into(), value]));
    }
    Arguments::try_parse_from(arguments)?.command.run()
}

/// Parses the command line, runs the command, and returns the exit code: 0 for success, 1 for a
/// failure, and 3 for a recording that is cut (`replay --verify`). A command line that cannot be
/// parsed ends the process with code 2.
pub fn main() -> ExitCode {
    let mut program = Arguments::command();
    if let Some(left_out) = left_out::help() {
        program = program
            .after_help(left_out.clone())
            .after_long_help(format!("{EXAMPLES}\n\n{left_out}"));
    }
    let parsed = program.try_get_matches().and_then(|found| Arguments::from_arg_matches(&found));
    let arguments = match parsed {
        Ok(arguments) => arguments,
        Err(error) => {
            match left_out::command().filter(|_| error.kind() == ErrorKind::InvalidSubcommand) {
                Some(left_out) => return exit::code(Err(left_out)),
                None => error.exit(),
            }
        }
    };
    exit::code(arguments.command.run())
}

#[cfg(test)]
#[path = "../../tests/support/help.rs"]
mod help;

#[cfg(test)]
mod tests {
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
        // serve, import, twin sky, render, eval, bisect; and push instead of serve.
        assert_eq!(counts, [6, 6]);
    }
}
