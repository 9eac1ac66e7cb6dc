//! `wildcity episode`: suites of scenarios, and recorded episodes.

mod diff;
mod export;
mod kept;
mod list;
mod run;
mod score;
mod show;
mod video;

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use wildcity_episode::EpisodeFile;

use super::directories::Episodes;

/// Drive suites of scenarios; list, score, compare and export recorded episodes.
#[derive(Debug, clap::Args)]
pub(super) struct Episode {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Run(Box<run::Run>),
    List(list::List),
    Show(show::Show),
    Score(score::Score),
    Diff(diff::Diff),
    Export(Box<export::Export>),
    Video(Box<video::Video>),
}

impl Episode {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Run(command) => command.run(),
            Command::List(command) => command.run(),
            Command::Show(command) => command.run(),
            Command::Score(command) => command.run(),
            Command::Diff(command) => command.run(),
            Command::Export(command) => command.run(),
            Command::Video(command) => command.run(),
        }
    }
}

/// The file of an episode: a path, or a name `SESSION-NUMBER` in the directory of episodes.
fn file_of(episode: &Path, episodes: &Episodes) -> anyhow::Result<PathBuf> {
    let is_name = episode.extension().is_none() && episode.components().count() == 1;
    if !is_name || episode.is_file() {
        return Ok(episode.to_owned());
    }
    let name = episode.to_string_lossy();
    Ok(episodes.dir()?.join(format!("{name}.jsonl")))
}

/// Reads an episode.
fn read(episode: &Path, episodes: &Episodes) -> anyhow::Result<EpisodeFile> {
    let path = file_of(episode, episodes)?;
    EpisodeFile::read(&path).with_context(
        || "give the path of an episode's file, or its name as `wildcity episode list` prints it",
    )
}
