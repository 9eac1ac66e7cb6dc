//! The effects of sensors on a recorded episode, decided and computed again.

use wildcity_options::LidarSensor;

use super::format::{EpisodeHeader, FrameRecord, FrameRequest, RecordedSettings};
use super::replay_report::ReplayError;
use crate::episode::Episode;
use crate::error::SessionError;
use crate::observe::encode::PixelMaps;
use crate::observe::layout::{EffectSeed, ObservationLayout};

/// The sensors of an episode that is replayed.
pub(super) struct SensorReplay {
    layout: ObservationLayout,
    effect_seed: EffectSeed,
}

impl SensorReplay {
    /// None if the session asked for no effects.
    ///
    /// # Errors
    /// The recorded settings are out of range.
    pub(super) fn new(header: &EpisodeHeader) -> Result<Option<Self>, ReplayError> {
        let recorded = header.settings.as_ref();
        let Some(RecordedSettings { schedule, sensors: Some(sensors), .. }) = recorded else {
            return Ok(None);
        };
        let wrong = |cause: SessionError| ReplayError::Sensors(Box::new(cause));
        let cameras = header.rig.cameras.clone();
        // As `open` does: the file may have been changed.
        schedule.check(cameras.len(), header.dt_us).map_err(wrong)?;
        // No maps: only the times and the effects of the layout are used here.
        let maps = PixelMaps::default();
        let mut layout =
            ObservationLayout::new(cameras, header.outputs.encoding, maps, schedule.clone())
                .map_err(wrong)?
                .with_lidars(header.rig.lidars.clone());
        layout.add_sensors(sensors.clone(), header.dt_us).map_err(wrong)?;
        let effect_seed = EffectSeed::from_episode(&header.first_state());
        Ok(Some(Self { layout, effect_seed }))
    }

    /// The effects on a LiDAR's sweeps, if it has any.
    pub(super) fn lidar_effects(&self, lidar: usize) -> Option<(&LidarSensor, EffectSeed)> {
        self.layout.lidar_sensor(lidar).map(|sensor| (sensor, self.effect_seed))
    }

    /// The first camera of a pose whose picture, by the settings, was taken at a time or place that
    /// differs from the recorded one, and the computed times, in microseconds.
    pub(super) fn wrong_delivery(
        &self,
        frame: &FrameRecord,
        pose: usize,
        selected: &[usize],
        episode: &Episode,
    ) -> Option<[String; 2]> {
        // `observe` shows the scene without effects.
        if frame.request == FrameRequest::Observe {
            return None;
        }
        let due_us = frame.due_us(pose);
        let recorded_us = frame.taken_us(pose);
        // The recorded pose has to be where the ego was when the picture was taken.
        let is_there = episode.pose_at(recorded_us) == frame.poses[pose];
        let mut with_effects =
            selected.iter().filter(|camera| self.layout.sensor(**camera).is_some());
        with_effects.find_map(|&camera| {
            let taken_us = self.layout.delivery(camera, self.effect_seed, due_us).taken_us;
            let name = &self.layout.cameras()[camera].name;
            let text = |time_us: i64, end: &str| {
                format!("{name}, due at {due_us} µs: taken at {time_us} µs{end}")
            };
            match (taken_us == recorded_us, is_there) {
                (true, true) => None,
                (false, _) => Some([text(recorded_us, ""), text(taken_us, "")]),
                (true, false) => Some([text(recorded_us, ", elsewhere"), text(taken_us, "")]),
            }
        })
    }

    /// Applies the effects on the pixels of a camera's image of a frame.
    pub(super) fn apply(&self, frame: &FrameRecord, pose: usize, camera: usize, rgb8: &mut [u8]) {
        if frame.request == FrameRequest::Observe {
            return;
        }
        let taken_us = frame.taken_us(pose);
        if let Some(effects) = self.layout.pixel_effects(camera, self.effect_seed, taken_us) {
            effects.apply(rgb8, self.layout.cameras()[camera].camera.width_px as usize);
        }
    }
}
