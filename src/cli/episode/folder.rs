//! Where records are: a folder, or the folder `episodes` of a run.

use std::path::{Path, PathBuf};

use wildcity_episode::list;

use crate::cli::directories::Episodes;

use super::bad_input;

/// The folder of a run that has its records.
const EPISODES: &str = "episodes";

/// Largest number of runs that a message names.
const NAMED: usize = 5;

/// The folder with the records: that of `--episodes`; or if that is the folder of a run, the folder
/// `episodes` in it.
///
/// # Errors
/// There is no such folder, or it cannot be read; exit code 2.
pub(super) fn records(episodes: &Episodes) -> anyhow::Result<PathBuf> {
    let dir = episodes.dir()?;
    if !dir.is_dir() {
        return Err(bad_input(format!(
            "there is no folder {}: give the folder of the records with --episodes; `wildcity episode run` writes them to \
             OUT/episodes",
            dir.display()
        )));
    }
    let cannot_read = |error| bad_input(format!("cannot read {}: {error}", dir.display()));
    let of_run = dir.join(EPISODES);
    let is_run = list(&dir).map_err(cannot_read)?.is_empty() && of_run.is_dir();
    Ok(if is_run { of_run } else { dir })
}

/// The folders `episodes` of the runs in a folder, by name; at most [`NAMED`].
pub(super) fn runs_in(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let records = entries.map(|entry| entry.path().join(EPISODES));
    let mut found: Vec<PathBuf> = records.filter(|records| records.is_dir()).collect();
    found.sort();
    // Sorted before, so that the same ones are named each time.
    found.truncate(NAMED);
    found
}

/// The file of an episode: a path, or a name `SESSION-NUMBER` in the folder of records.
pub(super) fn record_file(episode: &Path, episodes: &Episodes) -> anyhow::Result<PathBuf> {
    // A name may have dots, such as that of a second attempt: `straight-0.2-1`.
    let is_file_name = episode.extension().is_some_and(|ext| ext == "jsonl" || ext == "mcap");
    let is_name = !is_file_name && episode.components().count() == 1;
    if !is_name || episode.is_file() {
        return Ok(episode.to_owned());
    }
    let name = episode.to_string_lossy();
    Ok(records(episodes)?.join(format!("{name}.jsonl")))
}
