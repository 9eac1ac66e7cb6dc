//! All scores of an episode.

use super::record::DriveRecord;
use super::scored::Score;
use super::{alpasim, bench2drive, hugsim, navsim, neuroncap, own};

/// All scores of an episode, in a fixed order.
pub fn score(record: &DriveRecord) -> Vec<Score> {
    let mut scores = vec![own::verdict(record).score()];
    scores.extend(alpasim::scores(record));
    scores.push(navsim::pdm(record));
    scores.push(hugsim::hd(record));
    scores.push(neuroncap::ncap(record));
    scores.extend(bench2drive::scores(record));
    scores
}
