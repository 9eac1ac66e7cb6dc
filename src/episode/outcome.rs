//! The result of an episode: verdict and scores.

use wildcity_score::own::{self, Judgement};
use wildcity_score::score;

use crate::drive::drive_record;
use crate::file::EpisodeFile;
use crate::lines::{EpisodeResult, FaultLine, ScoreLine};

/// Judges an episode and scores it. `None` if the record has no frame, or not every step
/// ([`drive_record`]).
///
/// The same function serves the end of a session and `wildcity episode score`: it needs only a
/// record.
pub fn result(episode: &EpisodeFile) -> Option<EpisodeResult> {
    let record = drive_record(episode)?;
    let verdict = own::verdict(&record);
    let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
    // Names instead of indices: a result is read without the scenario.
    let fault = |fault: &own::FaultAt| FaultLine {
        fault: fault.fault.name().to_owned(),
        time_us: fault.time_us,
        actor: fault
            .actor
            .and_then(|actor| actors.get(usize::from(actor)))
            .map(|actor| actor.name.clone()),
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
        faults: verdict.faults.iter().map(fault).collect(),
        not_judged: verdict.not_judged.iter().map(own::NotJudged::to_string).collect(),
        scores: score(&record).into_iter().map(line).collect(),
    })
}
