//! One episode: the ego's pose, the simulated time, and the past poses. Pure: no clock, no I/O.
//!
//! An [`Episode`] is a plain value: a copy of it, or one that was written as JSON and read again,
//! continues exactly as the original does. A step returns a new [`Episode`] and leaves the old one
//! as it is. The session renders and records the new one before it replaces the old, so that a step
//! which fails on the way changes nothing.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use wildcity_render::View;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::trajectory::Keyframe;
use wildcity_sim::scenario::EndReason;
use wildcity_sim::{Command, Ego, Ground};

use crate::error::SessionError;
use crate::limits::{self, HISTORY_POSES, HISTORY_STEP_US};
use crate::repair::status::RepairState;
use crate::sensors::EpisodeSensors;
use crate::sensors::motion::MotionSample;

/// How far back the history reaches: 15 steps of 0.1 s before now.
const HISTORY_US: i64 = (HISTORY_POSES as i64 - 1) * HISTORY_STEP_US;

/// The state of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Episode {
    seed: u64,
    dt_us: i64,
    step: u64,
    distance_m: f64,
    ego: Ego,
    terminated: bool,
    /// Past poses by rising time since the episode's start; the last is now. Never empty. Reaches
    /// as far back as the history, or as the frames of the warm-up before the first step.
    track: VecDeque<Keyframe>,
    /// Where the track began, in microseconds: 0, or the start of the warm-up, which is below 0.
    begin_us: i64,
    /// The least mean trust of an observation, of those that came with a trust.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    least_trust: Option<f64>,
    /// Whether the ego has left the area that the twin was trained on.
    #[serde(default, skip_serializing_if = "is_false")]
    off_model: bool,
    /// Whether a rule ended it because the ego failed.
    #[serde(default, skip_serializing_if = "is_false")]
    failed: bool,
    /// By camera, whether its images are being repaired; empty if none is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    repairing: Vec<bool>,
    /// For each camera, the recorded image that its repair model compares with; empty if there is
    /// none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    references: Vec<Option<String>>,
    /// State of its sensors, if the session has sensor effects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sensors: Option<Box<EpisodeSensors>>,
}

fn is_false(value: &bool) -> bool {
    !value
}

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The agent closed the session or terminated the episode.
    Completed,
    /// As `Completed`, but the ego left the recorded area: the trust of a pose, or the mean trust
    /// of an observation that has one, was below [`limits::OFF_MODEL_TRUST`].
    OffModel,
    /// A rule ended the episode: a contact, off the route, or stuck.
    DrivingFailure,
    /// The agent broke the protocol, and the connection was closed.
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
    pub outcome: Outcome,
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Distance driven, in metres: the sum of the straight lines between poses.
    pub distance_m: f64,
    /// The least mean trust of an observation's images, 0 to 1; absent if no observation had a
    /// trust.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_trust: Option<f64>,
}

/// The ego's last 1.5 s at 10 Hz, oldest first, in the rig's frame now; the last pose is the
/// identity.
#[derive(Clone, Debug, PartialEq)]
pub struct EgoHistory {
    /// Positions `[16, 3]`, in metres.
    pub xyz_m: [[f32; 3]; HISTORY_POSES],
    /// Rotation matrices `[16, 3, 3]`, row by row.
    pub rotation: [[[f32; 3]; 3]; HISTORY_POSES],
    /// How many poses, counted from the end, were driven, warm-up included. The earlier ones repeat
    /// the first driven pose.
    pub count: usize,
}

impl Episode {
    /// An episode with the ego at its start, at time zero. `dt_us` is above zero.
    pub fn new(seed: u64, ego: Ego, dt_us: i64) -> Self {
        Self::with_warm_up(seed, ego, &[], dt_us)
    }

    /// An episode with a warm-up before the start: past poses at rising times below 0.
    pub(crate) fn with_warm_up(seed: u64, ego: Ego, warm_up: &[Keyframe], dt_us: i64) -> Self {
        let start = Keyframe { time_us: 0, world_from_rig: ego.world_from_rig() };
        let track: VecDeque<Keyframe> = warm_up.iter().copied().chain([start]).collect();
        // It has the start at least.
        let begin_us = track[0].time_us;
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
            off_model: false,
            failed: false,
            repairing: Vec::new(),
            references: Vec::new(),
            sensors: None,
        }
    }

    /// Adds sensor effects to an episode at its start.
    #[must_use]
    pub(crate) fn with_sensors(mut self, sensors: Option<EpisodeSensors>) -> Self {
        self.sensors = sensors.map(Box::new);
        if let Some(motion) = self.sensors.as_mut().and_then(|sensors| sensors.motion.as_mut()) {
            // At the start there is one sample, of an ego that stands: from the start to itself.
            motion.push(MotionSample::new(&self.ego, &self.ego, self.dt_us, 0));
        }
        self
    }

    /// The episode after one more step.
    ///
    /// # Errors
    /// [`SessionError::EpisodeOver`] after the last step, [`SessionError::Ego`] if the ego cannot
    /// execute the command.
    pub fn stepped(
        &self,
        command: &Command,
        ground: &Ground<'_>,
        terminate: bool,
    ) -> Result<Self, SessionError> {
        Ok(self.followed(command, 1, ground, terminate)?.0)
    }

    /// Returns the episode after one or more steps along a plan, which is one command for all
    /// steps, and the ego after each step.
    ///
    /// # Errors
    /// As [`Episode::stepped`].
    pub fn followed(
        &self,
        command: &Command,
        steps: usize,
        ground: &Ground<'_>,
        terminate: bool,
    ) -> Result<(Self, Vec<Ego>), SessionError> {
        if self.terminated {
            return Err(SessionError::EpisodeOver { steps: self.step });
        }
        let mut next = self.clone();
        let egos = next.follow_decisions(command, steps, ground)?;
        if let Some(motion) = next.sensors.as_mut().and_then(|sensors| sensors.motion.as_mut()) {
            // An observation has the samples since the one before it, and a plan is observed at its
            // end.
            motion.clear();
            let mut from = &self.ego;
            for (to, index) in egos.iter().zip(1..) {
                let time_us = self.time_us() + index * self.dt_us;
                motion.push(MotionSample::new(from, to, self.dt_us, time_us));
                from = to;
            }
        }
        // From here on `next` advances; the samples above begin at the state of `self`.
        for ego in &egos {
            let world_from_rig = ego.world_from_rig();
            let moved_m = world_from_rig.position_m - next.world_from_rig().position_m;
            let time_us = next.time_us() + self.dt_us;
            next.step += 1;
            next.distance_m += moved_m.length();
            next.track.push_back(Keyframe { time_us, world_from_rig });
            next.ego = ego.clone();
        }
        next.terminated = terminate;
        // For every step of the plan, keep one pose at or before the first one of the history, to
        // interpolate from: frames of all times since the start of the plan are rendered at its
        // end. The first plan may still render frames of the warm-up, so it keeps all of that.
        let time_us = next.time_us();
        let plan_us = time_us - self.time_us();
        // The earliest frame of the plan is one step after its start, at `time_us` - `plan_us` +
        // `dt_us`, and the history reaches `HISTORY_US` back from there.
        let reach_us =
            next.reach_us() + (HISTORY_US + plan_us - self.dt_us).max(plan_us - self.begin_us);
        // If the second pose is early enough to interpolate from, then the first one is not needed.
        while next.track.len() > 2 && next.track[1].time_us <= time_us - reach_us {
            next.track.pop_front();
        }
        Ok((next, egos))
    }

    /// The ego after each of some steps, along the decision that is in effect at that step. With a
    /// planner latency this is an earlier decision than the present one.
    fn follow_decisions(
        &mut self,
        command: &Command,
        steps: usize,
        ground: &Ground<'_>,
    ) -> Result<Vec<Ego>, SessionError> {
        let times_us = [self.time_us(), self.dt_us];
        let delayed = self.sensors.as_mut().map(|sensors| &mut sensors.decisions);
        Ok(match delayed.filter(|decisions| !decisions.are_immediate()) {
            Some(decisions) => decisions.follow(command, &self.ego, times_us, steps, ground)?,
            None => self.ego.followed(command, self.dt_us, steps, ground)?,
        })
    }

    /// Whether its decisions take effect later.
    pub(crate) fn is_delayed(&self) -> bool {
        self.sensors.as_ref().is_some_and(|sensors| !sensors.decisions.are_immediate())
    }

    /// How much farther than the history the track reaches back, in microseconds.
    pub(crate) fn reach_us(&self) -> i64 {
        self.sensors.as_ref().map_or(0, |sensors| sensors.reach_us)
    }

    /// The motion of each step since the last observation; empty unless it is measured.
    pub(crate) fn motion(&self) -> &[MotionSample] {
        let sensors = self.sensors.as_ref();
        sensors.and_then(|sensors| sensors.motion.as_deref()).unwrap_or_default()
    }

    /// The views of some cameras of a rig, selected by their indices, from a pose of the rig.
    ///
    /// Cameras with a rolling shutter move during the exposure: the ego's motion up to the time
    /// `taken_us` is transferred to that pose. In a warm-up (`taken_us` below 0) and at the start
    /// of an episode, the rig stands still during the exposure.
    pub(crate) fn views(
        &self,
        cameras: &[RigCamera],
        selected: &[usize],
        world_from_rig: Pose,
        taken_us: i64,
    ) -> Vec<View> {
        let now = self.pose_at(taken_us);
        let all = View::from_moving_rig(cameras, world_from_rig, &|age_us| {
            if taken_us < 0 {
                return world_from_rig;
            }
            let then = self.pose_at((taken_us - age_us).max(0));
            // At the ego's own pose without a product, which would round.
            if world_from_rig == now { then } else { world_from_rig * (now.inverse() * then) }
        });
        selected.iter().map(|&camera| all[camera]).collect()
    }

    /// Checks a state that was read from a file. Returns what is wrong with it, if anything.
    pub(crate) fn check(&self) -> Result<(), &'static str> {
        let rising = self.track.iter().is_sorted_by(|a, b| a.time_us < b.time_us);
        match self.track.back() {
            None => Err("a state without a pose"),
            Some(_) if !rising => Err("a state whose times do not rise"),
            Some(_) if self.dt_us <= 0 => Err("a state whose steps take no time"),
            Some(now) if now.world_from_rig != self.world_from_rig() => {
                Err("a state whose last pose is not the ego's")
            }
            Some(_) if self.sensors.as_ref().is_some_and(|sensors| !sensors.is_in_range()) => {
                Err("a state whose sensors are out of range")
            }
            Some(_) => Ok(()),
        }
    }

    /// The poses before its start, if the track still has them.
    pub(crate) fn warm_up(&self) -> Vec<Keyframe> {
        // Only before the first step is the warm-up complete.
        let before = self.track.iter().filter(|key| self.step == 0 && key.time_us < 0);
        before.copied().collect()
    }

    /// Whether it contains only its start: no step was made, there is no warm-up before the start,
    /// and no sensor has effects.
    pub(crate) fn is_start_alone(&self) -> bool {
        self.step == 0 && self.begin_us == 0 && self.sensors.is_none()
    }

    /// Seed of the episode.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// How many steps the ego has made.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Simulated time since the start, in microseconds.
    pub fn time_us(&self) -> i64 {
        self.track[self.track.len() - 1].time_us
    }

    /// Where the ego is.
    pub fn world_from_rig(&self) -> Pose {
        self.ego.world_from_rig()
    }

    /// Where the track began, in microseconds: 0, or the start of the warm-up, which is below 0.
    pub(crate) fn begin_us(&self) -> i64 {
        self.begin_us
    }

    /// Pose, velocity and the rest of the ego's state.
    pub fn ego(&self) -> &Ego {
        &self.ego
    }

    /// Whether the agent has ended it.
    pub fn terminated(&self) -> bool {
        self.terminated
    }

    /// The summary so far. An episode that its agent terminated counts as completed, even if
    /// `outcome` says that the connection failed afterwards.
    pub fn summary(&self, outcome: Outcome) -> EpisodeSummary {
        self.summary_with(outcome, self.least_trust)
    }

    /// The summary of an episode whose images had another least trust: that of a record, for a
    /// replay.
    pub(crate) fn summary_with(
        &self,
        outcome: Outcome,
        least_trust: Option<f64>,
    ) -> EpisodeSummary {
        let completed = self.terminated
            || matches!(outcome, Outcome::Completed | Outcome::OffModel | Outcome::DrivingFailure);
        // A replay does not evaluate the rules of the scenario. It takes the outcome from the
        // record.
        let failed = self.failed || outcome == Outcome::DrivingFailure;
        // An ego that fails first has not left the area, whatever its images show afterwards.
        let has_low_trust = least_trust.is_some_and(|trust| trust < limits::OFF_MODEL_TRUST);
        let off_model = self.off_model || (has_low_trust && !failed);
        let outcome = match (completed, off_model, failed) {
            (true, true, _) => Outcome::OffModel,
            (true, false, true) => Outcome::DrivingFailure,
            (true, false, false) => Outcome::Completed,
            (false, ..) => outcome,
        };
        EpisodeSummary {
            outcome,
            steps: self.step,
            time_us: self.time_us(),
            distance_m: self.distance_m,
            least_trust,
        }
    }

    /// Whether a rule ended it because the ego failed.
    pub(crate) fn is_failed(&self) -> bool {
        self.failed
    }

    /// Whether the ego has left the area that the twin was trained on.
    pub(crate) fn is_off_model(&self) -> bool {
        self.off_model
    }

    /// Notes that the ego has left the area that the twin was trained on.
    pub(crate) fn leave_model(&mut self) {
        self.off_model = true;
    }

    /// Ends the episode by a rule.
    pub(crate) fn end(&mut self, reason: EndReason) {
        self.terminated = true;
        self.failed = reason.is_failure();
    }

    /// Takes the trusts of an observation's images, 0 to 1 each, into account. Returns their mean;
    /// `None` if there are none.
    pub(crate) fn add_trusts(&mut self, trusts: impl Iterator<Item = f64>) -> Option<f64> {
        let mut sum = 0.0;
        let mut count = 0.0;
        for trust in trusts {
            sum += trust;
            count += 1.0;
        }
        // Without any trust, the least one stays as it was.
        let mean = (count > 0.0).then(|| sum / count)?;
        self.least_trust = Some(self.least_trust.map_or(mean, |least: f64| least.min(mean)));
        Some(mean)
    }

    /// State of the repair that continues from one observation to the next.
    pub(crate) fn repair_state(&self) -> RepairState {
        RepairState { is_on: self.repairing.clone(), references: self.references.clone() }
    }

    /// Stores the state of the repair after an observation; `None` changes nothing.
    pub(crate) fn set_repair_state(&mut self, state: Option<RepairState>) {
        let Some(RepairState { is_on, references }) = state else { return };
        // No camera and no list are the same: states are compared, and written into records.
        self.repairing = if is_on.contains(&true) { is_on } else { Vec::new() };
        let has_one = references.iter().any(Option::is_some);
        self.references = if has_one { references } else { Vec::new() };
    }

    /// The ego history now.
    pub fn history(&self) -> EgoHistory {
        let rig_from_world = self.world_from_rig().inverse();
        let mut xyz_m = [[0.0; 3]; HISTORY_POSES];
        let mut rotation = [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]; HISTORY_POSES];
        // The last pose stays the exact identity; `rig_from_world * world_from_rig` would be
        // rounded.
        for k in 0..HISTORY_POSES - 1 {
            let age_us = (HISTORY_POSES - 1 - k) as i64 * HISTORY_STEP_US;
            let rig_from_past = rig_from_world * self.pose_at(self.time_us() - age_us);
            xyz_m[k] = rig_from_past.position_m.as_vec3().to_array();
            // Transposed, since glam's arrays go column by column.
            rotation[k] = rig_from_past.rotation_matrix().transpose().as_mat3().to_cols_array_2d();
        }
        // Whole steps of the history since the track began; a pose between two of them counts as
        // not driven.
        let steps_back = (self.time_us() - self.begin_us) / HISTORY_STEP_US;
        let count = usize::try_from(steps_back).unwrap_or(0).min(HISTORY_POSES - 1) + 1;
        EgoHistory { xyz_m, rotation, count }
    }

    /// `world_from_rig` at a time since the episode's start: interpolated, and constant beyond both
    /// ends of the track.
    pub(crate) fn pose_at(&self, time_us: i64) -> Pose {
        // All poses before `after` are earlier than the time.
        let after = self.track.partition_point(|key| key.time_us < time_us);
        let Some(to) = self.track.get(after) else { return self.world_from_rig() };
        match after.checked_sub(1) {
            None => to.world_from_rig,
            // Exact: interpolation could round.
            Some(_) if to.time_us == time_us => to.world_from_rig,
            Some(before) => {
                let from = &self.track[before];
                let t = (time_us - from.time_us) as f64 / (to.time_us - from.time_us) as f64;
                from.world_from_rig.interpolate(&to.world_from_rig, t)
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
        // 1.5 s are 50 steps, which have 51 poses. The others are the ones to interpolate from.
        assert!(episode.track.len() <= 53, "{}", episode.track.len());
        for (k, xyz_m) in episode.history().xyz_m.iter().enumerate() {
            assert!((f64::from(xyz_m[0]) - (k as f64 - 15.0)).abs() < 1e-4, "{k}: {xyz_m:?}");
        }
        // 20 m in 2 s: 1.5 s ago the ego was 15 m behind, in the middle of a step.
        let slow = driven(3, 2_000_000, 20.0);
        assert!((slow.history().xyz_m[0][0] + 15.0).abs() < 1e-4, "{:?}", slow.history().xyz_m[0]);
    }

    #[test]
    fn rolling_shutters_see_from_where_the_ego_was() {
        let views = |episode: &Episode, camera: &RigCamera, x_m: f64| {
            let now_us = episode.time_us();
            episode.views(std::slice::from_ref(camera), &[0], at(x_m, 0.0), now_us)
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
        // The camera is 1.5 m in front of the rig: its first line is taken at x + 1.5 - 0.9.
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
        let warm_up: Vec<_> = (-5..0)
            .map(|k| Keyframe { time_us: k * 100_000, world_from_rig: at(k as f64, 0.0) })
            .collect();
        let ego = Ego::new(Dynamics::default(), at(0.0, 0.0));
        let start = Episode::with_warm_up(1, ego, &warm_up, 100_000);
        // Five poses of the warm-up, and the start.
        assert_eq!((start.step(), start.time_us(), start.history().count), (0, 0, 6));
        let xs_m = |episode: &Episode| episode.history().xyz_m.map(|p| p[0]);
        // Before the warm-up, its first pose repeats.
        assert_eq!(xs_m(&start)[8..], [-5.0, -5.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0]);
        let next = moved(&start, at(1.0, 0.0), false).unwrap();
        assert_eq!(xs_m(&next)[8..], [-6.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0]);
        assert_eq!((next.history().count, next.summary(Outcome::Completed).distance_m), (7, 1.0));
        assert_eq!(next.pose_at(-500_000), at(-5.0, 0.0), "kept for the first step's frames");
    }

    #[test]
    fn velocity_distance_and_the_end() {
        let episode = driven(3, 50_000, 0.5);
        // 0.5 m in 50 ms.
        assert!((episode.ego().velocity_m_s() - DVec3::X * 10.0).length() < 1e-12);
        let over = moved(&episode, at(1.5, 0.0), true).unwrap();
        let summary = over.summary(Outcome::AgentLost);
        let expected = EpisodeSummary {
            outcome: Outcome::Completed,
            steps: 4,
            time_us: 200_000,
            // Three steps of 0.5 m, and a last one on the spot.
            distance_m: 1.5,
            least_trust: None,
        };
        assert_eq!(summary, expected);
        let refused = moved(&over, at(2.0, 0.0), false);
        assert!(matches!(refused, Err(SessionError::EpisodeOver { steps: 4 })));
    }
}
