//! HUGSIM's HD-Score, including its defects.
//!
//! Source: hyzhou404/HUGSIM 62c690d, `sim/utils/score_calculator.py`,
//! `sim/hugsim_env/envs/hug_sim.py`. Each decision is judged by its plan: poses 0.5 s apart, behind
//! the ego's own pose.

use glam::{DVec2, DVec3};

use wildcity_sim::contact::Footprint;

use super::navsim::bounds;
use super::record::DriveRecord;
use super::scored::{Missing, Score};

/// The name of the score.
pub const NAME: &str = "hugsim.hd@62c690d";

/// More Gaussians than this in the box are a collision.
const STATIC_POINTS: usize = 100;
/// Time between two poses of a plan, in seconds.
const STEP_S: f64 = 0.5;
/// A plan that ends nearer than this has no heading, in metres.
const SHORT_PLAN_M: f64 = 1.0;

/// A box: its footprint, and the heights from `bottom_m` to `bottom_m + height_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HugsimBox {
    pub footprint: Footprint,
    /// Its lower side, in metres.
    pub bottom_m: f64,
    /// Its height, in metres.
    pub height_m: f64,
}

/// A pose of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanPose {
    /// The position, in metres.
    pub position_m: DVec2,
    /// The heading, in radians.
    pub yaw_rad: f64,
}

/// The input by which one decision is judged.
#[derive(Clone, Copy, Debug)]
pub struct Decision<'a> {
    pub ego: HugsimBox,
    /// The ego's heading, in radians.
    pub yaw_rad: f64,
    /// Its plan at 0.5 s, 1 s ..
    pub plan: &'a [PlanPose],
    /// Boxes of the others now and at the times of the plan; the last ones stay.
    pub objects: &'a [Vec<Footprint>],
    /// Centres of the twin's Gaussians that are not ground, in metres.
    pub points_m: &'a [DVec3],
    /// Points of the ground, in metres.
    pub ground_m: &'a [DVec2],
}

/// The sub-scores of a decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecisionScore {
    /// No collisions of the plan.
    pub nc: f64,
    /// Ground under the plan.
    pub dac: f64,
    /// No collisions of the plan moved on by 0.5 and 1 s.
    pub ttc: f64,
    /// Comfort of the plan.
    pub c: f64,
}

impl DecisionScore {
    /// NC · DAC · (5 TTC + 2 C)/7.
    pub fn pdms(&self) -> f64 {
        self.nc * self.dac * (5.0 * self.ttc + 2.0 * self.c) / 7.0
    }
}

impl HugsimBox {
    /// Number of points strictly within the box, whose lower side is `bottom_m`.
    pub fn points_within(&self, points_m: &[DVec3]) -> usize {
        let Footprint { center_m, forward, length_m, width_m } = self.footprint;
        let is_within = |point: &&DVec3| {
            let from_center = point.truncate() - center_m;
            let above_m = point.z - self.bottom_m;
            from_center.dot(forward).abs() < 0.5 * length_m
                && from_center.dot(self.footprint.left()).abs() < 0.5 * width_m
                && 0.0 < above_m
                && above_m < self.height_m
        };
        points_m.iter().filter(is_within).count()
    }

    /// Whether the twin's Gaussians collide with the box: more than 100 within.
    pub fn hits_static(&self, points_m: &[DVec3]) -> bool {
        self.points_within(points_m) > STATIC_POINTS
    }

    fn at(&self, pose: &PlanPose) -> Self {
        let Footprint { length_m, width_m, .. } = self.footprint;
        let footprint = Footprint::new(pose.position_m, pose.yaw_rad, length_m, width_m);
        Self { footprint, ..*self }
    }
}

/// Judges one decision by HUGSIM's rules.
pub fn decision(decision: &Decision<'_>) -> DecisionScore {
    // The plan begins with the pose of the ego itself.
    let ego = PlanPose { position_m: decision.ego.footprint.center_m, yaw_rad: decision.yaw_rad };
    let mut plan: Vec<PlanPose> =
        std::iter::once(ego).chain(decision.plan.iter().copied()).collect();
    // A plan that hardly moves has headings from noise.
    if plan[plan.len() - 1].position_m.distance(ego.position_m) < SHORT_PLAN_M {
        for pose in &mut plan {
            pose.yaw_rad = ego.yaw_rad;
        }
    }
    let nc = if collides(decision, &plan) { 0.0 } else { 1.0 };
    let ttc =
        // Moved on by 0.5 s and by 1 s at the speed between its poses.
        if [0.5, 1.0].iter().any(|&s| collides(decision, &moved_on(&plan, s))) { 0.0 } else { 1.0 };
    let dac = drivable(decision.ground_m, &plan, &decision.ego.footprint);
    DecisionScore { nc, dac, ttc, c: comfort(&plan, &ego) }
}

fn collides(decision: &Decision<'_>, plan: &[PlanPose]) -> bool {
    plan.iter().enumerate().any(|(i, pose)| {
        let ego = decision.ego.at(pose);
        // Beyond the list, the last boxes stay: others are assumed to stop.
        let last = decision.objects.len().saturating_sub(1);
        let objects = decision.objects.get(i.min(last)).map_or(&[][..], Vec::as_slice);
        ego.hits_static(decision.points_m)
            || objects.iter().any(|object| ego.footprint.touches(object))
    })
}

/// The plan moved on at the speed between its poses; the first one has that of the second.
fn moved_on(plan: &[PlanPose], ahead_s: f64) -> Vec<PlanPose> {
    let move_by = |i: usize| {
        // The speed of pose i is that from the pose before it. The first pose has none before it; a
        // plan of one pose does not move.
        let from = i.max(1).min(plan.len() - 1);
        let way_m = plan[from].position_m - plan[from.saturating_sub(1)].position_m;
        let position_m = plan[i].position_m + way_m / STEP_S * ahead_s;
        PlanPose { position_m, ..plan[i] }
    };
    (0..plan.len()).map(move_by).collect()
}

/// DAC: 0 where ground lies in fewer than 2 of the 2 x 2 cells of the box. The published 0.5, for a
/// share between 0.3 and 0.5, is never reached: shares are quarters.
pub fn drivable(ground_m: &[DVec2], plan: &[PlanPose], ego: &Footprint) -> f64 {
    for pose in plan {
        let forward = DVec2::from_angle(pose.yaw_rad);
        // Two by two cells: rear right, rear left, front right, front left.
        let mut cells = [false; 4];
        for point in ground_m {
            let from_center = *point - pose.position_m;
            let ahead_m = from_center.dot(forward);
            let aside_m = from_center.dot(forward.perp());
            for (cell, filled) in cells.iter_mut().enumerate() {
                // Each cell is half as long and half as wide as the box, open at its sides.
                let first_m = if cell < 2 { -0.5 * ego.length_m } else { 0.0 };
                let right_m = if cell % 2 == 0 { -0.5 * ego.width_m } else { 0.0 };
                let along = first_m < ahead_m && ahead_m < first_m + 0.5 * ego.length_m;
                let across = right_m < aside_m && aside_m < right_m + 0.5 * ego.width_m;
                *filled |= along && across;
            }
        }
        let share = 0.25 * cells.iter().filter(|&&filled| filled).count() as f64;
        // 0.25 or less: at most one of four cells has ground.
        if share < 0.3 {
            return 0.0;
        }
    }
    1.0
}

/// C: bounds of the speed's changes and of the heading; closed. The lateral acceleration is not
/// tested: as published it is always 0. A plan of fewer than 4 poses is comfortable.
fn comfort(plan: &[PlanPose], ego: &PlanPose) -> f64 {
    if plan.len() < 4 {
        return 1.0;
    }
    // In the axes of the ego at the decision, as the published code has it. Lengths and differences
    // do not depend on that.
    let to_ego = DVec2::from_angle(-ego.yaw_rad);
    let local: Vec<PlanPose> = plan
        .iter()
        .map(|pose| PlanPose {
            position_m: to_ego.rotate(pose.position_m - ego.position_m),
            yaw_rad: pose.yaw_rad - ego.yaw_rad,
        })
        .collect();
    let slopes = |values: &[f64]| -> Vec<f64> {
        values.windows(2).map(|pair| (pair[1] - pair[0]) / STEP_S).collect()
    };
    let speeds: Vec<f64> = local
        .windows(2)
        .map(|pair| ((pair[1].position_m - pair[0].position_m) / STEP_S).length())
        .collect();
    let turns: Vec<f64> = local
        .windows(2)
        .map(|pair| within_pi(pair[1].yaw_rad - pair[0].yaw_rad) / STEP_S)
        .collect();
    // Each derivative has one value fewer: 4 poses give 3 speeds, 2 accelerations and 1 jerk.
    let accelerations = slopes(&speeds);
    let [least, most] = bounds::LONGITUDINAL_MPS2;
    let even = |values: &[f64], most: f64| values.iter().all(|value| value.abs() <= most);
    let comfortable = accelerations.iter().all(|a| (least..=most).contains(a))
        && even(&slopes(&accelerations), bounds::JERK_MPS3)
        && even(&slopes(&turns), bounds::YAW_ACCELERATION_RADPS2)
        && even(&turns, bounds::YAW_RATE_RADPS);
    f64::from(u8::from(comfortable))
}

/// A difference of two headings, turned by 2π at most once each way.
fn within_pi(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    // Not a full wrap: a difference of more than 3π would stay beyond π, as published.
    let angle = if angle > PI { angle - TAU } else { angle };
    if angle < -PI { angle + TAU } else { angle }
}

/// Route completion: the index, from 1, of the nearest recorded camera, divided by 0.9 times the
/// number of cameras.
pub fn route_completion(nearest_camera: usize, cameras: usize) -> f64 {
    (nearest_camera + 1) as f64 / (0.9 * cameras as f64)
}

/// HD-Score: the mean over the decisions, times the largest route completion, which counts up to 1.
pub fn hd_score(pdms: &[f64], completions: &[f64]) -> f64 {
    let mean = pdms.iter().sum::<f64>() / pdms.len() as f64;
    mean * completions.iter().fold(0.0, |most: f64, &rc| most.max(rc)).min(1.0)
}

/// The score of an episode. It never has a value, because a record has no Gaussians and no plans
/// 0.5 s apart.
pub fn hd(_record: &DriveRecord) -> Score {
    let missing = "needs the twin's Gaussians, its ground, and a plan for each decision";
    Score::new(NAME, Err(Missing::new(missing)), [])
}
