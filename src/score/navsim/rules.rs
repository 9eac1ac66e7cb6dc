//! The rules of NAVSIM's `PDMScorer`, including their defects.

use glam::DVec2;

use wildcity_sim::contact::{CollisionType, FaultInput, Footprint, LanePosition};

use super::{Rules, STEP_S, Scene, is_agent};
use crate::record::{EgoSample, Track};

/// Samples of a second, plus one: the published window has 11 increments and not 10.
const DIRECTION_WINDOW: usize = 11;
/// Distances against the traffic in that window that cost half of the score and all of it, in
/// metres.
const DIRECTION_LIMITS_M: [f64; 2] = [2.0, 6.0];
/// Progress is not measured against a reference that is not longer than this, in metres.
const SHORT_REFERENCE_M: f64 = 5.0;
/// Samples ahead that are tested for the time to collision: 0, 0.3, 0.6 and 0.9 s.
const AHEAD: [usize; 4] = [0, 3, 6, 9];
/// A slower ego has no time to collision, in m/s.
const TTC_STANDING_MPS: f64 = 5e-3;
/// A track that is less than this off the heading is ahead, in radians.
const AHEAD_RAD: f64 = 30.0 * std::f64::consts::PI / 180.0;
/// Distance from the centre line that is not kept, in metres, and for how many samples in a row it
/// must last.
const LANE_KEEPING_M: f64 = 0.5;
const LANE_KEEPING_SAMPLES: usize = 20;

/// Applies the rules to 41 states.
pub fn rules(scene: &Scene<'_>) -> Rules {
    let boxes: Vec<Footprint> = scene.ego.iter().map(|ego| scene.shape.footprint(ego)).collect();
    let lanes: Vec<LanePosition> = boxes.iter().map(|ego| scene.map.position(ego)).collect();
    let collisions = collisions(scene, &boxes, &lanes);
    let ttc = time_to_collision(scene, &lanes);

    let off_road = lanes.iter().any(|lanes| lanes.off_drivable);
    let drivable = if off_road { 0.0 } else { 1.0 };
    let direction = direction(scene, &boxes);
    let red = boxes.iter().enumerate().any(|(sample, ego)| scene.map.touches_red(ego, sample));
    let lights = if red { 0.0 } else { 1.0 };
    // Progress counts only as far as all rules hold.
    let gate = collisions.score * drivable * direction * lights;
    Rules {
        no_at_fault_collisions: collisions.score,
        drivable_area_compliance: drivable,
        driving_direction_compliance: direction,
        traffic_light_compliance: lights,
        ego_progress: progress(scene, &boxes, gate),
        time_to_collision_within_bound: if ttc.is_some() { 0.0 } else { 1.0 },
        lane_keeping: lane_keeping(scene, &boxes),
        first_at_fault_step: collisions.first,
        first_ttc_step: ttc,
        collision_types: collisions.kinds,
    }
}

struct Collisions {
    score: f64,
    first: Option<usize>,
    kinds: Vec<Option<CollisionType>>,
}

/// NC. A track whose contact was judged not at fault is ignored from then on; one at fault is
/// judged again.
fn collisions(scene: &Scene<'_>, boxes: &[Footprint], lanes: &[LanePosition]) -> Collisions {
    let count = scene.tracks.len();
    let mut found = Collisions { score: 1.0, first: None, kinds: vec![None; count] };
    let mut ignored = vec![false; count];
    for (step, (ego, ego_box)) in scene.ego.iter().zip(boxes).enumerate() {
        for (k, track) in scene.tracks.iter().enumerate() {
            let Some(sample) = track.samples.get(step).copied().flatten() else { continue };
            if ignored[k] || !ego_box.touches(&sample.footprint) {
                continue;
            }
            let kind = CollisionType::classify(&FaultInput {
                ego: *ego_box,
                ego_origin_m: ego.origin_m,
                ego_velocity_mps: ego.world_velocity_mps(),
                other: sample.footprint,
                // As published: the speed of the track's first frame, whenever the contact is.
                other_velocity_mps: first_velocity_mps(track),
                other_is_agent: is_agent(track.class),
            });
            // The first kind stays, also if later contacts of the same track differ.
            found.kinds[k].get_or_insert(kind);
            if kind.is_at_fault_in(lanes[step]) {
                found.score = found.score.min(if is_agent(track.class) { 0.0 } else { 0.5 });
                found.first.get_or_insert(step);
            } else {
                ignored[k] = true;
            }
        }
    }
    found
}

fn first_velocity_mps(track: &Track) -> DVec2 {
    track.samples.iter().flatten().next().map_or(DVec2::ZERO, |sample| sample.velocity_mps)
}

/// DDC: the largest distance of the box's centre against the traffic within the window.
fn direction(scene: &Scene<'_>, boxes: &[Footprint]) -> f64 {
    let steps_m = |i: usize| match i {
        0 => 0.0,
        i => boxes[i].center_m.distance(boxes[i - 1].center_m),
    };
    let against_m: Vec<f64> = (0..boxes.len())
        .map(|i| if scene.map.is_off_route(boxes[i].center_m) { steps_m(i) } else { 0.0 })
        .collect();
    // `against_m` has the distances that were driven off the route, state by state.
    let most_m = (0..against_m.len())
        // A window of 11 increments that ends at i; shorter at the beginning.
        .map(|i| against_m[(i + 1).saturating_sub(DIRECTION_WINDOW)..=i].iter().sum())
        .fold(0.0, f64::max);
    let [half_m, all_m] = DIRECTION_LIMITS_M;
    match most_m {
        most_m if most_m < half_m => 1.0,
        most_m if most_m < all_m => 0.5,
        _ => 0.0,
    }
}

/// EP: progress along the centre line, divided by the larger of the reference's and the ego's own.
/// The ego's own counts only as far as the rules hold.
fn progress(scene: &Scene<'_>, boxes: &[Footprint], gate: f64) -> f64 {
    let station_m = |ego: &Footprint| scene.map.centerline.project(ego.center_m).station_m;
    let way_m = (station_m(&boxes[boxes.len() - 1]) - station_m(&boxes[0])).max(0.0);
    // Without rules broken, the ego's own way may exceed the reference's, and the quotient is at
    // most 1.
    let longest_m = scene.reference_progress_m.max(way_m * gate);
    if longest_m > SHORT_REFERENCE_M { (way_m / longest_m).clamp(0.0, 1.0) } else { 1.0 }
}

/// TTC: the first sample at which the ego, moved on at its speed, touches the future box of a
/// track. A track that is touched in another way is ignored from then on.
fn time_to_collision(scene: &Scene<'_>, lanes: &[LanePosition]) -> Option<usize> {
    let mut first = None;
    let mut ignored = vec![false; scene.tracks.len()];
    // States whose farthest look-ahead is still within the 4 s: 41 - 9 = 32.
    let last = scene.ego.len() - AHEAD[AHEAD.len() - 1];
    for (step, ego) in scene.ego.iter().enumerate().take(last) {
        let speed_mps = ego.speed_mps();
        if speed_mps < TTC_STANDING_MPS {
            continue;
        }
        // Near times first, so that the nearest contact decides whether a track is ignored.
        for ahead in AHEAD {
            let way_m = speed_mps * ahead as f64 * STEP_S * DVec2::from_angle(ego.yaw_rad);
            let moved = EgoSample { origin_m: ego.origin_m + way_m, ..*ego };
            let moved_box = scene.shape.footprint(&moved);
            for (k, track) in scene.tracks.iter().enumerate() {
                let then = track.samples.get(step + ahead).copied().flatten();
                let Some(then) = then else { continue };
                if ignored[k] || !moved_box.touches(&then.footprint) {
                    continue;
                }
                // As published: the future position of the track relative to the current position
                // of the ego. A car that closes in from behind may be ahead by then.
                let bearing_rad = bearing_rad(ego, then.footprint.center_m);
                let spread = lanes[step].in_multiple_lanes
                    || lanes[step].off_drivable
                    || scene.map.is_in_intersection(scene.shape.footprint(ego).center_m);
                let is_behind = bearing_rad > wildcity_sim::contact::BEHIND_RAD;
                if bearing_rad < AHEAD_RAD || (spread && !is_behind) {
                    first.get_or_insert(step);
                } else {
                    ignored[k] = true;
                }
            }
        }
    }
    first
}

/// The angle between the ego's heading and the line from its rear axle to a point, in [0, π].
fn bearing_rad(ego: &EgoSample, point_m: DVec2) -> f64 {
    let forward = DVec2::from_angle(ego.yaw_rad);
    let to_point = point_m - ego.origin_m;
    forward.perp_dot(to_point).atan2(forward.dot(to_point)).abs()
}

/// LK. Samples in intersections are skipped and do not end a run.
fn lane_keeping(scene: &Scene<'_>, boxes: &[Footprint]) -> f64 {
    let mut run = 0;
    for ego in boxes {
        if scene.map.is_in_intersection(ego.center_m) {
            continue;
        }
        let off_m = scene.map.centerline.project(ego.center_m).distance_m;
        run = if off_m > LANE_KEEPING_M { run + 1 } else { 0 };
        if run >= LANE_KEEPING_SAMPLES {
            return 0.0;
        }
    }
    1.0
}
