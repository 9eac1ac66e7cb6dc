//! Replay: drives and renders a recorded episode again, and compares every pose and image.

use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::limits::{EPISODE_HEAD_BYTES, EPISODE_LINE_BYTES};
use wildcity_render::{Backend, Frame as RenderFrame, RenderError, Target};
use wildcity_scene::RenderProfile;
use wildcity_scene::appearance::Overlay;
use wildcity_scene::rig::{RigCamera, RigError};
use wildcity_sim::Ground;
use wildcity_twin::residency::{ResidencyError, Resident};

use super::ego_replay::{DivergedStep, EgoReplay};
use super::format::{
    BUILD, EpisodeHeader, FrameRecord, FrameRequest, Line, RecordedVersion, profile_hash,
};
use crate::episode::EpisodeSummary;
use crate::error::SessionError;
use crate::observe::builder::viewpoints;

// In base64 and with a thousandth for what PNG adds; a rig and a profile are below 1 MiB.
const _: () =
    assert!(4 * Overlay::MAX_PIXELS * 4 / 3 * 1001 / 1000 + (1 << 20) <= EPISODE_HEAD_BYTES as u64);

/// A recorded episode.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedEpisode {
    /// What it was rendered from, and how.
    pub header: EpisodeHeader,
    /// Everything rendered, in order; the first stands in line 2 of the file.
    pub frames: Vec<FrameRecord>,
    /// Versions that the session switched to, and how many frames were rendered before.
    pub versions: Vec<(usize, RecordedVersion)>,
    /// How it went; absent if the server was killed or is still running.
    pub end: Option<EpisodeSummary>,
}

/// How a replay went.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayReport {
    /// Images rendered again.
    pub images: u64,
    /// What is not as it was when the episode was recorded.
    pub changes: Vec<ProvenanceChange>,
    /// The first step whose command does not lead where it did.
    pub diverged: Option<DivergedStep>,
    /// The first image that differs.
    pub difference: Option<ImageDifference>,
}

/// How far to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReplayUntil {
    /// To the end, whatever differs.
    End,
    /// To the first image that differs, or the first step that strays.
    FirstDifference,
}

/// Something that is not as it was.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProvenanceChange {
    /// `build`, `backend`, `backend detail`, `version hash` or `profile hash`.
    pub what: &'static str,
    /// As recorded.
    pub recorded: String,
    /// As it is now.
    pub now: String,
}

/// An image that differs from the recorded one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageDifference {
    /// Line of the episode's file, from 1.
    pub line: usize,
    /// What was asked.
    pub request: FrameRequest,
    /// The step.
    pub step: u64,
    /// Which of the request's poses: 0 but for `observe`.
    pub pose: usize,
    /// Name of the camera.
    pub camera: String,
    /// The recorded hash.
    pub recorded: String,
    /// The hash now.
    pub now: String,
}

/// An image that was rendered again.
#[derive(Clone, Copy, Debug)]
pub struct ReplayedImage<'a> {
    /// The answer that it belongs to, counted from 0.
    pub frame: usize,
    /// What was asked.
    pub request: FrameRequest,
    /// The step.
    pub step: u64,
    /// Which of the request's poses.
    pub pose: usize,
    /// The camera.
    pub camera: &'a RigCamera,
    /// `[height, width, 3]`.
    pub rgb8: &'a [u8],
}

/// Why an episode could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        cause: io::Error,
    },
    /// A line is damaged, cut off, or not where it belongs.
    #[error("{}, line {line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// The recorded cameras cannot be used.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The twin cannot be had.
    #[error(transparent)]
    Twin(#[from] ResidencyError),
    /// What a frame needs cannot be had.
    #[error("step {step}: {cause}")]
    Residency {
        /// The step.
        step: u64,
        /// Why.
        cause: ResidencyError,
    },
    /// What is on record is no command for the episode's ego.
    #[error("step {step}: {cause}")]
    Ego {
        /// The step.
        step: u64,
        /// Why.
        cause: Box<SessionError>,
    },
    /// The backend refused a frame.
    #[error("step {step}: {cause}")]
    Render {
        /// The step.
        step: u64,
        /// Why.
        cause: RenderError,
    },
    /// What was to be done with an image failed.
    #[error("step {step}, camera {camera:?}: {reason:#}")]
    Visit {
        /// The step.
        step: u64,
        /// The camera.
        camera: String,
        /// Why.
        reason: String,
    },
}

impl RecordedEpisode {
    /// Reads an episode's file.
    ///
    /// # Errors
    /// Names the first line that is damaged or cut off.
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        let failed = |cause| ReplayError::Read { path: path.to_owned(), cause };
        let mut reader = BufReader::new(File::open(path).map_err(failed)?);
        let (mut header, mut frames, mut end) = (None, Vec::new(), None);
        let mut versions = Vec::new();
        for line in 1.. {
            let wrong = |reason: String| ReplayError::Line { path: path.to_owned(), line, reason };
            let mut text = Vec::new();
            let limit = if line == 1 { EPISODE_HEAD_BYTES } else { EPISODE_LINE_BYTES };
            reader.by_ref().take(limit as u64).read_until(b'\n', &mut text).map_err(failed)?;
            match text.last() {
                None => break,
                Some(b'\n') => {}
                Some(_) if text.len() == limit => {
                    return Err(wrong(format!("longer than {limit} bytes")));
                }
                Some(_) => return Err(wrong("cut off: it has no end".to_owned())),
            }
            let parsed: Line = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
            match parsed {
                _ if end.is_some() => return Err(wrong("follows the episode's end".to_owned())),
                Line::Episode(first) if line == 1 => {
                    let format = first.format;
                    if format != EpisodeHeader::FORMAT {
                        let reads = EpisodeHeader::FORMAT;
                        return Err(wrong(format!("format {format}; this build reads {reads}")));
                    }
                    first.rig.check()?;
                    header = Some(*first);
                }
                Line::Frame(frame) if line > 1 => {
                    let cameras = header.as_ref().map_or(0, |header| header.rig.cameras.len());
                    check_images(&frame, cameras).map_err(wrong)?;
                    frames.push(frame);
                }
                Line::Version(version) if line > 1 => versions.push((frames.len(), version)),
                Line::End(summary) if line > 1 => end = Some(summary),
                Line::Episode(_) => return Err(wrong("a second beginning".to_owned())),
                Line::Frame(_) | Line::Version(_) | Line::End(_) => {
                    return Err(wrong("the episode's beginning is missing".to_owned()));
                }
            }
        }
        let empty =
            || ReplayError::Line { path: path.to_owned(), line: 1, reason: "empty".to_owned() };
        Ok(Self { header: header.ok_or_else(empty)?, frames, versions, end })
    }

    /// Drives and renders the episode again, on the versions of its twin that `open` gives. Each image is
    /// shown to `visit` before it is compared.
    ///
    /// # Errors
    /// A version cannot be had, a command is none, the backend refuses a frame, or `visit` fails.
    pub fn replay(
        &self,
        open: &mut dyn FnMut(u64) -> Result<Arc<Resident>, ResidencyError>,
        backend: &dyn Backend,
        extent: ReplayUntil,
        visit: &mut dyn FnMut(&ReplayedImage<'_>) -> Result<(), String>,
    ) -> Result<ReplayReport, ReplayError> {
        let mut resident = open(self.header.version)?;
        let mut profile = &self.header.profile;
        let changes = self.changes(&resident, backend);
        let mut report = ReplayReport { images: 0, changes, diverged: None, difference: None };
        let mut retrace = EgoReplay::new(&self.header);
        let mut switches = self.versions.iter().peekable();
        let mut lines_before = 2;
        let all = &self.header.rig.cameras;
        let mut pixels: Vec<Vec<u8>> =
            all.iter().map(|camera| vec![0; 3 * camera.camera.pixels()]).collect();
        for (index, frame) in self.frames.iter().enumerate() {
            while let Some((_, to)) = switches.next_if(|(before, _)| *before <= index) {
                resident = open(to.version)?;
                lines_before += 1;
                profile = &to.profile;
                let recorded = (&*to.version_hash, &*to.profile_hash);
                report.changes.extend(scene_changes(recorded, &resident, profile));
            }
            let ground = Ground::from_drives(&resident.version.manifest.trajectories);
            let diverged = retrace
                .follow(frame, index + lines_before, &ground)
                .map_err(|cause| ReplayError::Ego { step: frame.step, cause: Box::new(cause) })?;
            if report.diverged.is_none() && diverged.is_some() {
                report.diverged = diverged;
                if extent == ReplayUntil::FirstDifference {
                    return Ok(report);
                }
            }
            let mut recorded = frame.images.iter();
            for (pose, world_from_rig) in frame.poses.iter().enumerate() {
                let cameras = frame.cameras_of(pose, all.len());
                if cameras.is_empty() {
                    continue;
                }
                let step = frame.step;
                // What is drawn before the last pose of a step is of a warm-up.
                let moves = frame.request == FrameRequest::Observe || pose + 1 == frame.poses.len();
                let views = retrace.episode().views((all, &cameras), *world_from_rig, moves);
                let scene = resident.scene(&viewpoints(&views), profile);
                let scene = scene.map_err(|cause| ReplayError::Residency { step, cause })?;
                let to_draw = RenderFrame { scene: &scene, profile, views: &views };
                redraw(backend, &to_draw, (all, &cameras), &mut pixels)
                    .map_err(|cause| ReplayError::Render { step, cause })?;
                for (&camera, recorded) in cameras.iter().zip(&mut recorded) {
                    let (camera, rgb8) = (&all[camera], &*pixels[camera]);
                    let FrameRecord { request, step, .. } = *frame;
                    visit(&ReplayedImage { frame: index, request, step, pose, camera, rgb8 })
                        .map_err(|reason| {
                            let camera = camera.name.clone();
                            ReplayError::Visit { step, camera, reason }
                        })?;
                    report.images += 1;
                    let now = blake3::hash(rgb8).to_hex().to_string();
                    if now != *recorded && report.difference.is_none() {
                        report.difference = Some(ImageDifference {
                            line: index + lines_before,
                            request,
                            step,
                            pose,
                            camera: camera.name.clone(),
                            recorded: recorded.clone(),
                            now,
                        });
                        if extent == ReplayUntil::FirstDifference {
                            return Ok(report);
                        }
                    }
                }
            }
        }
        Ok(report)
    }

    fn changes(&self, resident: &Resident, backend: &dyn Backend) -> Vec<ProvenanceChange> {
        let header = &self.header;
        let of_build = [
            ("build", &*header.build, BUILD),
            ("backend", &*header.backend, backend.name()),
            ("backend detail", &*header.backend_detail, &*backend.detail()),
        ];
        let mut changes = differing(of_build);
        let recorded = (&*header.version_hash, &*header.profile_hash);
        changes.extend(scene_changes(recorded, resident, &header.profile));
        changes
    }
}

/// What is not as it was of a version, whose manifest and profile had these hashes: the same profile has
/// another hash in a build that knows more fields.
fn scene_changes(
    (version, profile_then): (&str, &str),
    resident: &Resident,
    profile: &RenderProfile,
) -> Vec<ProvenanceChange> {
    let now = profile_hash(profile).to_hex();
    differing([
        ("version hash", version, &*resident.version.hash),
        ("profile hash", profile_then, now.as_str()),
    ])
}

fn differing<const N: usize>(compared: [(&'static str, &str, &str); N]) -> Vec<ProvenanceChange> {
    compared
        .into_iter()
        .filter(|(_, recorded, now)| recorded != now)
        .map(|(what, recorded, now)| ProvenanceChange {
            what,
            recorded: recorded.to_owned(),
            now: now.to_owned(),
        })
        .collect()
}

impl std::fmt::Display for ImageDifference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { line, step, pose, camera, recorded, now, request } = self;
        write!(f, "step {step}, camera {camera:?}")?;
        if *request == FrameRequest::Observe {
            write!(f, ", pose {pose} of observe")?;
        }
        write!(f, " (line {line}): recorded {recorded}, now {now}")
    }
}

/// Renders the colour images of some cameras, in rising order, of one pose into their places.
fn redraw(
    backend: &dyn Backend,
    frame: &RenderFrame<'_>,
    (all, cameras): (&[RigCamera], &[usize]),
    pixels: &mut [Vec<u8>],
) -> Result<(), RenderError> {
    let wanted = pixels.iter_mut().zip(all).enumerate();
    let wanted = wanted.filter(|(camera, _)| cameras.contains(camera));
    let mut targets: Vec<Target<'_>> = wanted
        .map(|(_, (rgb8, camera))| Target {
            rgb8: Some(rgb8),
            appearance: Some(&camera.appearance),
            ..Target::default()
        })
        .collect();
    backend.render(frame, &mut targets, &|_, _| {})?;
    Ok(())
}

/// What keeps a frame from being rendered again, if anything does.
fn check_images(frame: &FrameRecord, cameras: usize) -> Result<(), String> {
    let (poses, images) = (frame.poses.len(), frame.images.len());
    if !frame.cameras.is_empty() && frame.cameras.len() != poses {
        return Err(format!("cameras of {} poses, of {poses}", frame.cameras.len()));
    }
    for of_pose in &frame.cameras {
        if !of_pose.is_sorted_by(|a, b| a < b) || of_pose.last().is_some_and(|&c| c >= cameras) {
            return Err(format!("cameras {of_pose:?}; the rig has {cameras}, each once, in order"));
        }
    }
    let wanted: usize = (0..poses).map(|pose| frame.cameras_of(pose, cameras).len()).sum();
    if images != wanted {
        return Err(format!("{images} images of {poses} poses, {wanted} cameras in all"));
    }
    Ok(())
}

impl FrameRecord {
    /// The cameras of a pose, of a rig of so many.
    fn cameras_of(&self, pose: usize, all: usize) -> Vec<usize> {
        self.cameras.get(pose).cloned().unwrap_or_else(|| (0..all).collect())
    }
}
