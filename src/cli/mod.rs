//! The command line: one file per subcommand.

use std::process::ExitCode;

mod backend_options;
mod bench;
mod bisect;
mod demo;
mod devices;
mod directories;
mod import;
mod inspect;
mod limits;
mod lod;
mod output;
mod profile_options;
mod progress;
mod push;
mod render;
mod replay;
mod report;
mod rig;
mod route;
mod scene_source;
mod serve;
mod sky_source;
mod stress;
mod time;
mod twin;

use clap::{Parser, Subcommand};

/// A closed-loop driving simulator server for city twins.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    Serve(serve::Serve),
    Import(import::Import),
    Inspect(inspect::Inspect),
    Push(push::Push),
    Lod(lod::Lod),
    Twin(twin::Twin),
    Render(render::Render),
    Replay(replay::Replay),
    Rig(rig::RigCommand),
    Route(route::Route),
    Bench(bench::Bench),
    Bisect(bisect::Bisect),
    Stress(stress::Stress),
    Report(report::Command),
    Devices(devices::Devices),
}

/// Parses the command line, runs, and tells how it went: 0 done, 1 failed, 2 not understood.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match arguments.command {
        Command::Demo(command) => command.run(),
        Command::Serve(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Inspect(command) => command.run(),
        Command::Push(command) => command.run(),
        Command::Lod(command) => command.run(),
        Command::Twin(command) => command.run(),
        Command::Render(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Rig(command) => command.run(),
        Command::Route(command) => command.run(),
        Command::Bench(command) => command.run(),
        Command::Bisect(command) => command.run(),
        Command::Stress(command) => command.run(),
        Command::Report(command) => command.run(),
        Command::Devices(command) => command.run(),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
