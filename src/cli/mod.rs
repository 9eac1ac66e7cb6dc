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
mod backend_options;
mod bench;
mod bisect;
mod demo;
mod devices;
mod directories;
mod doctor;
mod drive;
mod episode;
mod eval;
mod exit;
mod file_notes;
mod import;
mod input_files;
mod inspect;
mod limits;
mod lod;
mod map;
mod output;
mod packed_folder;
mod placement;
mod profile_options;
mod progress;
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
mod scene_source;
mod serve;
mod sky_source;
mod stress;
mod time;
mod train;
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
    Train(train::Train),
    Drive(drive::Drive),
    Alpasim(alpasim::Alpasim),
    Replay(replay::Replay),
    Episode(episode::Episode),
    Rig(rig::RigCommand),
    Route(route::Route),
    Scenario(scenario::ScenarioCommand),
    Map(map::MapCommand),
    Bench(bench::Bench),
    Bisect(bisect::Bisect),
    Stress(stress::Stress),
    Report(report::Command),
    Devices(devices::Devices),
    Doctor(doctor::Doctor),
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
        Command::Train(command) => command.run(),
        Command::Drive(command) => command.run(),
        Command::Alpasim(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Episode(command) => command.run(),
        Command::Rig(command) => command.run(),
        Command::Route(command) => command.run(),
        Command::Scenario(command) => command.run(),
        Command::Map(command) => command.run(),
        Command::Bench(command) => command.run(),
        Command::Bisect(command) => command.run(),
        Command::Stress(command) => command.run(),
        Command::Report(command) => command.run(),
        Command::Devices(command) => command.run(),
        Command::Doctor(command) => command.run(),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let exit = error.downcast_ref::<exit::Exit>();
            if exit.is_some_and(|exit| exit.is_finding) {
                eprintln!("{error}");
            } else {
                eprintln!("error: {}", exit::chain(&error));
            }
            exit.map_or(ExitCode::FAILURE, |exit| exit.code.into())
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    /// The commands without subcommands, each with the words that select it.
    fn leaf_commands(command: &clap::Command, path: &str) -> Vec<(String, clap::Command)> {
        let path = format!("{path}{} ", command.get_name());
        let mut leaves: Vec<_> =
            command.get_subcommands().flat_map(|sub| leaf_commands(sub, &path)).collect();
        if leaves.is_empty() {
            leaves.push((path.trim_end().to_owned(), command.clone()));
        }
        leaves
    }

    fn all_leaves() -> Vec<(String, clap::Command)> {
        leaf_commands(&Arguments::command(), "")
    }

    #[test]
    fn every_command_and_option_is_explained_and_has_an_example() {
        let leaves = all_leaves();
        assert!(leaves.len() > 25, "{} commands", leaves.len());
        for (path, command) in leaves {
            let after = command.get_after_long_help().map(ToString::to_string).unwrap_or_default();
            assert!(command.get_about().is_some(), "{path} has no description");
            assert!(after.contains(&path) && after.contains("Example"), "{path} has no example");
            for argument in command.get_arguments() {
                assert!(argument.get_help().is_some(), "{path}: {} has no help", argument.get_id());
            }
        }
    }

    #[test]
    fn profile_is_a_file_and_set_is_a_field_on_every_command() {
        let mut counts = [0; 2];
        for (path, command) in all_leaves() {
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
        // serve, import, render, eval, bench step, bisect; and push instead of serve.
        assert_eq!(counts, [6, 6]);
    }

    #[test]
    fn the_arguments_are_consistent() {
        Arguments::command().debug_assert();
    }
}
