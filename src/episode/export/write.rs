//! Writes an episode as MCAP.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Seek, Write};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};
use prost::Message;
use serde::Serialize;
use serde_json::{Value, json};

use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::Lens;

use super::descriptors::descriptor_set;
use super::messages as foxglove;
use crate::file::{EpisodeFile, Frame};
use crate::lines::{ActorsLine, Event, EventLine};

/// What is added to the times of an episode, in microseconds.
const TIME_OFFSET_US: i64 = 1_000_000_000;

/// Bytes of a chunk before compression: about a second of 30 actors at 10 Hz.
const CHUNK_BYTES: u64 = 64 << 10;

/// Why an episode could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file cannot be written.
    #[error("cannot write the MCAP file: {0}")]
    Mcap(#[from] mcap::McapError),
    /// A line cannot be written as JSON.
    #[error("cannot write a line as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The episode has no frame.
    #[error("the episode has no frame: nothing was driven")]
    Empty,
}

/// What an export wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Messages.
    pub messages: u64,
    /// Cameras whose lens Foxglove's calibration cannot describe.
    pub without_calibration: usize,
}

/// Writes an episode. `rig` is that of its header; without one there are no calibrations.
///
/// # Errors
/// The file cannot be written, or the episode has no frame.
pub fn export<W: Write + Seek>(
    episode: &EpisodeFile,
    rig: Option<&Rig>,
    out: W,
) -> Result<Exported, ExportError> {
    let frames = episode.driven();
    let first = frames.first().ok_or(ExportError::Empty)?;
    let mut file = McapFile::create(out)?;
    let without_calibration = file.begin(episode, rig, first.time_us)?;
    let mut shown = BTreeSet::new();
    for frame in &frames {
        let actors = episode.actors.iter().rev().find(|line| line.step == frame.step);
        file.step(episode, frame)?;
        file.boxes(episode, frame, actors, &mut shown)?;
    }
    for line in &episode.events {
        file.event(episode, line)?;
    }
    if let Some(result) = &episode.result {
        let end_us = frames.last().map_or(0, |frame| frame.time_us);
        file.json("/wildcity/result", "wildcity.Result", end_us, result)?;
    }
    let messages = file.messages;
    file.writer.finish()?;
    Ok(Exported { messages, without_calibration })
}

struct McapFile<W: Write + Seek> {
    writer: Writer<W>,
    /// Channel of each topic.
    channels: BTreeMap<String, u16>,
    /// Schema of each name.
    schemas: BTreeMap<&'static str, u16>,
    descriptors: Vec<u8>,
    messages: u64,
}

impl<W: Write + Seek> McapFile<W> {
    fn create(out: W) -> Result<Self, ExportError> {
        let options = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .chunk_size(Some(CHUNK_BYTES))
            // Without threads of its own: a record is small.
            .compression_threads(0)
            .library(concat!("wildcity ", env!("CARGO_PKG_VERSION")));
        let descriptors = descriptor_set();
        let channels = BTreeMap::new();
        let schemas = BTreeMap::new();
        Ok(Self { writer: options.create(out)?, channels, schemas, descriptors, messages: 0 })
    }

    /// What does not change: the header, the route, where the cameras are.
    fn begin(
        &mut self,
        episode: &EpisodeFile,
        rig: Option<&Rig>,
        time_us: i64,
    ) -> Result<usize, ExportError> {
        let header = &episode.header;
        let about = json!({
            "build": header.build, "session": header.session, "twin": header.twin,
            "version": header.version, "version_hash": header.version_hash, "backend": header.backend,
            "seed": header.seed, "dynamics": header.dynamics, "start": header.start, "dt_us": header.dt_us,
            "rig": rig, "scenario": episode.scenario, "end": episode.end.as_ref().map(|end| json!({
                "outcome": end.outcome, "steps": end.steps, "time_us": end.time_us,
                "distance_m": end.distance_m, "least_trust": end.least_trust,
            })),
        });
        self.json("/wildcity/episode", "wildcity.Episode", time_us, &about)?;
        if let Some(scenario) =
            episode.scenario.as_ref().filter(|scenario| !scenario.route.is_empty())
        {
            let at = |xyz_m: [f64; 3]| Pose { position_m: xyz_m.into(), ..Pose::IDENTITY };
            let poses = scenario.route.iter().map(|point| pose(&at(point.1)));
            self.poses("/route", "world", time_us, poses.collect())?;
        }
        let cameras = rig.map_or(&[][..], |rig| &rig.cameras);
        let transforms = cameras
            .iter()
            .enumerate()
            .map(|(k, camera)| transform("rig", &frame_of(k), time_us, &camera.rig_from_camera));
        let transforms: Vec<_> = transforms.collect();
        if !transforms.is_empty() {
            self.transforms(time_us, transforms)?;
        }
        let mut without_calibration = 0;
        for (k, camera) in cameras.iter().enumerate() {
            match calibration(k, camera, time_us) {
                Some(message) => {
                    let topic = format!("/camera/{k}/calibration");
                    self.proto(&topic, "foxglove.CameraCalibration", time_us, &message)?;
                }
                None => without_calibration += 1,
            }
        }
        Ok(without_calibration)
    }

    fn transforms(
        &mut self,
        time_us: i64,
        transforms: Vec<foxglove::FrameTransform>,
    ) -> Result<(), ExportError> {
        let message = foxglove::FrameTransforms { transforms };
        self.proto("/tf", "foxglove.FrameTransforms", time_us, &message)
    }

    /// The ego and its plan at a step.
    fn step(&mut self, episode: &EpisodeFile, frame: &Frame) -> Result<(), ExportError> {
        let time_us = frame.time_us;
        let Some(world_from_rig) = frame.poses.last() else { return Ok(()) };
        self.transforms(time_us, vec![transform("world", "rig", time_us, world_from_rig)])?;
        if let Some(poses) = plan_of(frame) {
            self.poses("/plan", "rig", time_us, poses)?;
        }
        let line = json!({
            "step": frame.step, "time_us": time_us, "request": frame.request, "command": command_of(frame),
            "terminated": frame.terminated, "frame_hash": frame.frame_hash, "images": frame.images,
            "cameras": episode.header.rig.cameras.iter().map(|camera| &camera.name).collect::<Vec<_>>(),
        });
        self.json("/wildcity/step", "wildcity.Step", time_us, &line)
    }

    /// A box for the ego and for each actor; those that left are deleted.
    fn boxes(
        &mut self,
        episode: &EpisodeFile,
        frame: &Frame,
        actors: Option<&ActorsLine>,
        shown: &mut BTreeSet<u16>,
    ) -> Result<(), ExportError> {
        let Some(scenario) = &episode.scenario else { return Ok(()) };
        let time = Some(timestamp(frame.time_us));
        let [length_m, width_m, height_m] = scenario.ego.size;
        let center_m = [scenario.ego.center_x, 0.0, 0.5 * height_m];
        let ego_center = Pose { position_m: center_m.into(), ..Pose::IDENTITY };
        let blue = foxglove::Color { r: 0.0, g: 0.45, b: 0.7, a: 0.5 };
        let mut entities = vec![entity(
            frame.time_us,
            "rig",
            "ego",
            &ego_center,
            [length_m, width_m, height_m],
            blue,
        )];
        let mut there = BTreeSet::new();
        for state in actors.iter().flat_map(|line| &line.actors) {
            let (Some(state), Some(actor)) =
                (state.state(), scenario.actors.get(usize::from(state.0)))
            else {
                continue;
            };
            there.insert(state.index);
            let up_m =
                Pose { position_m: [0.0, 0.0, 0.5 * actor.size[2]].into(), ..Pose::IDENTITY };
            let center = state.world_from_actor * up_m;
            let orange = foxglove::Color { r: 0.84, g: 0.37, b: 0.0, a: 0.7 };
            entities.push(entity(frame.time_us, "world", &actor.name, &center, actor.size, orange));
        }
        let name =
            |index: &u16| scenario.actors.get(usize::from(*index)).map(|actor| actor.name.clone());
        let deletions = shown
            .difference(&there)
            .filter_map(name)
            .map(|id| foxglove::SceneEntityDeletion { timestamp: time, kind: 0, id });
        let update = foxglove::SceneUpdate { deletions: deletions.collect(), entities };
        *shown = there;
        self.proto("/actors", "foxglove.SceneUpdate", frame.time_us, &update)
    }

    fn event(&mut self, episode: &EpisodeFile, line: &EventLine) -> Result<(), ExportError> {
        const INFO: i32 = 2;
        const WARNING: i32 = 3;
        let name = |index: u16| {
            let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
            actors.get(usize::from(index)).map_or(index.to_string(), |actor| actor.name.clone())
        };
        let (level, message) = match &line.event {
            Event::Contact(contact) => {
                let fault = if contact.ego_at_fault { "at fault" } else { "not at fault" };
                (
                    WARNING,
                    format!(
                        "contact with {} at {:.2} m/s, {fault}",
                        name(contact.actor),
                        contact.impact_mps
                    ),
                )
            }
            Event::StaticContact { impact_mps, .. } => {
                (WARNING, format!("contact with the twin at {impact_mps:.2} m/s"))
            }
            Event::OffModel { trust } => {
                (WARNING, format!("left the trained area: trust {trust:.3}"))
            }
            Event::Triggered { actor, trigger } => {
                (INFO, format!("{} fires trigger {trigger}", name(*actor)))
            }
            Event::Appeared { actor } => (INFO, format!("{} appears", name(*actor))),
            Event::Left { actor } => (INFO, format!("{} leaves", name(*actor))),
            Event::Ended { rule } => (INFO, format!("ended by the rule {rule}")),
        };
        let timestamp = Some(timestamp(line.time_us));
        let log = foxglove::Log { timestamp, level, message, name: "wildcity".to_owned() };
        self.proto("/log", "foxglove.Log", line.time_us, &log)?;
        self.json("/wildcity/event", "wildcity.Event", line.time_us, line)
    }

    fn poses(
        &mut self,
        topic: &str,
        frame: &str,
        time_us: i64,
        poses: Vec<foxglove::Pose>,
    ) -> Result<(), ExportError> {
        let timestamp = Some(timestamp(time_us));
        let message = foxglove::PosesInFrame { timestamp, frame_id: frame.to_owned(), poses };
        self.proto(topic, "foxglove.PosesInFrame", time_us, &message)
    }

    fn proto(
        &mut self,
        topic: &str,
        schema: &'static str,
        time_us: i64,
        message: &impl Message,
    ) -> Result<(), ExportError> {
        let channel = self.channel(topic, schema, "protobuf")?;
        self.write(channel, time_us, &message.encode_to_vec())
    }

    fn json(
        &mut self,
        topic: &str,
        schema: &'static str,
        time_us: i64,
        message: &impl Serialize,
    ) -> Result<(), ExportError> {
        let channel = self.channel(topic, schema, "json")?;
        self.write(channel, time_us, &serde_json::to_vec(message)?)
    }

    /// The channel of a topic, created with its first message.
    fn channel(
        &mut self,
        topic: &str,
        schema: &'static str,
        encoding: &str,
    ) -> Result<u16, ExportError> {
        if let Some(&channel) = self.channels.get(topic) {
            return Ok(channel);
        }
        let schema = match self.schemas.get(schema) {
            Some(&schema) => schema,
            None => {
                let id = match encoding {
                    "protobuf" => self.writer.add_schema(schema, "protobuf", &self.descriptors)?,
                    _ => self.writer.add_schema(schema, "jsonschema", br#"{"type":"object"}"#)?,
                };
                self.schemas.insert(schema, id);
                id
            }
        };
        let channel = self.writer.add_channel(schema, topic, encoding, &BTreeMap::new())?;
        self.channels.insert(topic.to_owned(), channel);
        Ok(channel)
    }

    fn write(&mut self, channel_id: u16, time_us: i64, data: &[u8]) -> Result<(), ExportError> {
        let log_time = nanoseconds(time_us);
        let sequence = u32::try_from(self.messages).unwrap_or(u32::MAX);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, data)?;
        self.messages += 1;
        Ok(())
    }
}

/// The command without what `/plan` has: of a trajectory, the times of its poses are left. Poses as text would be two thirds
/// of a file.
fn command_of(frame: &Frame) -> Option<Value> {
    let command = frame.command.as_ref()?;
    let Some(poses) = command.get("trajectory").and_then(Value::as_array) else {
        return Some(command.clone());
    };
    let times_us: Vec<&Value> = poses.iter().filter_map(|pose| pose.get("time_us")).collect();
    Some(json!({ "trajectory": { "times_us": times_us, "poses": "/plan" } }))
}

/// The agent's trajectory in the rig's frame, if that was its command.
fn plan_of(frame: &Frame) -> Option<Vec<foxglove::Pose>> {
    let poses = frame.command.as_ref()?.get("trajectory")?.as_array()?;
    let read =
        |value: &Value| serde_json::from_value::<Pose>(value.get("start_from_rig")?.clone()).ok();
    Some(poses.iter().filter_map(read).map(|read| pose(&read)).collect())
}

fn nanoseconds(time_us: i64) -> u64 {
    u64::try_from(time_us.saturating_add(TIME_OFFSET_US)).unwrap_or(0).saturating_mul(1000)
}

fn timestamp(time_us: i64) -> foxglove::Timestamp {
    let nanoseconds = nanoseconds(time_us);
    foxglove::Timestamp {
        seconds: (nanoseconds / 1_000_000_000) as i64,
        nanos: (nanoseconds % 1_000_000_000) as i32,
    }
}

fn vector([x, y, z]: [f64; 3]) -> foxglove::Vector3 {
    foxglove::Vector3 { x, y, z }
}

fn pose(pose: &Pose) -> foxglove::Pose {
    foxglove::Pose {
        position: Some(vector(pose.position_m.to_array())),
        orientation: Some(quaternion(pose)),
    }
}

fn quaternion(pose: &Pose) -> foxglove::Quaternion {
    let [w, x, y, z] = pose.q_wxyz();
    foxglove::Quaternion { x, y, z, w }
}

fn transform(parent: &str, child: &str, time_us: i64, pose: &Pose) -> foxglove::FrameTransform {
    foxglove::FrameTransform {
        timestamp: Some(timestamp(time_us)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(vector(pose.position_m.to_array())),
        rotation: Some(quaternion(pose)),
    }
}

/// The frame of a camera.
fn frame_of(camera: usize) -> String {
    format!("camera/{camera}")
}

fn entity(
    time_us: i64,
    frame: &str,
    id: &str,
    center: &Pose,
    size_m: [f64; 3],
    color: foxglove::Color,
) -> foxglove::SceneEntity {
    let cube = foxglove::CubePrimitive {
        pose: Some(pose(center)),
        size: Some(vector(size_m)),
        color: Some(color),
    };
    foxglove::SceneEntity {
        timestamp: Some(timestamp(time_us)),
        frame_id: frame.to_owned(),
        id: id.to_owned(),
        frame_locked: true,
        cubes: vec![cube],
    }
}

/// The calibration of a camera by a model that Foxglove knows; `None` for f-theta.
fn calibration(
    index: usize,
    camera: &wildcity_scene::rig::RigCamera,
    time_us: i64,
) -> Option<foxglove::CameraCalibration> {
    let size = &camera.camera;
    let lens = &size.pinhole;
    let (model, d) = match &size.lens {
        Lens::Pinhole => ("plumb_bob", vec![0.0; 5]),
        Lens::OpenCv(lens) => {
            let [k1, k2, k3, k4, k5, k6] = lens.k();
            let [p1, p2] = lens.p();
            ("rational_polynomial", vec![k1, k2, p1, p2, k3, k4, k5, k6])
        }
        Lens::Fisheye(lens) => ("kannala_brandt", lens.k().to_vec()),
        Lens::FTheta(_) => return None,
    };
    let k = vec![lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0];
    let p = vec![lens.fx, 0.0, lens.cx, 0.0, 0.0, lens.fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    Some(foxglove::CameraCalibration {
        timestamp: Some(timestamp(time_us)),
        width: size.width_px,
        height: size.height_px,
        distortion_model: model.to_owned(),
        d,
        k,
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p,
        frame_id: frame_of(index),
    })
}
