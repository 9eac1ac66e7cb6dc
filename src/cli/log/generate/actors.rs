//! The moving objects of a generated log: a car ahead, an oncoming van and a pedestrian.

use std::f64::consts::PI;
use std::sync::Arc;

use glam::{DQuat, DVec3};

use wildcity_generate::actor_models;
use wildcity_log::TrackRow;
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::Pose;
use wildcity_scene::route::Route;
use wildcity_scene::{ActorBox, ActorClass, Chunk, Scene};

/// How an object moves along the drive.
struct Motion {
    /// Name of its model, and its id in the log.
    model: &'static str,
    /// Where it is at the beginning, along the drive, in metres.
    station_m: f64,
    /// To the left of the drive, in metres.
    left_m: f64,
    /// Along the drive, in m/s; negative towards its start.
    speed_m_per_s: f64,
}

/// Lanes of the generated streets are 3.5 m apart, and their pavements begin 4 m beside a lane.
const MOTIONS: [Motion; 3] = [
    Motion { model: "sedan", station_m: 14.0, left_m: 0.0, speed_m_per_s: 9.0 },
    Motion { model: "van", station_m: 70.0, left_m: 3.5, speed_m_per_s: -8.0 },
    Motion { model: "pedestrian", station_m: 25.0, left_m: -5.0, speed_m_per_s: 1.4 },
];

/// An object with its Gaussians.
pub(super) struct MovingActor {
    motion: &'static Motion,
    class: ActorClass,
    box_: ActorBox,
    chunk: Arc<Chunk>,
}

/// The objects of a log.
pub(super) fn models() -> Vec<MovingActor> {
    let models = actor_models();
    let moving = MOTIONS.iter().filter_map(|motion| {
        let model = models.iter().find(|model| model.name == motion.model)?;
        let chunk = Arc::new(Scene::single_chunk(&model.gaussians));
        Some(MovingActor { motion, class: model.class, box_: model.box_, chunk })
    });
    moving.collect()
}

impl MovingActor {
    /// Its pose on the ground at a time since the start of the drive, in seconds; `None` where it
    /// has left the drive.
    fn pose_at(&self, route: &Route<'_>, time_s: f64) -> Option<Pose> {
        let Motion { station_m, left_m, speed_m_per_s, .. } = *self.motion;
        let at_m = station_m + speed_m_per_s * time_s;
        if !(0.0..=route.length_m()).contains(&at_m) {
            return None;
        }
        // A negative speed is that of oncoming traffic, which faces the other way and does not
        // reverse.
        let heading_rad = if speed_m_per_s < 0.0 { PI } else { 0.0 };
        let drive_from_actor =
            Pose { position_m: left_m * DVec3::Y, rotation: DQuat::from_rotation_z(heading_rad) };
        Some(route.at(at_m).world_from_rig * drive_from_actor)
    }

    /// Its Gaussians at a time.
    pub(super) fn placed(&self, route: &Route<'_>, time_s: f64, actor: u16) -> Option<PlacedChunk> {
        let pose = self.pose_at(route, time_s)?;
        Some(PlacedChunk::at_rest(self.chunk.clone(), pose, actor))
    }

    /// Its box at a time.
    pub(super) fn row(&self, route: &Route<'_>, time_us: i64, time_s: f64) -> Option<TrackRow> {
        let pose = self.pose_at(route, time_s)?;
        let ActorBox { length_m, width_m, height_m } = self.box_;
        // The origin of an actor is on the ground, that of a track in the middle of its box.
        let middle = Pose { position_m: 0.5 * height_m * DVec3::Z, ..Pose::IDENTITY };
        // Along the heading, which has been turned already: so without the sign.
        let velocity = self.motion.speed_m_per_s.abs() * (pose.rotation * DVec3::X);
        Some(TrackRow {
            time_us,
            track: self.motion.model.to_owned(),
            class: self.class,
            size: [length_m, width_m, height_m],
            world_from_box: pose * middle,
            velocity: Some(velocity.to_array()),
        })
    }
}
