//! All scores of an episode.

use super::record::DriveRecord;
use super::scored::Score;
use super::{alpasim, alpasim_plans, bench2drive, hugsim, navsim, neuroncap, own};

/// The least and the greatest value of a score; infinite without a bound, and for a name that is
/// not one of [`score`]'s.
pub fn score_range(name: &str) -> [f64; 2] {
    let [deviation, collision, ades @ ..] = alpasim_plans::NAMES;
    match name {
        own::NAME | alpasim::NAME | alpasim::OFF_ROAD | alpasim::WRONG_LANE | navsim::NAME => {
            [0.0, 1.0]
        }
        hugsim::NAME | bench2drive::SUCCESS | bench2drive::SMOOTHNESS => [0.0, 1.0],
        neuroncap::NAME => [0.0, neuroncap::FREE],
        bench2drive::DRIVING_SCORE => [0.0, 100.0],
        bench2drive::EFFICIENCY => [0.0, bench2drive::MOST_PERCENT],
        name if name == collision => [0.0, 1.0],
        name if name == deviation || ades.contains(&name) => [0.0, f64::INFINITY],
        _ => [f64::NEG_INFINITY, f64::INFINITY],
    }
}

/// Whether a lower value of a score is better; false for a name that is not one of [`score`]'s.
pub fn lower_is_better(name: &str) -> bool {
    // Deviation of plans, their collisions, and their distances from the recorded drive.
    let of_plans = alpasim_plans::NAMES;
    [alpasim::OFF_ROAD, alpasim::WRONG_LANE].contains(&name) || of_plans.contains(&name)
}

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
