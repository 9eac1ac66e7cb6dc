//! Writes an episode as MCAP.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Seek, Write};
use std::iter::Peekable;
use std::slice::Iter;

use serde_json::json;

use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_score::EgoSample;

use super::calibration::Calibration;
use super::container::McapFile;
use super::convert::{camera_frame, color, cube, entity, place, pose, timestamp, transform};
use super::error::{ExportError, Exported};
use super::messages as foxglove;
use super::parts::{command, event_text, motions, odometry, plan};
use super::sweep::{ExportedSweep, POINT_BYTES, foxglove_fields, packed};
use crate::file::{EpisodeFile, Frame};
use crate::lines::{ActorsLine, EventLine, ScenarioLine};

/// An image of an episode.
#[derive(Clone, Copy, Debug)]
pub struct ExportedImage<'a> {
    /// Index of its camera in the rig.
    pub camera: usize,
    /// When it was taken, in microseconds.
    pub time_us: i64,
    pub jpeg: &'a [u8],
}

/// Writes an episode without images. `rig` is that of its header; without one there are no
/// calibrations.
///
/// # Errors
/// The file cannot be written, or the episode has no frame.
pub fn export<W: Write + Seek>(
    episode: &EpisodeFile,
    rig: Option<&Rig>,
    out: W,
) -> Result<Exported, ExportError> {
    EpisodeExport::begin(episode, rig, out)?.finish()
}

/// An MCAP file that is being written: messages in the order of time, as far as images are added in
/// that order.
pub struct EpisodeExport<'a, W: Write + Seek> {
    file: McapFile<W>,
    episode: &'a EpisodeFile,
    /// The frames that are not written yet, each with the ego's motion.
    frames: Peekable<std::vec::IntoIter<(&'a Frame, Option<EgoSample>)>>,
    events: Peekable<Iter<'a, EventLine>>,
    /// The actors at each step.
    actors: BTreeMap<u64, &'a ActorsLine>,
    /// Actors that have a box now.
    shown: BTreeSet<u16>,
    end_us: i64,
    calibration_error_px: f64,
}

impl<'a, W: Write + Seek> EpisodeExport<'a, W> {
    /// Starts a file with the constant parts: the header, the rig, the route and the map.
    ///
    /// # Errors
    /// The file cannot be written, or the episode has no frame.
    pub fn begin(episode: &'a EpisodeFile, rig: Option<&Rig>, out: W) -> Result<Self, ExportError> {
        let frames = episode.driven();
        let begin_us = frames.first().ok_or(ExportError::Empty)?.time_us;
        let end_us = frames.last().map_or(begin_us, |last| last.time_us);
        let cameras = rig.map_or(&[][..], |rig| &rig.cameras);
        let calibrations: Vec<Calibration> = cameras
            .iter()
            .enumerate()
            .map(|(k, camera)| Calibration::new(k, camera, begin_us))
            .collect();
        let errors_px = calibrations.iter().map(|calibration| calibration.error_px);
        let motions = motions(&frames, episode.header.dt_us);
        let mut export = Self {
            file: McapFile::create(out)?,
            episode,
            frames: frames.iter().copied().zip(motions).collect::<Vec<_>>().into_iter().peekable(),
            events: episode.events.iter().peekable(),
            // If a session returned to an earlier state, and in a warm-up, a step has several
            // lines: use the last one.
            actors: episode.actors.iter().map(|line| (line.step, line)).collect(),
            shown: BTreeSet::new(),
            end_us,
            calibration_error_px: errors_px.fold(0.0, f64::max),
        };
        // All that is constant gets the time of the first frame: a viewer that starts there has it
        // at once.
        export.about(rig, &calibrations, begin_us)?;
        export.rig(rig, calibrations, begin_us)?;
        export.path(&frames, begin_us)?;
        if let Some(scenario) = &episode.scenario {
            export.route(scenario, begin_us)?;
            export.map(scenario, begin_us)?;
        }
        Ok(export)
    }

    /// Adds an image, after all messages of earlier times.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn image(&mut self, image: &ExportedImage<'_>) -> Result<(), ExportError> {
        self.write_until(image.time_us)?;
        let message = foxglove::CompressedImage {
            timestamp: Some(timestamp(image.time_us)),
            frame_id: camera_frame(image.camera),
            data: image.jpeg.to_vec(),
            format: "jpeg".to_owned(),
        };
        let topic = format!("/camera/{}/image", image.camera);
        self.file.proto(&topic, "foxglove.CompressedImage", image.time_us, &message)
    }

    /// Adds a sweep of a LiDAR, after all messages of earlier times.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn sweep(&mut self, sweep: &ExportedSweep<'_>) -> Result<(), ExportError> {
        self.write_until(sweep.time_us)?;
        let message = foxglove::PointCloud {
            timestamp: Some(timestamp(sweep.time_us)),
            frame_id: "rig".to_owned(),
            pose: Some(place([0.0; 3])),
            point_stride: POINT_BYTES,
            fields: foxglove_fields(),
            data: packed(sweep.points),
        };
        let topic = format!("/lidar/{}/points", sweep.lidar);
        self.file.proto(&topic, "foxglove.PointCloud", sweep.time_us, &message)
    }

    /// Writes the remaining messages, and the index.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<Exported, ExportError> {
        self.write_until(i64::MAX)?;
        if let Some(result) = &self.episode.result {
            self.file.json("/wildcity/result", "wildcity.Result", self.end_us, result)?;
        }
        let calibration_error_px = self.calibration_error_px;
        Ok(Exported { messages: self.file.finish()?, calibration_error_px })
    }

    /// Writes frames and events before a time.
    fn write_until(&mut self, time_us: i64) -> Result<(), ExportError> {
        // Frames of exactly this time wait, so that the images of a time stand before its other
        // messages.
        while let Some((frame, motion)) = self.frames.next_if(|(frame, _)| frame.time_us < time_us)
        {
            // What happened during a step comes before the state at its end.
            while let Some(event) = self.events.next_if(|event| event.time_us <= frame.time_us) {
                self.event(event)?;
            }
            self.step(frame, motion)?;
            self.boxes(frame)?;
            // A plan is in the frame of the rig at the start of its step.
            if let Some(poses) = self.frames.peek().and_then(|(next, _)| plan(next)) {
                self.poses("/plan", "rig", frame.time_us, poses)?;
            }
        }
        // Events after the last frame, such as the end of the episode, wait for no frame.
        if self.frames.peek().is_none() {
            while let Some(event) = self.events.next() {
                self.event(event)?;
            }
        }
        Ok(())
    }

    fn about(
        &mut self,
        rig: Option<&Rig>,
        calibrations: &[Calibration],
        time_us: i64,
    ) -> Result<(), ExportError> {
        let episode = self.episode;
        let header = &episode.header;
        let lenses = calibrations.iter().map(|calibration| {
            let model = &calibration.message.distortion_model;
            json!({ "model": model, "error_px": calibration.error_px })
        });
        let about = json!({
            "build": header.build, "session": header.session, "twin": header.twin,
            "version": header.version, "version_hash": header.version_hash, "backend": header.backend,
            "seed": header.seed, "dynamics": header.dynamics, "start": header.start, "dt_us": header.dt_us,
            "rig": rig, "calibrations": lenses.collect::<Vec<_>>(), "scenario": episode.scenario,
            "end": episode.end.as_ref().map(|end| json!({
                "outcome": end.outcome, "steps": end.steps, "time_us": end.time_us,
                "distance_m": end.distance_m, "least_trust": end.least_trust,
            })),
        });
        self.file.json("/wildcity/episode", "wildcity.Episode", time_us, &about)
    }

    fn rig(
        &mut self,
        rig: Option<&Rig>,
        calibrations: Vec<Calibration>,
        time_us: i64,
    ) -> Result<(), ExportError> {
        let cameras = rig.map_or(&[][..], |rig| &rig.cameras).iter().enumerate();
        let transforms = cameras.map(|(k, camera)| {
            transform("rig", &camera_frame(k), time_us, &camera.rig_from_camera)
        });
        let transforms: Vec<_> = transforms.collect();
        if !transforms.is_empty() {
            self.transforms(time_us, transforms)?;
        }
        for (k, calibration) in calibrations.into_iter().enumerate() {
            let topic = format!("/camera/{k}/calibration");
            self.file.proto(&topic, "foxglove.CameraCalibration", time_us, &calibration.message)?;
        }
        Ok(())
    }

    /// All that the ego drove.
    fn path(&mut self, frames: &[&Frame], time_us: i64) -> Result<(), ExportError> {
        let poses = frames.iter().filter_map(|frame| frame.poses.last()).map(pose);
        self.poses("/ego/path", "world", time_us, poses.collect())
    }

    fn route(&mut self, scenario: &ScenarioLine, time_us: i64) -> Result<(), ExportError> {
        if scenario.route.is_empty() {
            return Ok(());
        }
        let poses = scenario.route.iter().map(|point| place(point.1));
        self.poses("/route", "world", time_us, poses.collect())
    }

    /// The outlines of the lanes, at the height of the start of the route: a map in a record is
    /// flat.
    fn map(&mut self, scenario: &ScenarioLine, time_us: i64) -> Result<(), ExportError> {
        if scenario.lanes.is_empty() {
            return Ok(());
        }
        let z = scenario.route.first().map_or(0.0, |point| point.1[2]);
        let outlines = scenario.lanes.iter().map(|lane| foxglove::LinePrimitive {
            kind: foxglove::LINE_LOOP,
            pose: Some(place([0.0; 3])),
            thickness: 2.0,
            scale_invariant: true,
            points: lane.outline.iter().map(|&[x, y]| foxglove::Point3 { x, y, z }).collect(),
            // Colours of the palette of Okabe and Ito, which can be told apart without red or green
            // vision.
            color: Some(match (lane.route, lane.intersection) {
                (true, _) => color(0.0, 0.62, 0.45, 1.0),
                (false, true) => color(0.94, 0.89, 0.26, 1.0),
                (false, false) => color(0.6, 0.6, 0.6, 1.0),
            }),
        });
        let lines = outlines.collect();
        let entities = vec![foxglove::SceneEntity { lines, ..entity(time_us, "world", "lanes") }];
        let update = foxglove::SceneUpdate { deletions: Vec::new(), entities };
        self.file.proto("/map", "foxglove.SceneUpdate", time_us, &update)
    }

    fn transforms(
        &mut self,
        time_us: i64,
        transforms: Vec<foxglove::FrameTransform>,
    ) -> Result<(), ExportError> {
        let message = foxglove::FrameTransforms { transforms };
        self.file.proto("/tf", "foxglove.FrameTransforms", time_us, &message)
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
        self.file.proto(topic, "foxglove.PosesInFrame", time_us, &message)
    }

    /// The ego at a step.
    fn step(&mut self, frame: &Frame, motion: Option<EgoSample>) -> Result<(), ExportError> {
        let time_us = frame.time_us;
        let Some(world_from_rig) = frame.poses.last() else { return Ok(()) };
        self.transforms(time_us, vec![transform("world", "rig", time_us, world_from_rig)])?;
        let odometry = odometry(time_us, world_from_rig, motion);
        self.file.proto("/ego/odometry", "foxglove.Odometry", time_us, &odometry)?;
        // Rerun's converter shows poses, and neither odometry nor boxes.
        let place = foxglove::PoseInFrame {
            timestamp: Some(timestamp(time_us)),
            frame_id: "world".to_owned(),
            pose: Some(pose(world_from_rig)),
        };
        self.file.proto("/ego/pose", "foxglove.PoseInFrame", time_us, &place)?;
        let cameras = &self.episode.header.rig.cameras;
        let line = json!({
            "step": frame.step, "time_us": time_us, "request": frame.request, "command": command(frame),
            "terminated": frame.terminated, "frame_hash": frame.frame_hash, "images": frame.images,
            "cameras": cameras.iter().map(|camera| &camera.name).collect::<Vec<_>>(),
        });
        self.file.json("/wildcity/step", "wildcity.Step", time_us, &line)
    }

    /// A box for the ego and for each actor; those that left are deleted.
    fn boxes(&mut self, frame: &Frame) -> Result<(), ExportError> {
        let time_us = frame.time_us;
        let Some(scenario) = &self.episode.scenario else { return Ok(()) };
        let boxed = |frame: &str, id: &str, center: &Pose, size_m: [f64; 3], color| {
            let cubes = vec![cube(center, size_m, color)];
            foxglove::SceneEntity { cubes, ..entity(time_us, frame, id) }
        };
        // The rig's origin is on the ground below the rear axle: the middle of the box is half its
        // height above it. The box is in the frame of the rig, so that `/tf` moves it.
        let size_m = scenario.ego.size;
        let center_m = [scenario.ego.center_x, 0.0, 0.5 * size_m[2]];
        let center = Pose { position_m: center_m.into(), ..Pose::IDENTITY };
        let mut entities = vec![boxed("rig", "ego", &center, size_m, color(0.0, 0.45, 0.7, 0.5))];
        // A viewer keeps an entity until it is deleted: the actors of the step before that are not
        // there now are deleted by name.
        let mut there = BTreeSet::new();
        let mut centers = Vec::new();
        let states = self.actors.get(&frame.step).map_or(&[][..], |line| &line.actors);
        for state in states.iter().filter_map(|state| state.state()) {
            let Some(actor) = scenario.actors.get(usize::from(state.index)) else { continue };
            there.insert(state.index);
            // The origin of an actor is on the ground, as the rig's is.
            let up_m = [0.0, 0.0, 0.5 * actor.size[2]];
            let center =
                state.world_from_actor * Pose { position_m: up_m.into(), ..Pose::IDENTITY };
            let orange = color(0.84, 0.37, 0.0, 0.7);
            entities.push(boxed("world", &actor.name, &center, actor.size, orange));
            centers.push(pose(&center));
        }
        // Also without an actor: a viewer keeps the last message.
        if !scenario.actors.is_empty() {
            self.poses("/actors/poses", "world", time_us, centers)?;
        }
        let name = |index: &u16| Some(scenario.actors.get(usize::from(*index))?.name.clone());
        let deletions = self.shown.difference(&there).filter_map(name).map(|id| {
            foxglove::SceneEntityDeletion { timestamp: Some(timestamp(time_us)), kind: 0, id }
        });
        let update = foxglove::SceneUpdate { deletions: deletions.collect(), entities };
        self.shown = there;
        self.file.proto("/actors", "foxglove.SceneUpdate", time_us, &update)
    }

    fn event(&mut self, line: &EventLine) -> Result<(), ExportError> {
        let (level, message) = event_text(self.episode, &line.event);
        let timestamp = Some(timestamp(line.time_us));
        let log = foxglove::Log { timestamp, level, message, name: "wildcity".to_owned() };
        self.file.proto("/log", "foxglove.Log", line.time_us, &log)?;
        self.file.json("/wildcity/event", "wildcity.Event", line.time_us, line)
    }
}
