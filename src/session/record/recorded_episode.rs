//! Reads an episode's file.

use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;

use wildcity_episode::limits::HEAD_BYTES;
use wildcity_episode::{ActorsLine, Event, ScenarioLine, check_no_mcap, line_bytes, open_record};
use wildcity_scene::appearance::Overlay;

use super::format::{EpisodeHeader, FrameRecord, Line, RecordedVersion};
use super::replay_report::ReplayError;
use crate::episode::EpisodeSummary;
use crate::limits::PLAN_STEPS;

// The first line has room for the largest overlays: 4 bytes a pixel, in base64 (4/3), and a
// thousandth that PNG may add. The rest of a rig and a profile are below 1 MiB.
const _: () =
    assert!(4 * Overlay::MAX_PIXELS * 4 / 3 * 1001 / 1000 + (1 << 20) <= HEAD_BYTES as u64);

/// The lines of an episode's file, grouped by their kinds.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedEpisode {
    /// Inputs and settings of its rendering.
    pub header: EpisodeHeader,
    /// All answers with images, in order; the first is line 2 of the file.
    pub frames: Vec<FrameRecord>,
    /// Versions that the session switched to, each with the number of frames before it.
    pub versions: Vec<(usize, RecordedVersion)>,
    /// The scenario, if there was one.
    pub scenario: Option<Box<ScenarioLine>>,
    /// The actors of the next frame, each with the number of frames before it.
    pub actors: Vec<(usize, ActorsLine)>,
    /// The steps that were done when the ego had left the area that the twin was trained on, if it
    /// left it.
    pub off_model_step: Option<u64>,
    /// Lines of the file, from 1, at which the frames are.
    pub frame_lines: Vec<usize>,
    /// Line of the file, from 1, at which the end is; 0 without one.
    pub end_line: usize,
    /// How it went; absent if the server was killed or is still running. A last line without an end
    /// is left out.
    pub end: Option<EpisodeSummary>,
}

impl RecordedEpisode {
    /// Reads an episode's file.
    ///
    /// # Errors
    /// Names the first line that is damaged, incomplete or out of place.
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        Self::read_part(path, None)
    }

    /// Reads what a branch after a step needs: the frames up to it, without the agent's notes and
    /// without actors. Later frames are not read, except that the first of them shows that the
    /// record has the step.
    ///
    /// # Errors
    /// Those of [`Self::read`], for what is read.
    pub(crate) fn read_until(path: &Path, step: u64) -> Result<Self, ReplayError> {
        Self::read_part(path, Some(step))
    }

    /// Leaves out the sweeps of LiDARs, for a replay of which only the images are wanted.
    pub fn leave_out_sweeps(&mut self) {
        self.header.rig.lidars.clear();
        if let Some(settings) = &mut self.header.settings
            && let Some(sensors) = &mut settings.sensors
        {
            sensors.lidars.clear();
        }
        self.frames.iter_mut().for_each(|frame| frame.sweeps.clear());
    }

    fn read_part(path: &Path, until: Option<u64>) -> Result<Self, ReplayError> {
        let failed = |cause| ReplayError::Read { path: path.to_owned(), cause };
        let mut reader = BufReader::new(open_record(path).map_err(failed)?);
        let mut header: Option<EpisodeHeader> = None;
        let mut frames = Vec::new();
        let mut versions = Vec::new();
        let mut scenario: Option<Box<ScenarioLine>> = None;
        let mut actors = Vec::new();
        let mut off_model_step = None;
        let mut frame_lines = Vec::new();
        let mut end_line = 0;
        let mut end = None;
        for number in 1.. {
            let wrong =
                |reason: String| ReplayError::Line { path: path.to_owned(), line: number, reason };

            // A line, no longer than its limit.
            let mut text = Vec::new();
            let limit = line_bytes(number);
            reader.by_ref().take(limit as u64).read_until(b'\n', &mut text).map_err(failed)?;
            match text.last() {
                None => break,
                Some(b'\n') => {}
                Some(_) if text.len() == limit => {
                    return Err(wrong(format!("longer than {limit} bytes")));
                }
                // The recorder was interrupted: the line is of an answer that was never sent.
                Some(_) if header.is_some() => break,
                Some(_) => return Err(wrong("incomplete: it has no line break".to_owned())),
            }
            if number == 1 {
                check_no_mcap(path, &text)?;
            }

            // The first line is the header, and nothing follows the end.
            let actor_count = scenario.as_ref().map_or(0, |scenario| scenario.actors.len());
            let line: Line = serde_json::from_slice(&text).map_err(|e| wrong(e.to_string()))?;
            match line {
                _ if end.is_some() => {
                    return Err(wrong("it follows the end of the episode".to_owned()));
                }
                Line::Episode(first) if number == 1 => {
                    let format = first.format;
                    if format != EpisodeHeader::FORMAT {
                        let known = EpisodeHeader::FORMAT;
                        return Err(wrong(format!("format {format}; this build reads {known}")));
                    }
                    // Checked here, so that a replay uses rig and state without further tests.
                    first.rig.check()?;
                    if let Some(state) = &first.state {
                        state.check().map_err(|reason| wrong(reason.to_owned()))?;
                    }
                    header = Some(*first);
                }
                Line::Frame(mut frame) if number > 1 => {
                    if let Some(step) = until {
                        frame.notes = None;
                        if frame.step > step {
                            frames.push(frame);
                            frame_lines.push(number);
                            break;
                        }
                    }
                    // There is a header: line 1 was one, or was refused.
                    let cameras = header.as_ref().map_or(0, |header| header.rig.cameras.len());
                    check_images(&frame, cameras).map_err(wrong)?;
                    frames.push(frame);
                    frame_lines.push(number);
                }
                Line::Scenario(line) if number > 1 => scenario = Some(line),
                Line::Actors(line) if number > 1 => {
                    line.check(actor_count).map_err(wrong)?;
                    if until.is_some() {
                        continue;
                    }
                    // With the number of frames so far, by which a replay finds the frame of the
                    // line.
                    actors.push((frames.len(), line));
                }
                Line::Event(event) if number > 1 => {
                    event.check(actor_count).map_err(wrong)?;
                    if let Event::OffModel { .. } = event.event {
                        // The first time counts; a record of a branch may have several.
                        off_model_step = off_model_step.or(Some(event.step));
                    }
                }
                Line::Result(_) if number > 1 => {}
                Line::Version(version) if number > 1 => versions.push((frames.len(), version)),
                Line::End(summary) if number > 1 => {
                    end = Some(summary);
                    end_line = number;
                }
                Line::Episode(_) => return Err(wrong("a second header".to_owned())),
                // Any other line as the first of the file.
                _ => {
                    return Err(wrong("the episode's header is missing".to_owned()));
                }
            }
        }
        // Without a single line, no line was wrong.
        let empty =
            || ReplayError::Line { path: path.to_owned(), line: 1, reason: "empty".to_owned() };
        let header = header.ok_or_else(empty)?;
        Ok(Self {
            header,
            frames,
            versions,
            scenario,
            actors,
            off_model_step,
            frame_lines,
            end_line,
            end,
        })
    }
}

/// Checks that the cameras and images of a frame match its poses. Returns what is wrong, if
/// anything.
fn check_images(frame: &FrameRecord, rig_cameras: usize) -> Result<(), String> {
    let poses = frame.poses.len();
    if !(1..=PLAN_STEPS as u64).contains(&frame.steps) {
        return Err(format!("a plan of {} steps; 1 to {PLAN_STEPS} are accepted", frame.steps));
    }
    if !frame.times_us.is_empty() && frame.times_us.len() != poses {
        return Err(format!("times of {} poses, but {poses} poses", frame.times_us.len()));
    }
    if !frame.due_us.is_empty() && frame.due_us.len() != poses {
        return Err(format!("due times of {} poses, but {poses} poses", frame.due_us.len()));
    }
    if !frame.cameras.is_empty() && frame.cameras.len() != poses {
        return Err(format!("cameras for {} poses, but {poses} poses", frame.cameras.len()));
    }
    for cameras in &frame.cameras {
        let rising = cameras.is_sorted_by(|a, b| a < b);
        // Rising, so that the last one is the largest.
        let exist = cameras.last().is_none_or(|&last| last < rig_cameras);
        if !rising || !exist {
            return Err(format!(
                "cameras {cameras:?}: not rising, or beyond the rig's {rig_cameras} cameras"
            ));
        }
    }
    // One image for each camera of each pose, in this order.
    let expected: usize = (0..poses).map(|pose| frame.due_cameras(pose, rig_cameras).len()).sum();
    let images = frame.images.len();
    if images != expected {
        return Err(format!("{images} images, but {expected} cameras of {poses} poses"));
    }
    let repairs = frame.repairs.len();
    if repairs != 0 && repairs != images {
        return Err(format!("repairs of {repairs} images, but {images} images"));
    }
    Ok(())
}
