//! AlpaSim's scores of an agent's plans, including their defects.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/eval/src/eval/scorers/plan_deviation.py`, `minADE.py`,
//! `open_loop_collision.py`, and `src/wizard/configs/base_config.yaml` for the parameters.
//! Distances are between centres of the ego's box, without height. As in the scene score, the
//! episode is cut after a collision, or where the ego is off the road or 4 m off the recording.
//!
//! AlpaSim raises an error if it interpolates a plan beyond its end; here such times are left out.
//! Its minimum over sampled plans is the value of the one plan that an agent sends.

use glam::DVec2;

use wildcity_sim::contact::Footprint;

use super::alpasim_box::RoundedBox;
use super::plan::{Plan, PlannedPose, turn_rad};
use super::record::{DriveRecord, EgoSample, EgoShape, ReferenceDrive, Track};
use super::scored::{Measured, Missing, Score};

/// The names of the scores.
pub const NAMES: [&str; 6] = [
    "alpasim.plan_deviation@3032e0c",
    "alpasim.open_loop_collision@3032e0c",
    "alpasim.min_ade_0.5s@3032e0c",
    "alpasim.min_ade_1s@3032e0c",
    "alpasim.min_ade_2.5s@3032e0c",
    "alpasim.min_ade_5s@3032e0c",
];

/// Decay of the weights of later poses in the deviation of plans: exp(-0.1 k).
const DECAY: f64 = 0.1;
/// Time ahead for which plans are tested against the boxes of the others, in microseconds.
const HORIZON_US: i64 = 3_000_000;
/// Times ahead for which plans are compared with the recorded drive, in microseconds.
const TIME_DELTAS_US: [i64; 4] = [500_000, 1_000_000, 2_500_000, 5_000_000];

/// The mean of distances between successive plans, weighted by exp(-decay k); `None` without
/// distances.
pub fn plan_deviation(distances_m: &[f64], decay: f64) -> Option<f64> {
    // Earlier poses count most: the weight of pose k is e^(-0.1 k).
    let weight = |k: usize| (-decay * k as f64).exp();
    let sum: f64 =
        distances_m.iter().enumerate().map(|(k, distance_m)| weight(k) * distance_m).sum();
    let weights: f64 = (0..distances_m.len()).map(weight).sum();
    (weights > 0.0).then(|| sum / weights)
}

/// The scores of the plans, up to the time at which the episode is cut.
pub(crate) fn scores(record: &DriveRecord, cut_us: &Result<i64, Missing>) -> Vec<Score> {
    let input = Input::new(record, cut_us);
    // One missing input is the reason of all six scores.
    let measure = |measure: &dyn Fn(&Input<'_>) -> Measured| match &input {
        Ok(input) => measure(input),
        Err(missing) => Err(missing.clone()),
    };
    let decisions = input.as_ref().ok().map(|input| input.plans.len() as f64);
    let score = |name, value| Score::new(name, value, [("decisions", decisions)]);
    let [deviation, collision, ades @ ..] = NAMES;
    let mut scores = vec![
        score(deviation, measure(&|input| input.deviation())),
        score(collision, measure(&|input| input.collision())),
    ];
    for (name, delta_us) in ades.into_iter().zip(TIME_DELTAS_US) {
        scores.push(score(name, measure(&|input| input.ade(delta_us))));
    }
    scores
}

/// The input of the scores.
struct Input<'a> {
    record: &'a DriveRecord,
    shape: EgoShape,
    /// The plans that were decided before the cut.
    plans: Vec<&'a Plan>,
}

impl<'a> Input<'a> {
    fn new(record: &'a DriveRecord, cut_us: &Result<i64, Missing>) -> Result<Self, Missing> {
        let cut_us = cut_us.clone()?;
        let shape = record.shape.ok_or(Missing::new("needs the size of the ego"))?;
        let plans = record.plans.iter().filter(|plan| plan.decided_us() <= cut_us);
        let plans: Vec<&Plan> = plans.collect();
        if plans.is_empty() {
            return Err(Missing::new("needs a plan: the agent sent actions or poses"));
        }
        Ok(Self { record, shape, plans })
    }

    /// The centre of the ego's box at a pose.
    fn center_m(&self, pose: &PlannedPose) -> DVec2 {
        pose.origin_m + self.shape.center_x_m * DVec2::from_angle(pose.yaw_rad)
    }

    /// Mean distance between each plan and the previous one, at the times that both have.
    ///
    /// `min_timesteps` of AlpaSim's configuration is never read there: a single common time is
    /// enough.
    fn deviation(&self) -> Measured {
        // `future` leaves out the ego's own pose at the decision, which is no part of the plan.
        let of_pair = |pair: &[&Plan]| {
            let before = pair[0];
            let plan = pair[1];
            // Only times that both plans have: beyond its end the earlier one is not extrapolated.
            let common = plan.future().iter().filter(|pose| pose.time_us <= before.end_us());
            let distances_m = common.filter_map(|pose| {
                let expected = before.at(pose.time_us)?;
                Some(self.center_m(pose).distance(self.center_m(&expected)))
            });
            plan_deviation(&distances_m.collect::<Vec<_>>(), DECAY)
        };
        let found = mean(self.plans.windows(2).filter_map(of_pair));
        found.ok_or(Missing::new("needs two plans in succession that have times in common"))
    }

    /// Share of the decisions whose plan overlaps the box of an actor within 3 s, at the times of
    /// the plan's poses.
    fn collision(&self) -> Measured {
        let tracks = self.record.tracks.as_deref().unwrap_or_default();
        // `None` for a plan without a pose in the horizon: it is no decision that could collide.
        let of_plan = |plan: &&Plan| {
            let until_us = plan.decided_us() + HORIZON_US;
            let mut ahead = plan.future().iter().filter(|pose| pose.time_us <= until_us).peekable();
            ahead.peek()?;
            // The ego's box at the planned pose, against the others where they really were at that
            // time.
            let hits = |pose: &PlannedPose| {
                let ego = RoundedBox::new(&self.shape, &sample(pose));
                let boxes = tracks
                    .iter()
                    .filter_map(|track| box_at(track, pose.time_us, self.record.dt_us));
                boxes.into_iter().any(|other| ego.distance_m(&other) <= 0.0)
            };
            Some(f64::from(u8::from(ahead.any(hits))))
        };
        let found = mean(self.plans.iter().filter_map(of_plan));
        found.ok_or(Missing::new("needs plans with a pose in the next 3 s"))
    }

    /// Mean over the decisions of the mean distance between plan and recorded drive, at the steps
    /// up to a time ahead.
    fn ade(&self, delta_us: i64) -> Measured {
        let reference =
            self.record.reference.as_ref().ok_or(Missing::new("needs the recorded drive"))?;
        let found = mean(
            self.plans.iter().filter_map(|plan| self.average_error_m(plan, reference, delta_us)),
        );
        found.ok_or(Missing::new(format!(
            "needs plans, a recorded drive and an episode that reach {} s ahead",
            delta_us as f64 * 1e-6
        )))
    }

    /// The mean distance of one plan. The mean ends at the first step that is not before the time
    /// ahead. `None` if this step is later than the longest of [`TIME_DELTAS_US`], or than the end
    /// of the episode, of the plan or of the recorded drive.
    fn average_error_m(
        &self,
        plan: &Plan,
        reference: &ReferenceDrive,
        delta_us: i64,
    ) -> Option<f64> {
        let dt_us = self.record.dt_us;
        let now_us = plan.decided_us();
        // One horizon for all deltas: the longest, 5 s.
        let longest_us = now_us + TIME_DELTAS_US[TIME_DELTAS_US.len() - 1];
        let recorded_us = reference.times_us.last().copied()?;
        let end_us = longest_us.min(self.record.end_us()).min(recorded_us);
        // Rounded up to whole steps: the first step that is not before the time ahead.
        let steps = (delta_us + dt_us - 1) / dt_us;
        if now_us + steps * dt_us > end_us {
            return None;
        }
        // From 1: at the decision itself the distance is 0.
        let distances_m = (1..=steps).map(|step| {
            let time_us = now_us + step * dt_us;
            let planned_m = self.center_m(&plan.at(time_us)?);
            Some(planned_m.distance(self.center_m(&recorded_at(reference, time_us))))
        });
        mean(distances_m.collect::<Option<Vec<f64>>>()?.into_iter())
    }
}

/// The recorded drive at a time. Its heading is that of its line, which the rear axle follows.
fn recorded_at(reference: &ReferenceDrive, time_us: i64) -> PlannedPose {
    let station_m = reference.station_at_m(time_us);
    let (origin_m, along) = reference.line.at(station_m);
    PlannedPose { time_us, origin_m, yaw_rad: along.to_angle() }
}

/// The box of a track at a time, interpolated between its samples; `None` where it is absent.
fn box_at(track: &Track, time_us: i64, dt_us: i64) -> Option<Footprint> {
    // `div_euclid` rounds down, so that a time before 0 gives no sample and not sample 0.
    let before = usize::try_from(time_us.div_euclid(dt_us)).ok()?;
    let from = track.samples.get(before).copied().flatten()?.footprint;
    let t = time_us.rem_euclid(dt_us) as f64 / dt_us as f64;
    // On a sample the next one is not needed, and may be absent at the end of a track.
    if t == 0.0 {
        return Some(from);
    }
    let to = track.samples.get(before + 1).copied().flatten()?.footprint;
    let yaw_rad = from.forward.to_angle();
    let turned = yaw_rad + t * turn_rad(yaw_rad, to.forward.to_angle());
    // The size is that of the earlier sample: boxes of a track do not change.
    let center_m = from.center_m.lerp(to.center_m, t);
    Some(Footprint::new(center_m, turned, from.length_m, from.width_m))
}

fn sample(pose: &PlannedPose) -> EgoSample {
    EgoSample { origin_m: pose.origin_m, yaw_rad: pose.yaw_rad, ..EgoSample::default() }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0_u32, 0.0), |(count, sum), value| (count + 1, sum + value));
    (count > 0).then(|| sum / f64::from(count))
}
