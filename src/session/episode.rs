//! One episode: where the ego is, when, and how it got there. Pure: no clock, no I/O.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::limits::{self, HISTORY_POSES, HISTORY_STEP_US};
use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_sim::{Command, Ego, Ground};

use crate::error::SessionError;

/// How far back the history reaches: 15 steps of 0.1 s before now.
const HISTORY_US: i64 = (HISTORY_POSES as i64 - 1) * HISTORY_STEP_US;

/// The state of an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    seed: u64,
    dt_us: i64,
    step: u64,
    distance_m: f64,
    ego: Ego,
    terminated: bool,
    /// World-from-rig by time in microseconds, rising; the last is now. Never empty, and no longer
    /// than the history needs, or the frames before the first step.
    track: VecDeque<(i64, Pose)>,
    /// When what is known of it begins, in microseconds: 0, or the begin of its warm-up.
    begin_us: i64,
    /// Of the observations that said how far they may be believed, the least mean of one's images.
    least_trust: Option<f64>,
}

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The agent closed it, or ended it.
    Completed,
    /// The same, and on its way the images could not be believed: it left what was recorded
    /// (`limits::OFF_MODEL_TRUST`). Told only where observations say their trust.
    OffModel,
    /// The agent broke the protocol beyond repair.
    AgentError,
    /// The agent was silent for too long.
    AgentTimeout,
    /// The connection was lost and not resumed in time.
    AgentLost,
    /// The server failed, or was stopped.
    ServerError,
}

/// How an episode went.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeSummary {
    /// Why it ended.
    pub outcome: Outcome,
    /// Steps done.
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Distance driven, in metres: the sum of the straight lines between poses.
    pub distance_m: f64,
    /// Trust of the observation that is believed least, the mean of its images; absent where none was said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_trust: Option<f64>,
}

/// The ego's last 1.5 s at 10 Hz, oldest first, in the rig's frame now; the last is the identity.
#[derive(Clone, Debug, PartialEq)]
pub struct EgoHistory {
    /// Positions `[16, 3]`, in metres.
    pub xyz_m: [[f32; 3]; HISTORY_POSES],
    /// Rotation matrices `[16, 3, 3]`, row by row.
    pub rotation: [[[f32; 3]; 3]; HISTORY_POSES],
    /// How many, from the end, were driven, in the warm-up too; the earlier ones repeat the first.
    pub count: usize,
}

impl Episode {
    /// An episode of an ego at its start, at time zero. `dt_us` is above zero.
    pub fn new(seed: u64, ego: Ego, dt_us: i64) -> Self {
        Self::warmed_up(seed, ego, &[], dt_us)
    }

    /// The same behind a warm-up: where the rig was (`world_from_rig`) by time in microseconds, rising
    /// and below 0.
    pub(crate) fn warmed_up(seed: u64, ego: Ego, warm_up: &[(i64, Pose)], dt_us: i64) -> Self {
        let now = (0, ego.world_from_rig());
        let track: VecDeque<_> = warm_up.iter().copied().chain([now]).collect();
        let begin_us = track[0].0;
        Self {
            seed,
            dt_us,
            step: 0,
            distance_m: 0.0,
            ego,
            terminated: false,
            track,
            begin_us,
            least_trust: None,
        }
    }

    /// The episode after one more step. `self` stays as it is, so that a step whose rendering fails has
    /// not happened.
    ///
    /// # Errors
    /// [`SessionError::EpisodeOver`] after the last step, [`SessionError::Ego`] if the ego cannot do
    /// what it is told.
    pub fn stepped(
        &self,
        command: &Command,
        ground: &Ground<'_>,
        terminate: bool,
    ) -> Result<Self, SessionError> {
        if self.terminated {
            return Err(SessionError::EpisodeOver { steps: self.step });
        }
        let mut next = self.clone();
        next.ego = self.ego.stepped(command, self.dt_us, ground)?;
        let world_from_rig = next.ego.world_from_rig();
        let moved_m = world_from_rig.position_m - self.world_from_rig().position_m;
        let time_us = self.time_us() + self.dt_us;
        next.step += 1;
        next.distance_m += moved_m.length();
        next.terminated = terminate;
        next.track.push_back((time_us, world_from_rig));
        // One pose at or before the history's begin must stay, to interpolate from. The first step may
        // still draw frames of the warm-up.
        let reach_us = HISTORY_US.max(self.dt_us - self.begin_us);
        while next.track.len() > 2 && next.track[1].0 <= time_us - reach_us {
            next.track.pop_front();
        }
        Ok(next)
    }

    /// Some of a rig's cameras, by their indices, where the rig stands somewhere. If it `moves`, as the ego
    /// has just moved: so a rolling shutter sees from any place what it would see if the ego had come
    /// there as it came to where it is. At the start of an episode it stands, and in a warm-up.
    pub(crate) fn views(
        &self,
        (cameras, which): (&[RigCamera], &[usize]),
        world_from_rig: Pose,
        moves: bool,
    ) -> Vec<View> {
        let now = self.world_from_rig();
        let all = View::of_moving_rig(cameras, world_from_rig, &|age_us| {
            if !moves {
                return world_from_rig;
            }
            let then = self.at((self.time_us() - age_us).max(0));
            if world_from_rig == now { then } else { world_from_rig * (now.inverse() * then) }
        });
        which.iter().map(|&camera| all[camera]).collect()
    }

    /// Seed of the episode.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Steps done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Simulated time since the start, in microseconds.
    pub fn time_us(&self) -> i64 {
        self.track[self.track.len() - 1].0
    }

    /// Where the ego is.
    pub fn world_from_rig(&self) -> Pose {
        self.ego.world_from_rig()
    }

    /// When what is known of it begins, in microseconds: 0, or the begin of its warm-up.
    pub(crate) fn begin_us(&self) -> i64 {
        self.begin_us
    }

    /// How the ego stands and moves.
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// Whether it has ended.
    pub fn terminated(&self) -> bool {
        self.terminated
    }

    /// How it went so far. An episode that the agent ended stays completed, whatever came after.
    pub fn summary(&self, outcome: Outcome) -> EpisodeSummary {
        let outcome = match (self.terminated, outcome) {
            (true, _) | (_, Outcome::Completed) => match self.least_trust {
                Some(trust) if trust < limits::OFF_MODEL_TRUST => Outcome::OffModel,
                _ => Outcome::Completed,
            },
            (false, outcome) => outcome,
        };
        let (steps, time_us, distance_m) = (self.step, self.time_us(), self.distance_m);
        EpisodeSummary { outcome, steps, time_us, distance_m, least_trust: self.least_trust }
    }

    /// Remembers how far the images of an observation may be believed, 0 to 1 each; nothing if there are
    /// none.
    pub(crate) fn judged(&mut self, trusts: impl Iterator<Item = f64>) {
        let (sum, count) =
            trusts.fold((0.0, 0.0), |(sum, count), trust| (sum + trust, count + 1.0));
        if count > 0.0 {
            let mean = sum / count;
            self.least_trust = Some(self.least_trust.map_or(mean, |least: f64| least.min(mean)));
        }
    }

    /// What the ego remembers now.
    pub fn history(&self) -> EgoHistory {
        let rig_from_world = self.world_from_rig().inverse();
        let mut xyz_m = [[0.0; 3]; HISTORY_POSES];
        let mut rotation = [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]; HISTORY_POSES];
        // The last stays the identity: the product would be so only up to rounding.
        for k in 0..HISTORY_POSES - 1 {
            let age_us = (HISTORY_POSES - 1 - k) as i64 * HISTORY_STEP_US;
            let rig_from_past = rig_from_world * self.at(self.time_us() - age_us);
            xyz_m[k] = rig_from_past.position_m.as_vec3().to_array();
            rotation[k] = rig_from_past.rotation_matrix().transpose().as_mat3().to_cols_array_2d();
        }
        let steps_back = (self.time_us() - self.begin_us) / HISTORY_STEP_US;
        let count = usize::try_from(steps_back).unwrap_or(0).min(HISTORY_POSES - 1) + 1;
        EgoHistory { xyz_m, rotation, count }
    }

    /// `world_from_rig` at a time, between the poses of the track.
    pub(crate) fn at(&self, time_us: i64) -> Pose {
        let after = self.track.partition_point(|&(t, _)| t < time_us);
        let Some(&(after_us, to)) = self.track.get(after) else { return self.world_from_rig() };
        match after.checked_sub(1) {
            None => to,
            // Not even rounded.
            Some(_) if after_us == time_us => to,
            Some(before) => {
                let (before_us, from) = self.track[before];
                let t = (time_us - before_us) as f64 / (after_us - before_us) as f64;
                from.interpolate(&to, t)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use wildcity_scene::geometry::Camera;
    use wildcity_scene::geometry::camera::{Pinhole, Shutter, ShutterDirection};
    use wildcity_sim::Dynamics;

    fn at(x_m: f64, yaw_rad: f64) -> Pose {
        Pose { position_m: DVec3::new(x_m, 0.0, 0.0), rotation: DQuat::from_rotation_z(yaw_rad) }
    }

    fn begun(start: Pose, dt_us: i64) -> Episode {
        Episode::new(7, Ego::new(Dynamics::default(), start), dt_us)
    }

    fn moved(episode: &Episode, pose: Pose, terminate: bool) -> Result<Episode, SessionError> {
        episode.stepped(&Command::Pose(pose), &Ground::from_drives(&[]), terminate)
    }

    fn driven(steps: u32, dt_us: i64, metres_per_step: f64) -> Episode {
        (1..=steps).fold(begun(at(0.0, 0.0), dt_us), |episode, i| {
            moved(&episode, at(f64::from(i) * metres_per_step, 0.0), false).unwrap()
        })
    }

    #[test]
    fn the_history_is_empty_at_the_start_and_full_after_fifteen_steps() {
        assert_eq!(driven(0, 100_000, 1.0).history().count, 1);
        assert_eq!(driven(0, 100_000, 1.0).history().xyz_m, [[0.0; 3]; HISTORY_POSES]);
        let two = driven(2, 100_000, 1.0).history();
        assert_eq!(two.count, 3);
        assert_eq!(two.xyz_m.map(|p| p[0])[11..], [-2.0, -2.0, -2.0, -1.0, 0.0]);
        let full = driven(40, 100_000, 1.0).history();
        assert_eq!(full.count, HISTORY_POSES);
        assert_eq!(full.xyz_m.map(|p| p[0]), std::array::from_fn(|k| k as f32 - 15.0));
    }

    #[test]
    fn the_history_is_in_the_frame_of_the_rig_now() {
        // A quarter turn to the left on the spot, then one metre forward, which is +y.
        let quarter = std::f64::consts::FRAC_PI_2;
        let turned = moved(&begun(at(0.0, 0.0), 100_000), at(0.0, quarter), false).unwrap();
        let forward = Pose { position_m: DVec3::Y, ..at(0.0, quarter) };
        let EgoHistory { xyz_m, rotation, .. } = moved(&turned, forward, false).unwrap().history();
        assert_eq!(xyz_m[15], [0.0; 3]);
        assert!((xyz_m[14][0] + 1.0).abs() < 1e-6, "one metre behind: {:?}", xyz_m[14]);
        // Two steps ago the rig looked along what is now to its right: row 1 (left) of x is -1.
        assert!((rotation[13][1][0] + 1.0).abs() < 1e-6, "{:?}", rotation[13]);
        assert_eq!(rotation[15], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    }

    #[test]
    fn other_rates_are_interpolated_and_the_track_stays_short() {
        // 30 ms steps of 0.3 m: 0.1 s ago is 1 m back whatever the rate.
        let episode = driven(1000, 30_000, 0.3);
        assert!(episode.track.len() <= 53, "{}", episode.track.len());
        for (k, xyz_m) in episode.history().xyz_m.iter().enumerate() {
            assert!((f64::from(xyz_m[0]) - (k as f64 - 15.0)).abs() < 1e-4, "{k}: {xyz_m:?}");
        }
        let slow = driven(3, 2_000_000, 20.0);
        assert!((slow.history().xyz_m[0][0] + 15.0).abs() < 1e-4, "{:?}", slow.history().xyz_m[0]);
    }

    #[test]
    fn rolling_shutters_see_from_where_the_ego_was() {
        let views = |episode: &Episode, camera: &RigCamera, x_m: f64| {
            episode.views((std::slice::from_ref(camera), &[0]), at(x_m, 0.0), true)
        };
        let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 4.0, cy: 3.0 };
        let mut camera = RigCamera::new("front", Camera::from_pinhole(8, 6, pinhole), at(1.5, 0.2));
        let still = begun(at(0.0, 0.0), 100_000);
        let driven = driven(3, 100_000, 3.0);
        assert_eq!(views(&driven, &camera, 9.0)[0].rolling_shutter, None, "global");
        camera.shutter =
            Some(Shutter { direction: ShutterDirection::TopToBottom, duration_us: 30_000 });
        assert_eq!(views(&still, &camera, 0.0)[0].rolling_shutter, None, "it stands");
        // 30 ms at 30 m/s are 0.9 m; from another place as from its own.
        for (x_m, first_m) in [(9.0, 9.6), (20.0, 20.6)] {
            let view = views(&driven, &camera, x_m)[0];
            assert!((view.world_from_camera.position_m.x - x_m - 1.5).abs() < 1e-9);
            let first = view.rolling_shutter.unwrap().world_from_camera_first;
            assert!((first.position_m.x - first_m).abs() < 1e-9, "{first:?}");
        }
        let stopped = moved(&driven, at(9.0, 0.0), false).unwrap();
        assert_eq!(views(&stopped, &camera, 9.0)[0].rolling_shutter, None, "it stands again");
    }

    #[test]
    fn the_history_reaches_into_the_warm_up() {
        // Ten metres a second for half a second, and on from there.
        let warm_up: Vec<_> = (-5..0).map(|k| (k * 100_000, at(k as f64, 0.0))).collect();
        let ego = Ego::new(Dynamics::default(), at(0.0, 0.0));
        let start = Episode::warmed_up(1, ego, &warm_up, 100_000);
        assert_eq!((start.step(), start.time_us(), start.history().count), (0, 0, 6));
        let xs_m = |episode: &Episode| episode.history().xyz_m.map(|p| p[0]);
        assert_eq!(xs_m(&start)[8..], [-5.0, -5.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0]);
        let next = moved(&start, at(1.0, 0.0), false).unwrap();
        assert_eq!(xs_m(&next)[8..], [-6.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0]);
        assert_eq!((next.history().count, next.summary(Outcome::Completed).distance_m), (7, 1.0));
        assert_eq!(next.at(-500_000), at(-5.0, 0.0), "still there for the first step's frames");
    }

    #[test]
    fn velocity_distance_and_the_end() {
        let episode = driven(3, 50_000, 0.5);
        assert!((episode.ego().velocity_m_s() - DVec3::X * 10.0).length() < 1e-12);
        let over = moved(&episode, at(1.5, 0.0), true).unwrap();
        let summary = over.summary(Outcome::AgentLost);
        let expected = EpisodeSummary {
            outcome: Outcome::Completed,
            steps: 4,
            time_us: 200_000,
            distance_m: 1.5,
            least_trust: None,
        };
        assert_eq!(summary, expected);
        let refused = moved(&over, at(2.0, 0.0), false);
        assert!(matches!(refused, Err(SessionError::EpisodeOver { steps: 4 })));
    }
}
