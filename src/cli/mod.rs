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
pub mod backend_options;
mod browser;
mod caption;
mod completions;
mod demo;
mod dev;
pub mod directories;
mod doctor;
#[cfg(feature = "suite")]
mod episode;
#[cfg(feature = "eval")]
mod eval;
pub mod exit;
mod file_notes;
mod groups;
pub mod help_all;
mod import;
mod input_files;
mod left_out;
pub mod limits;
#[cfg(feature = "log")]
mod log;
mod memory;
mod moved;
pub mod output;
#[cfg_attr(not(feature = "http"), allow(dead_code, reason = "only a push packs a folder"))]
mod packed_folder;
mod placement;
mod profile_options;
pub mod progress;
#[cfg(feature = "http")]
mod push;
mod render;
mod repair_options;
#[cfg(feature = "report")]
mod report;
mod scenario;
pub mod scene_source;
mod serve;
mod sky_source;
mod subcommands;
mod time;
#[cfg(feature = "train")]
mod train;
mod twin;

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
  wildcity help import                            (options and examples of one command)
  wildcity serve --help-all                       (also the options that few need)";

// In the order of the groups of the help.
subcommands! {
    Command;
    Demo(demo::Demo),
    Serve(Box<serve::Serve>),
    Doctor(doctor::Doctor),
    Import(import::Import),
    #[cfg(feature = "http")]
    Push(push::Push),
    Twin(twin::Twin),
    Actor(actor::Actor),
    #[cfg(feature = "log")]
    Log(log::LogCommand),
    #[cfg(feature = "train")]
    Train(Box<train::Train>),
    Scenario(scenario::ScenarioCommand),
    #[cfg(feature = "suite")]
    Episode(episode::Episode),
    #[cfg(feature = "alpasim")]
    Alpasim(alpasim::Alpasim),
    Render(render::Render),
    #[cfg(feature = "eval")]
    Eval(Box<eval::Eval>),
    #[cfg(feature = "report")]
    Report(report::Command),
    Dev(dev::Dev),
    Completions(completions::Completions),
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
/// failure, and 3 for a recording that is cut (`episode verify`). A command line that cannot be
/// parsed ends the process with code 2.
pub fn main() -> ExitCode {
    wildcity_heap::map_large_blocks();
    let whole = help_all::program(program(), help_all::is_asked());
    let parsed = whole.try_get_matches().and_then(|found| Arguments::from_arg_matches(&found));
    match parsed {
        Ok(arguments) => exit::code(arguments.command.run()),
        Err(error) if error.kind() == ErrorKind::InvalidSubcommand => {
            let moved = moved::command(std::env::args_os().skip(1)).map(anyhow::Error::from);
            match moved.or_else(left_out::command) {
                Some(elsewhere) => exit::code(Err(elsewhere)),
                None => error.exit(),
            }
        }
        Err(error) => error.exit(),
    }
}

/// The program with the help of this build.
fn program() -> clap::Command {
    let program = groups::grouped(Arguments::command());
    match left_out::help() {
        Some(left_out) => {
            let after = format!("{EXAMPLES}\n\n{left_out}");
            program.after_help(left_out).after_long_help(after)
        }
        None => program,
    }
}

#[cfg(test)]
#[path = "../../tests/support/help.rs"]
mod help;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_and_option_is_explained_and_has_an_example() {
        let program = help_all::program(program(), false);
        help::check(&program, 60);
        let top = program.get_subcommands().filter(|command| command.get_name() != "help");
        assert!(top.count() <= 17, "a new command belongs to one of those that are there");
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
