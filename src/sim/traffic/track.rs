//! Recorded motion of an actor: timed poses.

use glam::DVec3;

use wildcity_scene::geometry::Pose;

use super::course::turned_rad;

/// A pose of an actor at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackKeyframe {
    /// Time since the episode's start, in microseconds.
    pub time_us: i64,
    /// Pose of its box in the world.
    pub world_from_actor: Pose,
}

/// Poses in order of time, interpolated between: positions linearly, rotations spherically.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// At least one, with strictly increasing times.
    keyframes: Vec<TrackKeyframe>,
    /// Whether the actor stands at its first pose before the first keyframe, and at its last pose
    /// after the last. Otherwise it is absent then.
    held: bool,
}

/// A place on a track.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tracked {
    /// Pose in the world.
    pub world_from_actor: Pose,
    /// Velocity along world axes, in m/s.
    pub velocity_mps: DVec3,
    /// Yaw rate, in rad/s.
    pub yaw_rate_radps: f64,
}

/// Why keyframes are no track.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum TrackError {
    /// There are no keyframes.
    #[error("there are no keyframes; give at least one")]
    Empty,
    /// Times do not increase strictly.
    #[error(
        "keyframes[{index}].time_us is {time_us}, not after the one before it ({before_us}): sort them, and \
         remove repeated ones"
    )]
    Time {
        /// Index of the keyframe.
        index: usize,
        /// Its time, in microseconds.
        time_us: i64,
        /// Time of the previous keyframe, in microseconds.
        before_us: i64,
    },
}

impl Track {
    /// A track that is absent before its first and after its last keyframe.
    ///
    /// # Errors
    /// There are no keyframes, or their times do not increase strictly.
    pub fn new(keyframes: Vec<TrackKeyframe>) -> Result<Self, TrackError> {
        if keyframes.is_empty() {
            return Err(TrackError::Empty);
        }
        for (before, pair) in keyframes.windows(2).enumerate() {
            if pair[1].time_us <= pair[0].time_us {
                return Err(TrackError::Time {
                    index: before + 1,
                    time_us: pair[1].time_us,
                    before_us: pair[0].time_us,
                });
            }
        }
        Ok(Self { keyframes, held: false })
    }

    /// An actor that stands at one pose at all times.
    pub fn standing(keyframe: TrackKeyframe) -> Self {
        Self { keyframes: vec![keyframe], held: true }
    }

    /// This track with an actor that stands before the first keyframe and after the last.
    pub fn held(self) -> Self {
        Self { held: true, ..self }
    }

    /// The keyframes, by rising time.
    pub fn keyframes(&self) -> &[TrackKeyframe] {
        &self.keyframes
    }

    /// Pose and motion at a time; `None` if the actor is absent then. At a keyframe the velocity is
    /// that of the motion after it, and at the last keyframe that of the motion before it.
    pub fn at(&self, time_us: i64) -> Option<Tracked> {
        let last = self.keyframes.len() - 1;
        let is_before = time_us < self.keyframes[0].time_us;
        let is_after = time_us > self.keyframes[last].time_us;
        // A single keyframe has no motion, so it is treated as an end.
        if is_before || is_after || last == 0 {
            let end = self.keyframes[if is_before { 0 } else { last }];
            let is_here = self.held || time_us == end.time_us;
            return is_here.then_some(Tracked {
                world_from_actor: end.world_from_actor,
                velocity_mps: DVec3::ZERO,
                yaw_rate_radps: 0.0,
            });
        }
        // At the last keyframe `partition_point` is past the end. The clamp makes it the end of the
        // last segment.
        let after = self.keyframes.partition_point(|key| key.time_us <= time_us).clamp(1, last);
        let from = &self.keyframes[after - 1];
        let to = &self.keyframes[after];
        // i128, since the difference of two i64 times may overflow i64.
        let span_us = (i128::from(to.time_us) - i128::from(from.time_us)) as f64;
        let since_us = (i128::from(time_us) - i128::from(from.time_us)) as f64;
        let way_m = to.world_from_actor.position_m - from.world_from_actor.position_m;
        let turn_rad = turned_rad(from.world_from_actor.rotation, to.world_from_actor.rotation);
        let pose = match since_us / span_us {
            // Exact: interpolation could round.
            0.0 => from.world_from_actor,
            1.0 => to.world_from_actor,
            t => from.world_from_actor.interpolate(&to.world_from_actor, t),
        };
        Some(Tracked {
            world_from_actor: pose,
            velocity_mps: way_m / (span_us * 1e-6),
            yaw_rate_radps: turn_rad / (span_us * 1e-6),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn key(time_us: i64, x_m: f64, yaw_rad: f64) -> TrackKeyframe {
        let rotation = DQuat::from_rotation_z(yaw_rad);
        let world_from_actor = Pose { position_m: x_m * DVec3::X, rotation };
        TrackKeyframe { time_us, world_from_actor }
    }

    #[test]
    fn it_is_there_from_its_first_to_its_last_keyframe() {
        let track = Track::new(vec![key(0, 0.0, 0.0), key(500_000, 5.0, 0.1)]).unwrap();
        assert_eq!(track.at(-1), None);
        assert_eq!(track.at(500_001), None);
        let middle = track.at(250_000).unwrap();
        // 5 m in 0.5 s: half of it in the middle, at 10 m/s.
        assert_eq!(middle.world_from_actor.position_m.x, 2.5);
        assert_eq!(middle.velocity_mps.x, 10.0);
        assert!((middle.yaw_rate_radps - 0.2).abs() < 1e-12);
        assert_eq!(track.at(500_000).unwrap().world_from_actor, key(0, 5.0, 0.1).world_from_actor);
        let held = track.held();
        assert_eq!(held.at(-1).unwrap().velocity_mps, DVec3::ZERO);
        assert_eq!(held.at(9_000_000).unwrap().world_from_actor.position_m.x, 5.0);
    }

    #[test]
    fn extreme_times_do_not_overflow() {
        let track = Track::new(vec![key(i64::MIN, 0.0, 0.0), key(i64::MAX, 2.0, 0.0)]).unwrap();
        assert!((track.at(0).unwrap().world_from_actor.position_m.x - 1.0).abs() < 1e-9);
        assert_eq!(Track::new(Vec::new()), Err(TrackError::Empty));
        let twice = Track::new(vec![key(1, 0.0, 0.0), key(1, 2.0, 0.0)]);
        assert!(matches!(twice, Err(TrackError::Time { index: 1, .. })));
    }
}
