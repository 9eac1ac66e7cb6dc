//! `wildcity episode`: suites of scenarios, and recorded episodes.

mod compare;
mod diff;
mod export;
mod folder;
mod kept;
mod list;
mod prune;
mod run;
mod run_agent;
mod score;
mod show;
mod verify;
mod video;

use std::path::{Path, PathBuf};

use wildcity_episode::{EpisodeFile, ReadError};
use wildcity_suite::ExitCode;

use super::directories::Episodes;
use super::exit::Exit;
use folder::record_file;

/// Drive suites of scenarios; compare runs; list, score, verify and export recorded episodes.
///
/// Exit codes of all of these commands: 0 for success; 1 if an episode failed (run), a run is worse
/// (compare), two episodes differ (diff), images differ from the recorded ones (verify), or an
/// episode cannot be scored, rendered or written; 2 for a mistake in the command line, and for a
/// file or folder that is missing or cannot be read. `run` also has 3 and 4, and `verify` 3, which
/// their help explains.
///
/// A record is named SCENARIO-SEED-1, with a sweep SCENARIO-COMBINATION-SEED-1. SCENARIO-SEED.2-1
/// is the second attempt, after a technical failure of the first.
#[derive(Debug, clap::Args)]
pub(super) struct Episode {
    #[command(subcommand)]
    command: Command,
}

super::subcommands! {
    Command;
    Run(Box<run::Run>),
    Compare(compare::Compare),
    List(list::List),
    Prune(prune::Prune),
    Show(show::Show),
    Verify(verify::Verify),
    Score(score::Score),
    Diff(diff::Diff),
    Export(Box<export::Export>),
    Video(Box<video::Video>),
}

impl Episode {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.command.run()
    }
}

/// Reads an episode.
///
/// # Errors
/// There is no such file, or it is not a record; exit code 2.
fn read(episode: &Path, episodes: &Episodes) -> anyhow::Result<EpisodeFile> {
    EpisodeFile::read(&record_file(episode, episodes)?).map_err(unreadable)
}

/// The file of an episode, after its first line was read.
///
/// # Errors
/// As for [`read`].
fn find_record(episode: &Path, episodes: &Episodes) -> anyhow::Result<PathBuf> {
    let path = record_file(episode, episodes)?;
    EpisodeFile::header(&path).map_err(unreadable)?;
    Ok(path)
}

fn unreadable(error: ReadError) -> anyhow::Error {
    bad_input(format!(
        "{error}; give the path of an episode's file, or its name as `wildcity episode list` prints it"
    ))
}

/// The error of a command for a mistake in its input: exit code 2.
fn bad_input(message: impl std::fmt::Display) -> anyhow::Error {
    exit(ExitCode::Usage, message)
}

/// The error of a command that failed, with an exit code.
fn exit(code: ExitCode, message: impl std::fmt::Display) -> anyhow::Error {
    Exit::error(code as u8, format!("{message:#}")).into()
}
