//! The record of an episode, completed with its scenario and its result.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use serde::Serialize;

use wildcity_episode::{EndLine, EpisodeFile, EpisodeResult, result};

use crate::case::Case;
use crate::technical::Technical;

/// A driven episode.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Finished {
    /// Its file's name without the directory.
    pub(crate) record: String,
    /// The end that the session wrote.
    pub(crate) end: EndLine,
    /// Verdict and scores.
    pub(crate) result: EpisodeResult,
    /// BLAKE3 of all frame hashes, in hex: equal for equal drives.
    pub(crate) frames_hash: String,
}

/// Judges an episode from its record, and writes scenario and result into it.
pub(crate) async fn finish(case: &Case, record: PathBuf) -> Result<Finished, Technical> {
    let case = case.clone();
    let finished = tokio::task::spawn_blocking(move || finish_file(&case, &record));
    match finished.await {
        Ok(finished) => finished,
        Err(error) => Err(Technical::server(error.to_string())),
    }
}

fn finish_file(case: &Case, record: &Path) -> Result<Finished, Technical> {
    let mut episode =
        EpisodeFile::read(record).map_err(|error| Technical::server(error.to_string()))?;
    check(case, &episode)?;
    let is_written = episode.scenario.is_some();
    if !is_written {
        episode.scenario = Some((*case.line).clone());
    }
    let end = episode.end.clone().ok_or_else(|| Technical {
        kind: "agent_lost",
        message: "the record has no end".to_owned(),
    })?;
    let kind = match end.outcome.as_str() {
        "completed" | "off_model" | "driving_failure" => None,
        "agent_error" => Some("agent_error"),
        "agent_timeout" => Some("agent_timeout"),
        "agent_lost" => Some("agent_lost"),
        _ => Some("server_error"),
    };
    if let Some(kind) = kind {
        return Err(Technical { kind, message: format!("the session ended as {}", end.outcome) });
    }
    let judged = result(&episode).ok_or_else(|| Technical {
        kind: "agent_error",
        message: "nothing was driven".to_owned(),
    })?;
    if !is_written {
        write_lines(case, record, &judged).map_err(|error| {
            Technical::server(format!("cannot complete {}: {error}", record.display()))
        })?;
    }
    let mut frames = blake3::Hasher::new();
    for frame in &episode.frames {
        frames.update(frame.frame_hash.as_bytes());
    }
    let name = record.file_name().map(|name| name.to_string_lossy().into_owned());
    Ok(Finished {
        record: name.unwrap_or_default(),
        end,
        result: judged,
        frames_hash: frames.finalize().to_hex().to_string(),
    })
}

/// An agent must drive what was ordered.
fn check(case: &Case, episode: &EpisodeFile) -> Result<(), Technical> {
    let header = &episode.header;
    let options = &case.options;
    let dt_us = options.dt_us.unwrap_or(header.dt_us);
    let wrong = [
        ("twin", header.twin != options.twin),
        ("version", header.version_hash != case.version_hash),
        ("seed", header.seed != case.seed),
        ("dynamics", header.dynamics != options.dynamics),
        ("dt_us", header.dt_us != dt_us),
        (
            "start",
            case.start().is_some_and(|start_m| header.start.position_m.distance(start_m) > 1.0),
        ),
    ];
    match wrong.into_iter().find(|(_, wrong)| *wrong) {
        None => Ok(()),
        Some((field, _)) => Err(Technical {
            kind: "agent_error",
            message: format!("the agent opened with another {field} than WILDCITY_OPEN says"),
        }),
    }
}

impl Case {
    /// Where the episode starts, in metres, if that is known beforehand.
    fn start(&self) -> Option<glam::DVec3> {
        self.line.route.first().map(|point| glam::DVec3::from_array(point.1))
    }
}

/// Writes the scenario after the header and the result before the end. The file is replaced as a whole.
fn write_lines(case: &Case, record: &Path, judged: &EpisodeResult) -> std::io::Result<()> {
    let text = fs::read_to_string(record)?;
    let mut lines: Vec<&str> = text.lines().collect();
    let scenario = tagged("scenario", &*case.line)?;
    let result = tagged("result", judged)?;
    lines.insert(1.min(lines.len()), &scenario);
    lines.insert(lines.len().saturating_sub(1), &result);
    let temporary = record.with_extension("tmp");
    let mut file = fs::File::create(&temporary)?;
    for line in lines {
        file.write_all(line.as_bytes())?;
        file.write_all(b"\n")?;
    }
    drop(file);
    fs::rename(&temporary, record)
}

/// A line with its kind.
fn tagged(kind: &'static str, line: &impl Serialize) -> std::io::Result<String> {
    #[derive(Serialize)]
    struct Tagged<'a, T> {
        kind: &'static str,
        #[serde(flatten)]
        line: &'a T,
    }
    Ok(serde_json::to_string(&Tagged { kind, line })?)
}
