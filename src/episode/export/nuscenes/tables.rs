//! Rows of the tables, with tokens that are the same in every export of an episode.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use wildcity_scene::ActorClass;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_sim::traffic::ActorState;

use super::Image;
use crate::export::convert::nanoseconds;
use crate::file::{EpisodeFile, Frame};
use crate::lines::ActorLine;

/// The mask of the map.
pub(super) const MAP_FILE: &str = "maps/empty.png";

/// All tables of version 1.0: a reader opens each of them.
const NAMES: [&str; 13] = [
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
];

const CATEGORIES: [&str; 4] = [
    "vehicle.car",
    "human.pedestrian.adult",
    "vehicle.bicycle",
    "movable_object.pushable_pullable",
];

const ATTRIBUTES: [&str; 5] = [
    "vehicle.moving",
    "vehicle.stopped",
    "pedestrian.moving",
    "pedestrian.standing",
    "cycle.with_rider",
];

const VISIBILITIES: [&str; 4] = ["v0-40", "v40-60", "v60-80", "v80-100"];

/// Speed above which an actor moves, in m/s.
// A pedestrian walks at 1.4 m/s.
const MOVING_MPS: f64 = 0.2;

/// Rows by their table.
pub(super) struct Tables {
    pub(super) rows: BTreeMap<&'static str, Vec<Value>>,
    /// What all tokens of the episode begin with: 16 digits.
    prefix: String,
}

impl Tables {
    pub(super) fn new(episode: &EpisodeFile) -> Self {
        let header = &episode.header;
        let names = format!("{}/{}/{}", header.version_hash, header.session, header.seed);
        let scenario = episode.scenario.as_ref().map_or("", |scenario| &scenario.hash);
        let prefix = format!("{:016x}", fnv1a(names.bytes().chain(scenario.bytes())));
        let rows = NAMES.map(|name| (name, Vec::new())).into();
        let mut tables = Self { rows, prefix };
        tables.named("category", &CATEGORIES);
        tables.named("attribute", &ATTRIBUTES);
        for (index, level) in VISIBILITIES.into_iter().enumerate() {
            // Tokens of this table are numbers from 1.
            let token = (index + 1).to_string();
            tables.add("visibility", json!({ "token": token, "level": level, "description": "" }));
        }
        tables.log(episode);
        tables
    }

    fn add(&mut self, table: &'static str, row: Value) {
        self.rows.entry(table).or_default().push(row);
    }

    /// The token of a row: 32 hexadecimal digits.
    fn token(&self, table: &str, index: usize) -> String {
        let table = NAMES.iter().position(|name| *name == table).unwrap_or(NAMES.len());
        format!("{}{table:02x}{index:014x}", self.prefix)
    }

    /// The token of a row, or an empty text if there is none.
    fn link(&self, table: &str, index: Option<usize>) -> String {
        index.map_or(String::new(), |index| self.token(table, index))
    }

    fn named(&mut self, table: &'static str, names: &[&str]) {
        for (index, name) in names.iter().enumerate() {
            let token = self.token(table, index);
            let mut row = json!({ "token": token, "name": name, "description": "" });
            if table == "category" {
                // By which labels of points name it.
                row["index"] = index.into();
            }
            self.add(table, row);
        }
    }

    fn log(&mut self, episode: &EpisodeFile) {
        let header = &episode.header;
        let token = self.token("log", 0);
        let map = json!({
            "token": self.token("map", 0), "category": "semantic_prior", "filename": MAP_FILE,
            "log_tokens": [&token],
        });
        self.add("map", map);
        // The day of the times: an episode has none.
        let log = json!({
            "token": token, "logfile": header.session, "vehicle": header.rig.name,
            "date_captured": "1970-01-01", "location": header.twin,
        });
        self.add("log", log);
        let scenario = episode.scenario.as_ref().map_or("", |scenario| &scenario.name);
        let scene = json!({
            "token": self.token("scene", 0), "log_token": self.token("log", 0),
            "name": header.session, "description": scenario,
        });
        self.add("scene", scene);
    }

    pub(super) fn scene(&mut self, samples: &[&Frame]) {
        let last = samples.len().saturating_sub(1);
        let ends = [self.token("sample", 0), self.token("sample", last)];
        for scene in self.rows.entry("scene").or_default() {
            let [first, last] = &ends;
            scene["nbr_samples"] = samples.len().into();
            scene["first_sample_token"] = first.as_str().into();
            scene["last_sample_token"] = last.as_str().into();
        }
        for (index, frame) in samples.iter().enumerate() {
            let row = json!({
                "token": self.token("sample", index), "timestamp": timestamp_us(frame.time_us),
                "prev": self.link("sample", index.checked_sub(1)),
                "next": self.link("sample", (index < last).then_some(index + 1)),
                "scene_token": self.token("scene", 0),
            });
            self.add("sample", row);
        }
    }

    pub(super) fn sensors(&mut self, cameras: &[RigCamera], channels: &[String]) {
        for (index, (camera, channel)) in cameras.iter().zip(channels).enumerate() {
            let sensor = json!({
                "token": self.token("sensor", index), "channel": channel, "modality": "camera",
            });
            self.add("sensor", sensor);
            let pinhole = &camera.camera.pinhole;
            // nuScenes counts pixels from the middle of the first one, this project from its
            // corner.
            let cx = pinhole.cx - 0.5;
            let cy = pinhole.cy - 0.5;
            let mount = &camera.rig_from_camera;
            let row = json!({
                "token": self.token("calibrated_sensor", index),
                "sensor_token": self.token("sensor", index),
                "translation": mount.position_m.to_array(), "rotation": mount.q_wxyz(),
                "camera_intrinsic": [[pinhole.fx, 0.0, cx], [0.0, pinhole.fy, cy], [0.0, 0.0, 1.0]],
            });
            self.add("calibrated_sensor", row);
        }
    }

    /// Images in the order of time.
    pub(super) fn images(&mut self, images: &[Image], cameras: &[RigCamera]) {
        let mut before: BTreeMap<usize, usize> = BTreeMap::new();
        for (index, image) in images.iter().enumerate() {
            self.ego_pose(index, image.time_us, &image.world_from_rig);
            let Some(camera) = cameras.get(image.camera) else { continue };
            let mut after = images.iter().enumerate().skip(index + 1);
            let next = after.find(|(_, next)| next.camera == image.camera).map(|(next, _)| next);
            let previous = before.insert(image.camera, index);
            let row = json!({
                "token": self.token("sample_data", index),
                "sample_token": self.token("sample", image.sample),
                "ego_pose_token": self.token("ego_pose", index),
                "calibrated_sensor_token": self.token("calibrated_sensor", image.camera),
                "timestamp": timestamp_us(image.time_us), "fileformat": "jpg",
                "is_key_frame": image.is_key, "height": camera.camera.height_px,
                "width": camera.camera.width_px, "filename": image.file,
                "prev": self.link("sample_data", previous), "next": self.link("sample_data", next),
            });
            self.add("sample_data", row);
        }
    }

    /// A pose for each frame.
    pub(super) fn poses(&mut self, frames: &[&Frame]) {
        for (index, frame) in frames.iter().enumerate() {
            if let Some(pose) = frame.poses.last() {
                self.ego_pose(index, frame.time_us, pose);
            }
        }
    }

    fn ego_pose(&mut self, index: usize, time_us: i64, pose: &Pose) {
        let row = json!({
            "token": self.token("ego_pose", index), "timestamp": timestamp_us(time_us),
            "translation": pose.position_m.to_array(), "rotation": pose.q_wxyz(),
        });
        self.add("ego_pose", row);
    }

    /// The actors at the samples.
    pub(super) fn boxes(&mut self, episode: &EpisodeFile, samples: &[&Frame]) {
        let Some(scenario) = &episode.scenario else { return };
        // If a session returned to an earlier state, a step has several lines: the last one counts.
        let lines: BTreeMap<u64, _> =
            episode.actors.iter().map(|line| (line.step, &line.actors)).collect();
        let mut count = 0;
        for (index, actor) in scenario.actors.iter().enumerate() {
            let seen = samples.iter().enumerate().filter_map(|(sample, frame)| {
                let states = lines.get(&frame.step)?.iter().filter_map(|state| state.state());
                let mut its = states.filter(|state| usize::from(state.index) == index);
                Some((sample, its.next()?))
            });
            let seen: Vec<(usize, ActorState)> = seen.collect();
            let Some(last) = seen.len().checked_sub(1) else { continue };
            let row = json!({
                "token": self.token("instance", index),
                "category_token": self.token("category", category(actor.class)),
                "nbr_annotations": seen.len(),
                "first_annotation_token": self.token("sample_annotation", count),
                "last_annotation_token": self.token("sample_annotation", count + last),
            });
            self.add("instance", row);
            for (place, (sample, state)) in seen.iter().enumerate() {
                self.annotation(index, actor, *sample, state, [count, count + last, count + place]);
            }
            count += seen.len();
        }
    }

    /// `chain`: indices of the actor's first and last annotation, and of this one.
    fn annotation(
        &mut self,
        instance: usize,
        actor: &ActorLine,
        sample: usize,
        state: &ActorState,
        [first, last, this]: [usize; 3],
    ) {
        let [length, width, height] = actor.size;
        // The origin of an actor is on the ground.
        let up = Pose { position_m: [0.0, 0.0, 0.5 * height].into(), ..Pose::IDENTITY };
        let center = state.world_from_actor * up;
        let attributes = attribute(actor.class, state.velocity_mps.length() > MOVING_MPS)
            .map(|index| self.token("attribute", index));
        let row = json!({
            "token": self.token("sample_annotation", this),
            "sample_token": self.token("sample", sample),
            "instance_token": self.token("instance", instance),
            "visibility_token": VISIBILITIES.len().to_string(),
            "attribute_tokens": attributes.into_iter().collect::<Vec<_>>(),
            "translation": center.position_m.to_array(), "size": [width, length, height],
            "rotation": center.q_wxyz(),
            "prev": self.link("sample_annotation", (this > first).then(|| this - 1)),
            "next": self.link("sample_annotation", (this < last).then_some(this + 1)),
            "num_lidar_pts": 0, "num_radar_pts": 0,
        });
        self.add("sample_annotation", row);
    }
}

/// The row of [`CATEGORIES`] that a class has.
fn category(class: ActorClass) -> usize {
    match class {
        ActorClass::Vehicle => 0,
        ActorClass::Pedestrian => 1,
        ActorClass::Bicycle => 2,
        ActorClass::Object => 3,
    }
}

/// The row of [`ATTRIBUTES`] that a class has, at rest or moving.
fn attribute(class: ActorClass, is_moving: bool) -> Option<usize> {
    match (class, is_moving) {
        (ActorClass::Vehicle, true) => Some(0),
        (ActorClass::Vehicle, false) => Some(1),
        (ActorClass::Pedestrian, true) => Some(2),
        (ActorClass::Pedestrian, false) => Some(3),
        (ActorClass::Bicycle, _) => Some(4),
        (ActorClass::Object, _) => None,
    }
}

/// A time of an episode as nuScenes has it.
pub(super) fn timestamp_us(time_us: i64) -> u64 {
    nanoseconds(time_us) / 1000
}

/// Names of cameras as nuScenes has them, such as `CAM_FRONT_LEFT`, each once.
pub(super) fn channels<'a>(names: impl Iterator<Item = &'a str>) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for name in names {
        let allowed =
            |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
        let channel = format!("CAM_{}", name.chars().map(allowed).collect::<String>());
        let is_new = !found.contains(&channel);
        let channel = if is_new { channel } else { format!("{channel}_{}", found.len()) };
        found.push(channel);
    }
    found
}

/// The hash FNV-1a of 64 bits.
fn fnv1a(bytes: impl Iterator<Item = u8>) -> u64 {
    bytes.fold(0xCBF2_9CE4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3)
    })
}
