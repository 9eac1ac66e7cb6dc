//! Pictures of both runs of a comparison, at the same time of each episode.

use wildcity_render::Backend;
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::entry::EpisodeEntry;
use crate::picture::{ComparedPictures, fault_us, picture};

use super::ComparedEpisode;
use super::page::DrivenRun;

/// Pictures of these pairs, before and now at the same time: that of the worst fault now, or else
/// of the worst one before, or else the end.
pub(super) fn compared_pictures(
    shown: &[&ComparedEpisode],
    runs: &[DrivenRun<'_>; 2],
    catalog: &Catalog,
    backend: &dyn Backend,
) -> ComparedPictures {
    let cache = Cache::new(catalog.clone());
    let of_pair = |of: &&ComparedEpisode| {
        let entries = runs.each_ref().map(|run| run.entry(of));
        let faults_us = entries.iter().rev().flatten().map(|entry| fault_us(entry));
        let time_us = faults_us.into_iter().find(|&us| us < i64::MAX).unwrap_or(i64::MAX);
        let [before, now] = entries.map(|entry| entry.ok_or("it was not driven".to_owned()));
        let draw = |entry: Result<&EpisodeEntry, String>, run: &DrivenRun<'_>| {
            picture(entry?, time_us, &run.episodes, &cache, backend)
        };
        (of.picture_key(), [draw(before, &runs[0]), draw(now, &runs[1])])
    };
    shown.iter().map(of_pair).collect()
}
