//! Renders the episodes of a run again.

use std::path::Path;

use wildcity_render::Backend;
use wildcity_session::{RecordedEpisode, ReplayUntil};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::result::SuiteResult;

/// Replays every recorded episode of a run. Returns what differs, one line for each episode that
/// does.
pub fn verify(
    result: &SuiteResult,
    episodes: &Path,
    catalog: &Catalog,
    backend: &dyn Backend,
) -> Vec<String> {
    let cache = Cache::new(catalog.clone());
    // An episode that was not driven has nothing to repeat.
    let recorded = result.episodes.iter().filter(|episode| !episode.record.is_empty());
    recorded
        .filter_map(|episode| {
            let wrong = differs(&episodes.join(&episode.record), &cache, backend)?;
            Some(format!("{}: {wrong}", episode.name))
        })
        .collect()
}

/// The differences in an episode.
fn differs(path: &Path, cache: &Cache, backend: &dyn Backend) -> Option<String> {
    let recording = match RecordedEpisode::read(path) {
        Ok(recording) => recording,
        Err(error) => return Some(error.to_string()),
    };
    // Up to the first difference: one is enough to say that the episode does not repeat.
    match recording.replay(cache, backend, ReplayUntil::FirstDifference, &mut |_| Ok(())) {
        Err(error) => Some(error.to_string()),
        Ok(report) => {
            let diverged = report.diverged.map(|diverged| diverged.to_string());
            let image = report.difference.map(|difference| difference.to_string());
            let value = report.wrong_value.map(|value| value.to_string());
            // Poses first, because images and values follow from them.
            diverged.or(image).or(value)
        }
    }
}
