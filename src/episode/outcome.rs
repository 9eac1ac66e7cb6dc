//! The result of an episode: verdict and scores.

use wildcity_score::own::{self, Judgement};
use wildcity_score::score;

use crate::drive::drive_record;
use crate::file::EpisodeFile;
use crate::lines::{EpisodeResult, Event, FaultLine, ScoreLine};

/// Judges an episode and scores it. `None` if the record has no frame, or not every step
/// ([`drive_record`]).
///
/// The same function serves the end of a session and `wildcity episode score`: it needs only a
/// record.
pub fn result(episode: &EpisodeFile) -> Option<EpisodeResult> {
    let record = drive_record(episode)?;
    let verdict = own::verdict(&record);
    let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
    // What was met in a contact with the twin, by its time.
    let met = |time_us: i64| {
        episode.events.iter().find_map(|line| match line.event {
            Event::StaticContact { area_m2, impact_mps } if line.time_us == time_us => {
                Some((area_m2, impact_mps))
            }
            _ => None,
        })
    };
    let fault_line = |found: &own::FaultAt| {
        let is_static = found.fault == own::Fault::Static;
        let met = is_static.then(|| met(found.time_us)).flatten();
        let actor = found.actor.and_then(|actor| actors.get(usize::from(actor)));
        FaultLine {
            fault: found.fault.name().to_owned(),
            time_us: found.time_us,
            actor: actor.map(|actor| actor.name.clone()),
            area_m2: met.map(|(area_m2, _)| area_m2),
            impact_mps: met.map(|(_, impact_mps)| impact_mps),
        }
    };
    let line = |score: wildcity_score::Score| {
        let parts = score.parts.into_iter().map(|(name, part)| (name.to_owned(), part)).collect();
        (score.name.to_owned(), ScoreLine { value: score.value, reason: score.reason, parts })
    };
    let judgement = match verdict.judgement {
        Judgement::Passed => "passed",
        Judgement::Failed => "failed",
        Judgement::OffModel => "off_model",
        Judgement::NotJudged => "not_judged",
    };
    Some(EpisodeResult {
        verdict: judgement.to_owned(),
        faults: verdict.faults.iter().map(fault_line).collect(),
        not_judged: verdict.not_judged.iter().map(own::NotJudged::to_string).collect(),
        scores: score(&record).into_iter().map(line).collect(),
    })
}
