//! The record of an episode: one JSON line per thing that happened.
//!
//! ```text
//! <episodes>/<session>-<n>.jsonl
//! {"kind":"episode", ...}    what it takes to render the same again
//! {"kind":"frame", ...}      one per answer with images: request, poses, hashes
//! {"kind":"version", ...}  what follows was rendered from another version of the twin
//! {"kind":"end", ...}        how it went; missing if the server was killed
//! ```
//!
//! A line is written before its answer is sent: what an agent was answered is on record. If that
//! fails, on a full disk say, the file is cut back to its last whole line and the request is
//! refused.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use wildcity_scene::geometry::Pose;
use wildcity_scene::{RenderProfile, Rig};
use wildcity_sim::ego::{Action, TimedPose};
use wildcity_sim::{Command, Dynamics};

use crate::episode::EpisodeSummary;
use crate::observe::encode::Encoding;

/// What built this program, as it stands in records.
pub(crate) const BUILD: &str = concat!("wildcity ", env!("CARGO_PKG_VERSION"));

/// The first line: everything that the images are a function of, but the poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeHeader {
    /// Version of this layout.
    pub format: u32,
    /// What recorded it, as `wildcity 0.1.0`.
    pub build: String,
    /// Name of the session.
    pub session: String,
    /// The twin.
    pub twin: String,
    /// Its version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// How it was rendered.
    pub profile: RenderProfile,
    /// BLAKE3 of the profile's JSON, in hex.
    pub profile_hash: String,
    /// Name of the backend.
    pub backend: String,
    /// What else pixels depend on: the instruction set.
    #[serde(default)]
    pub backend_detail: String,
    /// The cameras that were rendered, in the order of the images.
    pub rig: Rig,
    /// What the observations held beside colour, and how colour travelled.
    pub outputs: RecordedOutputs,
    /// Seed of the episode.
    pub seed: u64,
    /// How the ego moved.
    #[serde(default)]
    pub dynamics: Dynamics,
    /// `world_from_rig` at time zero.
    pub start: Pose,
    /// Simulated time of a step, in microseconds.
    pub dt_us: i64,
}

/// What the agent saw.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedOutputs {
    /// How colour travelled.
    pub encoding: Encoding,
    /// Whether there was depth.
    pub depth: bool,
    /// Whether there was opacity.
    pub opacity: bool,
    /// Whether there were normals.
    #[serde(default)]
    pub normals: bool,
}

/// One answer with images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameRecord {
    /// What was asked.
    pub request: FrameRequest,
    /// Steps done, this one included.
    pub step: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// What was rendered, `world_from_rig`; the last of a reset or a step is where the ego is.
    pub poses: Vec<Pose>,
    /// Which cameras of each pose, by their index; absent if all were.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<Vec<usize>>,
    /// What moved the ego there, if the pose itself does not say so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<RecordedCommand>,
    /// Whether the episode ended with it.
    pub terminated: bool,
    /// BLAKE3 of the images' hashes, in hex.
    pub frame_hash: String,
    /// BLAKE3 of each image's pixels, in hex: pose by pose, camera by camera.
    pub images: Vec<String>,
}

/// What an ego was told but for a pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordedCommand {
    /// To accelerate and turn.
    Action(Action),
    /// To follow poses.
    Trajectory(Vec<TimedPose>),
}

/// Another version of the twin, from here on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedVersion {
    /// Steps done before it.
    pub step: u64,
    /// The version.
    pub version: u64,
    /// BLAKE3 of its manifest, in hex.
    pub version_hash: String,
    /// How it is rendered.
    pub profile: RenderProfile,
    /// BLAKE3 of the profile's JSON, in hex.
    pub profile_hash: String,
}

/// Requests that are answered with images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameRequest {
    /// The start of an episode.
    Reset,
    /// A step.
    Step,
    /// Poses without moving.
    Observe,
}

/// A line of an episode's file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub(crate) enum Line {
    /// The first.
    Episode(Box<EpisodeHeader>),
    /// One per answer with images.
    Frame(FrameRecord),
    /// Between two frames.
    Version(RecordedVersion),
    /// The last.
    End(EpisodeSummary),
}

/// Why an episode could not be recorded.
#[derive(Debug, thiserror::Error)]
#[error("cannot record the episode in {}: {cause}", path.display())]
pub struct RecordError {
    /// The file or directory.
    pub path: PathBuf,
    /// What the operating system says.
    pub cause: io::Error,
}

/// An episode's file, open for appending.
#[derive(Clone, Debug)]
pub(crate) struct Recorder {
    file: Arc<File>,
    path: Arc<Path>,
}

impl RecordedCommand {
    /// What of a command goes on record.
    pub(crate) fn of(command: &Command) -> Option<Self> {
        match command {
            Command::Pose(_) => None,
            Command::Path(path) => Some(Self::Trajectory(path.poses().to_vec())),
            Command::Action(action) => Some(Self::Action(*action)),
        }
    }
}

impl EpisodeHeader {
    /// The layout that this build writes and reads.
    pub const FORMAT: u32 = 0;
}

impl Recorder {
    /// Creates the file of the first free number from `first_number` on and writes its first
    /// lines; tells the number. No file is left behind if that fails.
    pub(crate) fn create(
        dir: &Path,
        session: &str,
        first_number: u64,
        lines: &[Line],
    ) -> Result<(Self, u64), RecordError> {
        let failed = |path: &Path, cause| RecordError { path: path.to_owned(), cause };
        fs::create_dir_all(dir).map_err(|cause| failed(dir, cause))?;
        let mut number = first_number;
        loop {
            let path = dir.join(format!("{session}-{number}.jsonl"));
            match OpenOptions::new().append(true).create_new(true).open(&path) {
                Ok(file) => {
                    let recorder = Self { file: Arc::new(file), path: path.into() };
                    return match recorder.append(lines) {
                        Ok(()) => Ok((recorder, number)),
                        Err(error) => {
                            // The first failure says more than one to clean up after it.
                            let _ = fs::remove_file(&recorder.path);
                            Err(error)
                        }
                    };
                }
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
                Err(cause) => return Err(failed(&path, cause)),
            }
        }
    }

    /// Appends whole lines, or nothing.
    pub(crate) fn append(&self, lines: &[Line]) -> Result<(), RecordError> {
        let mut text = Vec::with_capacity(2048);
        let written = lines
            .iter()
            .try_for_each(|line| {
                serde_json::to_writer(&mut text, line)?;
                text.push(b'\n');
                Ok(())
            })
            .and_then(|()| self.file.metadata())
            .and_then(|before| {
                let written = (&*self.file).write_all(&text);
                if written.is_err() {
                    self.file.set_len(before.len())?;
                }
                written
            });
        written.map_err(|cause| RecordError { path: self.path.to_path_buf(), cause })
    }
}

/// BLAKE3 of a profile's JSON.
pub(crate) fn profile_hash(profile: &RenderProfile) -> blake3::Hash {
    // Writing seven numbers to memory cannot fail, and an empty text would only change the hash.
    blake3::hash(&serde_json::to_vec(profile).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Outcome;

    fn end(steps: u64) -> Line {
        let (outcome, least_trust) = (Outcome::Completed, None);
        Line::End(EpisodeSummary { outcome, steps, time_us: 0, distance_m: 0.0, least_trust })
    }

    #[test]
    fn names_in_use_are_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let (first, number) = Recorder::create(dir.path(), "a", 1, &[end(1)]).unwrap();
        assert_eq!(number, 1);
        let (_, number) = Recorder::create(dir.path(), "a", 1, &[end(2)]).unwrap();
        assert_eq!(number, 2);
        first.append(&[end(3)]).unwrap();
        let text = fs::read_to_string(dir.path().join("a-1.jsonl")).unwrap();
        assert_eq!(text.lines().count(), 2);
        assert!(text.ends_with('\n'));
    }

    #[test]
    fn a_directory_that_cannot_be_made_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let dir = file.path().join("episodes");
        let error = Recorder::create(&dir, "a", 1, &[end(1)]).unwrap_err();
        assert!(error.to_string().contains("episodes"), "{error}");
    }

    #[test]
    fn a_full_disk_refuses_the_line() {
        let full = OpenOptions::new().append(true).open("/dev/full").unwrap();
        let path = Path::new("/dev/full").into();
        let recorder = Recorder { file: Arc::new(full), path };
        let error = recorder.append(&[end(1)]).unwrap_err();
        assert!(error.to_string().contains("/dev/full"), "{error}");
    }
}
