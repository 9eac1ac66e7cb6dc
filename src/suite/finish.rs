//! Judges the record of a driven episode.

use std::path::{Path, PathBuf};

use serde::Deserialize as _;
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as ValueError;

use wildcity_episode::{EndLine, EpisodeFile, EpisodeResult, result};
use wildcity_session::{Outcome, run_blocking};
use wildcity_sim::Dynamics;

use crate::case::Case;
use crate::technical::Technical;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Finished {
    /// Its file's name without the directory.
    pub(crate) record: String,
    /// The end that the session wrote.
    pub(crate) end: EndLine,
    pub(crate) result: EpisodeResult,
    /// [`EpisodeFile::untested`].
    pub(crate) untested: Vec<String>,
    /// BLAKE3 of all frame hashes, in hex: equal for equal drives.
    pub(crate) frames_hash: String,
    /// BLAKE3 of poses, actors and images, in hex.
    pub(crate) drive_hash: String,
}

/// Judges an episode from its record.
pub(crate) async fn finish(case: &Case, record: PathBuf) -> Result<Finished, Technical> {
    let case = case.clone();
    let finished = run_blocking(move || finish_file(&case, &record)).await;
    finished.unwrap_or_else(|error| Err(Technical::server(error.to_string())))
}

fn finish_file(case: &Case, record: &Path) -> Result<Finished, Technical> {
    let episode =
        EpisodeFile::read(record).map_err(|error| Technical::server(error.to_string()))?;
    // What was driven must be what was ordered, before anything is judged.
    check(case, &episode)?;
    let end =
        episode.end.clone().ok_or_else(|| Technical::new("agent_lost", "the record has no end"))?;
    // By its name in the record: a newer server may write an outcome that this build does not know.
    let known = Outcome::deserialize(end.outcome.as_str().into_deserializer());
    let outcome = known.map_err(|_: ValueError| {
        let outcome = &end.outcome;
        Technical::server(format!(
            "the session ended as {outcome}, which this program does not know"
        ))
    })?;
    // An episode that ended by the rules has a verdict. The others say nothing about driving.
    let kind = match outcome {
        Outcome::Completed | Outcome::OffModel | Outcome::DrivingFailure => None,
        Outcome::AgentError => Some("agent_error"),
        Outcome::AgentTimeout => Some("agent_timeout"),
        Outcome::AgentLost => Some("agent_lost"),
        Outcome::ServerError => Some("server_error"),
    };
    if let Some(kind) = kind {
        return Err(Technical::new(kind, format!("the session ended as {}", end.outcome)));
    }
    let judged = result(&episode).ok_or_else(|| {
        let message =
            "a verdict needs every step: nothing was driven, or several steps with one request";
        Technical::new("agent_error", message)
    })?;
    let mut frames = blake3::Hasher::new();
    for frame in &episode.frames {
        frames.update(frame.frame_hash.as_bytes());
    }
    let name = record.file_name().map(|name| name.to_string_lossy().into_owned());
    Ok(Finished {
        record: name.unwrap_or_default(),
        end,
        result: judged,
        untested: episode.untested(),
        frames_hash: frames.finalize().to_hex().to_string(),
        drive_hash: drive_hash(&episode),
    })
}

/// What was driven: where the ego and the actors were, and what was seen. Images alone would not
/// do: an actor may be out of sight, and an agent may ask for no camera.
fn drive_hash(episode: &EpisodeFile) -> String {
    let mut hasher = blake3::Hasher::new();
    // Numbers and texts: writing them into memory cannot fail.
    let mut add = |line: serde_json::Result<Vec<u8>>| {
        hasher.update(&line.unwrap_or_default());
    };
    for frame in episode.driven() {
        add(serde_json::to_vec(&(frame.time_us, &frame.poses, &frame.frame_hash)));
    }
    for line in &episode.actors {
        add(serde_json::to_vec(line));
    }
    hasher.finalize().to_hex().to_string()
}

/// An agent must drive what was ordered.
fn check(case: &Case, episode: &EpisodeFile) -> Result<(), Technical> {
    let header = &episode.header;
    let scenario = episode.scenario.as_ref().map(|scenario| scenario.hash.as_str());
    let off_m = header.start.position_m.distance(case.start.position_m);
    let driven = header.dynamics;
    let ordered = case.resolved.dynamics.unwrap_or_default();
    // Only the speed is a measured number.
    let is_other_model = Dynamics { speed_m_s: ordered.speed_m_s, ..driven } != ordered;
    let off_m_s = (driven.speed_m_s - ordered.speed_m_s).abs();
    let wrong = [
        ("twin", header.twin != case.options.twin),
        ("version", header.version_hash != case.version_hash),
        ("seed", header.seed != case.seed),
        ("scenario", scenario != Some(&case.line.hash)),
        ("dynamics", is_other_model),
        ("dynamics.speed", off_m_s > SPEED_M_S),
        ("dt_us", Some(header.dt_us) != case.options.dt_us),
        ("start", off_m > START_M),
    ];
    match wrong.into_iter().find(|(_, wrong)| *wrong) {
        None => Ok(()),
        Some((field, _)) => Err(Technical::new(
            "agent_error",
            format!("the agent opened with another {field} than WILDCITY_OPEN says"),
        )),
    }
}

/// Difference between the ordered and the driven speed at the start that counts as the same speed,
/// in m/s: an agent may have written the number with two decimals.
const SPEED_M_S: f64 = 0.01;

/// Distance between the ordered and the driven start that counts as the same place, in metres.
const START_M: f64 = 1.0;
