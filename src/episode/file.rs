//! Reads an episode's file.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_sim::Dynamics;
use wildcity_sim::ego::TimedPose;

use crate::limits;
use crate::lines::{ActorsLine, EpisodeResult, Event, EventLine, ScenarioLine};

/// Setup of an episode: the fields of its first line that need no renderer.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Header {
    /// Version of the format.
    pub format: u32,
    /// The build that recorded it.
    pub build: String,
    /// Name of the session.
    pub session: String,
    /// Name of the twin.
    pub twin: String,
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// Name of the backend.
    pub backend: String,
    pub rig: RigHead,
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

/// A rig by its names.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct RigHead {
    /// Name of the rig.
    pub name: String,
    /// Its cameras, in the order of the images.
    pub cameras: Vec<CameraHead>,
}

/// A camera by its name.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct CameraHead {
    pub name: String,
}

/// An answer with images.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Frame {
    /// `reset`, `step` or `observe`.
    pub request: String,
    /// Steps done, this one included.
    pub step: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// The rendered poses, `world_from_rig`; the last one of a reset or a step is the ego's.
    pub poses: Vec<Pose>,
    /// The command, unless it was the pose itself.
    #[serde(default)]
    pub command: Option<serde_json::Value>,
    /// Whether the agent ended the episode with this step.
    #[serde(default)]
    pub terminated: bool,
    /// BLAKE3 of the shown images' hashes, in hex.
    pub frame_hash: String,
    /// BLAKE3 of each rendered image, in hex.
    #[serde(default)]
    pub images: Vec<String>,
}

/// Summary of an episode by the session.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct EndLine {
    /// Why it ended: `completed`, `off_model`, `agent_error` ..
    pub outcome: String,
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Distance driven, in metres.
    pub distance_m: f64,
    /// The least mean trust of an observation.
    #[serde(default)]
    pub least_trust: Option<f64>,
}

/// Where a file stops being readable.
#[derive(Clone, Debug, PartialEq)]
pub struct Cut {
    /// The line, from 1.
    pub line: usize,
    pub reason: String,
}

/// A recorded episode, with every line of its file that can be read.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeFile {
    pub header: Header,
    /// The scenario, if there was one.
    pub scenario: Option<ScenarioLine>,
    /// All answers with images, in order.
    pub frames: Vec<Frame>,
    /// The actors, step by step.
    pub actors: Vec<ActorsLine>,
    /// Events in order, without events that a session undid when it returned to an earlier step.
    pub events: Vec<EventLine>,
    /// The result that the session wrote.
    pub result: Option<EpisodeResult>,
    /// How it went; absent if the server was killed, or still drives.
    pub end: Option<EndLine>,
    /// Where the file stops being readable, if it does.
    pub cut: Option<Cut>,
}

/// Why an episode's file could not be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {cause}", path.display())]
    Io {
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The first line is not a header.
    #[error("{}: the first line is no header of an episode: {reason}", path.display())]
    Header { path: PathBuf, reason: String },
    /// The file is the MCAP export of a record.
    #[error("{} is an MCAP export; only the record is read: {}", path.display(), path.with_extension("jsonl").display())]
    Mcap { path: PathBuf },
}

/// First bytes of every MCAP file; their line break ends the first line.
const MCAP_MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// A line's kind. It is read before the line, since a tagged enum copies every value of it first: a
/// third of the time.
#[derive(Deserialize)]
struct Kind<'a> {
    #[serde(borrow)]
    kind: Cow<'a, str>,
}

enum Line {
    Episode(Box<Header>),
    Scenario(Box<ScenarioLine>),
    Actors(ActorsLine),
    Event(EventLine),
    Frame(Frame),
    Result(EpisodeResult),
    End(EndLine),
    /// Versions, notes, and lines that later builds add.
    Other,
}

impl Frame {
    /// The agent's plan, if that was its command.
    pub fn plan(&self) -> Option<Vec<TimedPose>> {
        Vec::deserialize(self.command.as_ref()?.get("trajectory")?).ok()
    }
}

impl EpisodeFile {
    /// The triggers of an actor, as the scenario lists them.
    fn script(&self, actor: &str) -> Option<&Vec<serde_json::Value>> {
        let actors = self.scenario.as_ref()?.scenario.get("actors")?.as_array()?;
        let is_named =
            |entry: &&serde_json::Value| entry.get("name").is_some_and(|name| name == actor);
        actors.iter().find(is_named)?.get("script")?.as_array()
    }

    /// The name of a trigger of an actor's script; `None` if the scenario gives it none.
    pub fn trigger_name(&self, actor: &str, trigger: u32) -> Option<String> {
        let entry = self.script(actor)?.get(trigger as usize)?;
        Some(entry.get("name")?.as_str()?.to_owned())
    }

    /// The name of a trigger, or its index if it has none.
    pub fn trigger_text(&self, actor: &str, trigger: u32) -> String {
        self.trigger_name(actor, trigger).unwrap_or_else(|| trigger.to_string())
    }

    /// The triggers that did not fire: the name of the actor, and the index in its script.
    pub fn unfired_triggers(&self) -> Vec<(&str, u32)> {
        let has_fired = |index: usize, at: u32| {
            self.events.iter().any(|line| match line.event {
                Event::Triggered { actor, trigger } => usize::from(actor) == index && trigger == at,
                _ => false,
            })
        };
        let actors = self.scenario.iter().flat_map(|scenario| &scenario.actors).enumerate();
        actors
            .flat_map(|(index, actor)| {
                let triggers = 0..self.script(&actor.name).map_or(0, Vec::len) as u32;
                let unfired = triggers.filter(move |trigger| !has_fired(index, *trigger));
                unfired.map(|trigger| (&*actor.name, trigger))
            })
            .collect()
    }

    /// What the episode did not test, although its scenario is about it: triggers that did not
    /// fire, and actors that overlapped the ego when they appeared, whose contact is not judged.
    pub fn untested(&self) -> Vec<String> {
        let actors = self.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
        let overlaps = self.events.iter().filter_map(|line| match &line.event {
            Event::Contact(contact) if contact.at_start => {
                let actor = actors.get(usize::from(contact.actor))?;
                let time_s = line.time_us as f64 * 1e-6;
                Some(format!("{} overlaps the ego when it appears, at {time_s:.1} s", actor.name))
            }
            _ => None,
        });
        let unfired = self.unfired_triggers().into_iter().map(|(actor, trigger)| {
            format!("trigger {} of {actor} did not fire", self.trigger_text(actor, trigger))
        });
        overlaps.chain(unfired).collect()
    }

    /// The format that this build reads.
    pub const FORMAT: u32 = 0;

    /// Reads an episode's file. A damaged or incomplete line ends the reading: all lines before it
    /// are returned, and [`EpisodeFile::cut`] has the place and the reason.
    ///
    /// # Errors
    /// The file cannot be read, or its first line is not a header.
    pub fn read(path: &Path) -> Result<Self, ReadError> {
        let failed = |cause| ReadError::Io { path: path.to_owned(), cause };
        let mut reader = BufReader::new(open_record(path).map_err(failed)?);
        let mut text = Vec::new();
        let mut episode = Self {
            header: read_header(&mut reader, path, &mut text)?,
            scenario: None,
            frames: Vec::new(),
            actors: Vec::new(),
            events: Vec::new(),
            result: None,
            end: None,
            cut: None,
        };
        // Line 1 was the header.
        for number in 2.. {
            let line = read_line(&mut reader, line_bytes(number), &mut text).map_err(failed)?;
            let added = match line {
                Ok(false) => break,
                Ok(true) => parse(&text).and_then(|line| episode.add(line)),
                Err(reason) => Err(reason),
            };
            if let Err(reason) = added {
                episode.cut = Some(Cut { line: number, reason });
                break;
            }
        }
        Ok(episode)
    }

    /// Reads the first line of an episode's file.
    ///
    /// # Errors
    /// The file cannot be read, or its first line is not a header.
    pub fn header(path: &Path) -> Result<Header, ReadError> {
        let failed = |cause| ReadError::Io { path: path.to_owned(), cause };
        let mut reader = BufReader::new(open_record(path).map_err(failed)?);
        read_header(&mut reader, path, &mut Vec::new())
    }

    fn add(&mut self, line: Line) -> Result<(), String> {
        // A session writes `end` last, so that what follows was appended by something else.
        if self.end.is_some() {
            return Err("it follows the end of the episode".to_owned());
        }
        match line {
            Line::Episode(_) => return Err("a second header".to_owned()),
            // Before the other arm of frames: a file of any length must not fill the memory.
            Line::Frame(_) if self.frames.len() >= limits::STEPS => {
                return Err(format!("more than {} frames", limits::STEPS));
            }
            Line::Scenario(scenario) => self.scenario = Some(*scenario),
            Line::Actors(actors) => {
                // The scenario stands before its actors and events in a file. Without one the count
                // is 0, and no index is valid.
                actors.check(self.actor_count())?;
                self.actors.push(actors);
            }
            Line::Event(event) => {
                event.check(self.actor_count())?;
                self.events.push(event);
            }
            Line::Frame(frame) => {
                // If a session returned to an earlier step, drop the events after it.
                // The last event is looked at first: to go through all events at each frame would
                // take frames x events.
                if frame.request != "observe"
                    && self.events.last().is_some_and(|last| last.time_us > frame.time_us)
                {
                    self.events.retain(|event| event.time_us <= frame.time_us);
                }
                self.frames.push(frame);
            }
            Line::Result(result) => self.result = Some(result),
            Line::End(end) => self.end = Some(end),
            Line::Other => {}
        }
        Ok(())
    }

    /// Number of the scenario's actors.
    fn actor_count(&self) -> usize {
        self.scenario.as_ref().map_or(0, |scenario| scenario.actors.len())
    }

    /// The rig of an episode's file, with intrinsics and places of the cameras; `None` if the
    /// header has only names.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn rig(path: &Path) -> Result<Option<Rig>, ReadError> {
        // The overlays of a rig may take nearly all of `HEAD_BYTES`, so that only this function
        // parses them.
        #[derive(Deserialize)]
        struct WithRig {
            rig: Rig,
        }
        let failed = |cause| ReadError::Io { path: path.to_owned(), cause };
        let mut reader = BufReader::new(open_record(path).map_err(failed)?);
        let mut text = Vec::new();
        let line = read_line(&mut reader, line_bytes(1), &mut text).map_err(failed)?;
        let read = line.ok().and_then(|_| serde_json::from_slice::<WithRig>(&text).ok());
        Ok(read.map(|read| read.rig))
    }

    /// The frames that the ego drove: the start and each step, in order. If a session returned to
    /// an earlier step, the frames after this replace the earlier ones.
    pub fn driven(&self) -> Vec<&Frame> {
        let moves = |frame: &Frame| frame.request != "observe" && !frame.poses.is_empty();
        let steps = self.frames.iter().map(|frame| moves(frame).then_some(frame.step));
        driven_indices(steps).into_iter().map(|index| &self.frames[index]).collect()
    }

    /// The name of the episode: that of its file without the extension.
    pub fn episode_name(path: &Path) -> String {
        path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    }
}

/// Opens a record. A pipe in its place is refused, since opening it would wait for a writer.
///
/// # Errors
/// It cannot be opened, or is no regular file.
pub fn open_record(path: &Path) -> io::Result<File> {
    if std::fs::metadata(path)?.is_file() {
        File::open(path)
    } else {
        Err(io::Error::other("it is not a regular file"))
    }
}

/// The largest length of a line of an episode's file, in bytes; the first line has number 1.
pub fn line_bytes(number: usize) -> usize {
    match number {
        1 => limits::HEAD_BYTES,
        2 => limits::SCENARIO_LINE_BYTES,
        _ => limits::LINE_BYTES,
    }
}

/// Indices of the frames that the ego drove. `steps` are those of all frames, in order; `None` for
/// a frame that did not move the ego. If a session returned to an earlier step, the frames after
/// this replace the earlier ones.
pub fn driven_indices(steps: impl IntoIterator<Item = Option<u64>>) -> Vec<usize> {
    // Steps rise strictly in `driven`, so that those to be replaced are at its end, and a binary
    // search finds the first of them.
    let mut driven: Vec<(u64, usize)> = Vec::new();
    for (index, step) in steps.into_iter().enumerate() {
        let Some(step) = step else { continue };
        driven.truncate(driven.partition_point(|(before, _)| *before < step));
        driven.push((step, index));
    }
    driven.into_iter().map(|(_, index)| index).collect()
}

/// Refuses the first line of a file that is an MCAP export and no record.
///
/// # Errors
/// [`ReadError::Mcap`].
pub fn check_no_mcap(path: &Path, first_line: &[u8]) -> Result<(), ReadError> {
    if first_line == MCAP_MAGIC { Err(ReadError::Mcap { path: path.to_owned() }) } else { Ok(()) }
}

/// Reads the first line, with `text` as its buffer.
fn read_header(
    reader: &mut BufReader<File>,
    path: &Path,
    text: &mut Vec<u8>,
) -> Result<Header, ReadError> {
    let failed = |cause| ReadError::Io { path: path.to_owned(), cause };
    let no_header = |reason: String| ReadError::Header { path: path.to_owned(), reason };
    let first = read_line(reader, line_bytes(1), text).map_err(failed)?;
    check_no_mcap(path, text)?;
    let header = match first.and_then(|_| parse(text)).map_err(no_header)? {
        Line::Episode(header) => *header,
        _ => return Err(no_header("it is of another kind".to_owned())),
    };
    let Header { format, dt_us, .. } = header;
    match format == EpisodeFile::FORMAT {
        true if dt_us > 0 => Ok(header),
        true => Err(no_header(format!("dt_us is {dt_us}; a step takes 1 µs at least"))),
        false => {
            let known = EpisodeFile::FORMAT;
            Err(no_header(format!("format {format}; this build reads {known}")))
        }
    }
}

/// Reads a line into `text`. Returns whether there was one, or the error in it.
fn read_line(
    reader: &mut BufReader<File>,
    limit: usize,
    text: &mut Vec<u8>,
) -> io::Result<Result<bool, String>> {
    // The buffer of the line before is used again: a record has a line or two for each step.
    text.clear();
    // A file without line breaks is read up to the limit and not into memory as a whole.
    reader.by_ref().take(limit as u64).read_until(b'\n', text)?;
    Ok(match text.last() {
        None => Ok(false),
        Some(b'\n') => Ok(true),
        Some(_) if text.len() == limit => Err(format!("longer than {limit} bytes")),
        Some(_) => Err("incomplete: it has no line break".to_owned()),
    })
}

fn parse(text: &[u8]) -> Result<Line, String> {
    fn line<'a, T: Deserialize<'a>>(text: &'a [u8]) -> Result<T, String> {
        serde_json::from_slice(text).map_err(|error| error.to_string())
    }
    let Kind { kind } = line(text)?;
    Ok(match &*kind {
        "episode" => Line::Episode(line(text)?),
        "scenario" => Line::Scenario(line(text)?),
        "actors" => Line::Actors(line(text)?),
        "event" => Line::Event(line(text)?),
        "frame" => Line::Frame(line(text)?),
        "result" => Line::Result(line(text)?),
        "end" => Line::End(line(text)?),
        // A record of a later build stays readable: a kind that this build does not know is
        // skipped.
        _ => Line::Other,
    })
}
