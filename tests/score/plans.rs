//! AlpaSim's scores of plans and of the road, against values by hand. Each comment has the
//! derivation.

use std::f64::consts::PI;

use glam::DVec2;

use wildcity_scene::ActorClass;
use wildcity_score::{
    DriveRecord, EgoSample, EgoShape, Lane, LaneMap, NO_MAP, NO_REFERENCE, Plan, PlannedPose,
    Polyline, ReferenceDrive, Score, Track, TrackSample, score,
};
use wildcity_sim::contact::Footprint;

const DEVIATION: &str = "alpasim.plan_deviation@3032e0c";
const COLLISION: &str = "alpasim.open_loop_collision@3032e0c";
const ADES: [&str; 4] = [
    "alpasim.min_ade_0.5s@3032e0c",
    "alpasim.min_ade_1s@3032e0c",
    "alpasim.min_ade_2.5s@3032e0c",
    "alpasim.min_ade_5s@3032e0c",
];
const OFF_ROAD: &str = "alpasim.offroad@3032e0c";
const WRONG_LANE: &str = "alpasim.wrong_lane@3032e0c";

/// 4 m x 2 m, of which 0.98 are tested: half of it is 1.96 m x 0.98 m, 1 m before the rear axle.
const SHAPE: EgoShape = EgoShape { length_m: 4.0, width_m: 2.0, center_x_m: 1.0 };

/// A drive of 10 s along x at 10 m/s, as recorded, without others.
fn drive(dt_us: i64) -> DriveRecord {
    let sample = |step: i64| EgoSample {
        origin_m: DVec2::new(1e-5 * (step * dt_us) as f64, 0.0),
        velocity_mps: DVec2::new(10.0, 0.0),
        ..EgoSample::default()
    };
    let points_m = (0..=100).map(|k| DVec2::new(f64::from(k), 0.0)).collect();
    DriveRecord {
        dt_us,
        shape: Some(SHAPE),
        ego: (0..=10_000_000 / dt_us).map(sample).collect(),
        is_driven: true,
        tracks: Some(Vec::new()),
        plans: Vec::new(),
        contacts: Vec::new(),
        static_contacts: None,
        reference: Some(ReferenceDrive {
            line: Polyline::new(points_m).unwrap(),
            times_us: (0..=100).map(|k| 100_000 * k).collect(),
        }),
        no_reference: NO_REFERENCE,
        limit_us: Some(10_000_000),
        map: None,
        no_map: NO_MAP,
        least_progress: 0.8,
        off_model_us: None,
    }
}

/// A plan of poses at rising multiples of 0.1 s, the first one the ego's own.
fn plan(poses: &[(i64, [f64; 2], f64)]) -> Plan {
    let pose = |&(tenths, xy_m, yaw_rad): &(i64, [f64; 2], f64)| PlannedPose {
        time_us: 100_000 * tenths,
        origin_m: DVec2::from_array(xy_m),
        yaw_rad,
    };
    Plan::new(poses.iter().map(pose).collect()).unwrap()
}

/// A plan along x at a speed, from where a drive of 10 m/s is at its first time.
fn straight(from_tenths: i64, to_tenths: i64, speed_mps: f64) -> Plan {
    let at = |tenths: i64| {
        let x_m = from_tenths as f64 + 0.1 * speed_mps * (tenths - from_tenths) as f64;
        (tenths, [x_m, 0.0], 0.0)
    };
    plan(&(from_tenths..=to_tenths).map(at).collect::<Vec<_>>())
}

fn plan_score(record: &DriveRecord, name: &str) -> Score {
    let found = score(record).into_iter().find(|score| score.name == name);
    found.unwrap_or_else(|| panic!("no score {name}"))
}

fn assert_value(record: &DriveRecord, name: &str, expected: f64) {
    let found = plan_score(record, name);
    let near = found.value.is_some_and(|value| (value - expected).abs() < 1e-9);
    assert!(near, "{found:?}, not {expected}");
}

fn assert_none(record: &DriveRecord, name: &str, reason: &str) {
    let found = plan_score(record, name);
    assert_eq!(found.value, None, "{found:?}");
    assert!(found.reason.as_ref().is_some_and(|found| found.contains(reason)), "{found:?}");
}

#[test]
fn plans_deviate_by_the_decaying_mean_of_their_common_times() {
    let mut record = drive(100_000);
    // Common are 0.2, 0.3, 0.4 and 0.5 s: the own pose at 0.1 s is not planned, and the first plan
    // ends at 0.5 s. There they are 0, 0.2, 0.4 and 0.6 m apart, as in the vector: sum of exp(-0.1
    // k) d over sum of exp(-0.1 k).
    record.plans = vec![
        straight(0, 5, 10.0),
        plan(&[
            (1, [1.0, 0.0], 0.0),
            (2, [2.0, 0.0], 0.0),
            (3, [3.0, 0.2], 0.0),
            (4, [4.0, 0.4], 0.0),
            (5, [5.0, 0.6], 0.0),
            (6, [6.0, 9.0], 0.0),
        ]),
    ];
    assert_value(&record, DEVIATION, 0.275_070_563_579_220_9);
    // A third plan is 1 m behind the second at 0.6 s, beside it, and 9 m aside before: only that
    // time is common.
    record.plans.push(plan(&[(5, [5.0, 0.0], 0.0), (6, [5.0, 9.0], 0.0), (8, [7.0, 9.0], 0.0)]));
    assert_value(&record, DEVIATION, 0.5 * (0.275_070_563_579_220_9 + 1.0));
    record.plans = vec![straight(0, 5, 10.0), straight(5, 9, 10.0)];
    assert_none(&record, DEVIATION, "times in common");
}

#[test]
fn plans_deviate_at_the_centre_of_the_box_and_between_their_poses() {
    let mut record = drive(100_000);
    // The same rear axle at 0.2 s, a quarter turned: the centres are at (1, 0) and (0, 1) from it.
    // The first plan is halfway between its poses then, where it has x = 2 m and a heading of 0.
    record.plans = vec![
        plan(&[(0, [0.0, 0.0], 0.0), (1, [1.0, 0.0], 0.2), (3, [3.0, 0.0], -0.2)]),
        plan(&[(1, [1.0, 0.0], 0.0), (2, [2.0, 0.0], 0.5 * PI)]),
    ];
    assert_value(&record, DEVIATION, 2.0_f64.sqrt());
    // Halfway between headings of ±(π - 0.2) is π, not 0.
    record.plans[0] =
        plan(&[(0, [0.0, 0.0], 0.0), (1, [1.0, 0.0], PI - 0.2), (3, [3.0, 0.0], 0.2 - PI)]);
    record.plans[1] = plan(&[(1, [1.0, 0.0], 0.0), (2, [2.0, 0.0], PI)]);
    assert_value(&record, DEVIATION, 0.0);
}

#[test]
fn the_mean_distance_from_the_recording_is_over_the_steps_up_to_each_horizon() {
    let mut record = drive(100_000);
    // 1 m/s too slow: k tenths after the decision it is 0.1 k m behind. The means of k = 1..5, 10,
    // 25 and 50.
    record.plans = vec![straight(0, 64, 9.0)];
    for (name, expected) in ADES.into_iter().zip([0.3, 0.55, 1.3, 2.55]) {
        assert_value(&record, name, expected);
    }
    // A second decision, 1.5 s before the end of the episode, as recorded: it counts only for 0.5
    // and 1 s.
    record.plans.push(straight(85, 149, 10.0));
    for (name, expected) in ADES.into_iter().zip([0.15, 0.275, 1.3, 2.55]) {
        assert_value(&record, name, expected);
    }
    // An episode that ends at 6 s, before the recording: a decision at 4.5 s counts for 0.5 and 1
    // s.
    let mut short = drive(100_000);
    short.ego.truncate(61);
    short.plans = vec![straight(45, 109, 9.0)];
    assert_value(&short, ADES[1], 0.55);
    assert_none(&short, ADES[2], "reach 2.5 s ahead");
    // A plan of 2 s has no value for 2.5 s.
    record.plans = vec![straight(0, 20, 9.0)];
    assert_value(&record, ADES[1], 0.55);
    assert_none(&record, ADES[2], "reach 2.5 s ahead");
    // The recording ends after 3 s.
    record.plans = vec![straight(0, 64, 9.0)];
    record.reference.as_mut().unwrap().times_us = (0..=100).map(|k| 30_000 * k).collect();
    record.limit_us = None;
    assert!(plan_score(&record, ADES[2]).value.is_some());
    assert_none(&record, ADES[3], "reach 5 s ahead");
    record.reference = None;
    assert_none(&record, ADES[0], "needs the recorded drive");
}

#[test]
fn steps_that_do_not_divide_a_horizon_go_beyond_it_and_lose_the_longest() {
    // Steps of 0.3 s: 0.5 s is reached with the step at 0.6 s, 0.3 and 0.6 m behind. 5 s would be
    // with the one at 5.1 s, which is later than the longest horizon.
    let mut record = drive(300_000);
    record.plans = vec![straight(0, 64, 9.0)];
    assert_value(&record, ADES[0], 0.45);
    assert_none(&record, ADES[3], "5 s ahead");
}

#[test]
fn the_distance_from_the_recording_is_at_the_centre_of_the_box() {
    let mut record = drive(100_000);
    // As recorded, but a quarter turned: the centre is 1 m to the left of the rear axle, not ahead
    // of it.
    let turned = |k: i64| (k, [k as f64, 0.0], 0.5 * PI);
    record.plans = vec![plan(&(0..=10).map(turned).collect::<Vec<_>>())];
    assert_value(&record, ADES[0], 2.0_f64.sqrt());
}

/// A car of 4 m x 2 m.
fn car(center_m: [f64; 2]) -> Option<TrackSample> {
    let footprint = Footprint::new(DVec2::from_array(center_m), 0.0, 4.0, 2.0);
    Some(TrackSample { footprint, velocity_mps: DVec2::ZERO })
}

fn track(samples: Vec<Option<TrackSample>>) -> Track {
    Track { name: "car".to_owned(), class: ActorClass::Vehicle, samples }
}

#[test]
fn a_plan_hits_what_is_there_within_three_seconds() {
    // At 3 s the front is at 30 + 1 + 1.96 m. The rear of a car at 34.9 m is at 32.9 m, of one at
    // 35 m at 33 m, which the plan meets at 3.1 s.
    for (x_m, expected) in [(34.9, 1.0), (35.0, 0.0)] {
        let mut record = drive(100_000);
        record.ego.iter_mut().for_each(|sample| sample.origin_m.x *= 0.1);
        record.tracks = Some(vec![track(vec![car([x_m, 0.0]); record.ego.len()])]);
        record.plans = vec![straight(0, 40, 10.0)];
        assert_value(&record, COLLISION, expected);
        // One decision of two; a third has no pose within 3 s, and counts for neither.
        record.plans.push(plan(&[(1, [0.1, 0.0], 0.0), (2, [0.2, 0.0], 0.0)]));
        record.plans.push(plan(&[(2, [0.2, 0.0], 0.0), (33, [35.0, 0.0], 0.0)]));
        assert_value(&record, COLLISION, 0.5 * expected);
        // While it is away, nothing is hit.
        record.tracks.as_mut().unwrap()[0].samples[20..40].fill(None);
        assert_value(&record, COLLISION, 0.0);
    }
}

#[test]
fn others_move_between_two_samples() {
    // The car crosses the plan at 0.5 s, on its way from 20 m to the right to 20 m to the left.
    let mut record = drive(1_000_000);
    let mut samples = vec![None; record.ego.len()];
    (samples[0], samples[1]) = (car([6.0, -20.0]), car([6.0, 20.0]));
    record.tracks = Some(vec![track(samples)]);
    record.plans =
        vec![plan(&[(0, [0.0, 0.0], 0.0), (5, [5.0, 0.0], 0.0), (10, [10.0, 0.0], 0.0)])];
    assert_value(&record, COLLISION, 1.0);
    record.plans = vec![plan(&[(0, [0.0, 0.0], 0.0), (10, [10.0, 0.0], 0.0)])];
    assert_value(&record, COLLISION, 0.0);
}

#[test]
fn what_is_decided_after_the_cut_does_not_count() {
    let mut record = drive(100_000);
    // The ego is 5 m off the recorded drive from 2 s on: the decision at 2 s is the last one.
    record.ego[20..].iter_mut().for_each(|sample| sample.origin_m.y = 5.0);
    record.plans = vec![straight(0, 64, 9.0), straight(20, 84, 9.0), straight(21, 85, 5.0)];
    let found = plan_score(&record, ADES[0]);
    assert_eq!(found.parts["decisions"], Some(2.0));
    assert_value(&record, ADES[0], 0.3);
    record.plans.clear();
    assert_none(&record, DEVIATION, "needs a plan");
    assert_none(&record, COLLISION, "needs a plan");
    record.tracks = None;
    assert_none(&record, DEVIATION, "needs the actors");
}

fn lane(outline_m: &[[f64; 2]], center_m: &[[f64; 2]]) -> Lane {
    let points = |points_m: &[[f64; 2]]| points_m.iter().map(|&xy| DVec2::from_array(xy)).collect();
    Lane {
        outline_m: points(outline_m),
        center: Polyline::new(points(center_m)),
        is_on_route: true,
        is_intersection: false,
    }
}

/// A lane along x between two y, without a direction.
fn strip(y_m: [f64; 2]) -> Lane {
    let [low, high] = y_m;
    lane(&[[-50.0, low], [150.0, low], [150.0, high], [-50.0, high]], &[])
}

fn on(lanes: Vec<Lane>) -> DriveRecord {
    let centerline = Polyline::new(vec![DVec2::ZERO, DVec2::new(150.0, 0.0)]).unwrap();
    DriveRecord { map: Some(LaneMap { lanes, centerline, red: Vec::new() }), ..drive(100_000) }
}

#[test]
fn an_ego_is_off_the_road_where_it_crosses_the_edge_of_all_lanes() {
    assert_none(&drive(100_000), OFF_ROAD, "needs a map");
    // Half of the tested width is 0.98 m.
    assert_value(&on(vec![strip([-0.985, 0.985])]), OFF_ROAD, 0.0);
    assert_value(&on(vec![strip([-0.975, 0.985])]), OFF_ROAD, 1.0);
    // Two lanes that share an edge below the ego hold it together.
    assert_value(&on(vec![strip([-3.0, 0.3]), strip([0.3, 3.0])]), OFF_ROAD, 0.0);
    // A gap between lanes is no edge of the road.
    assert_value(&on(vec![strip([-3.0, 0.3]), strip([0.4, 3.0])]), OFF_ROAD, 0.0);
    // An edge that is left by less than a seam is, also where one lane follows another.
    let half = |x_m: [f64; 2]| {
        let [from, to] = x_m;
        lane(&[[from, -0.9], [to, -0.9], [to, 3.0], [from, 3.0]], &[])
    };
    assert_value(&on(vec![half([-50.0, 1.0]), half([1.0, 150.0])]), OFF_ROAD, 1.0);
    // A median of 0.9 m below the ego is, although the arcs of its corners, 0.98 m apart, are in
    // the two lanes.
    assert_value(&on(vec![strip([-3.0, -0.45]), strip([0.45, 3.0])]), OFF_ROAD, 1.0);
    // Wholly outside of the road it touches no edge, so that it counts as on the road; a millimetre
    // is a touch.
    assert_value(&on(vec![strip([5.0, 8.0])]), OFF_ROAD, 0.0);
    assert_value(&on(vec![strip([0.9805, 8.0])]), OFF_ROAD, 1.0);
    assert_value(&on(vec![strip([0.9815, 8.0])]), OFF_ROAD, 0.0);
    // The score of the scene is 0 then.
    assert_value(&on(vec![strip([-0.975, 0.985])]), "alpasim.scene@3032e0c", 0.0);
}

#[test]
fn a_hole_in_the_road_below_the_ego_is_off_the_road() {
    // The box of a standing ego reaches from -0.96 m to 2.96 m. The hole is 0.5 m square, between
    // four lanes.
    let standing = |hole_x_m: f64| {
        let [from, to] = [hole_x_m - 0.25, hole_x_m + 0.25];
        let rest =
            |from: f64, to: f64| lane(&[[from, -0.25], [to, -0.25], [to, 0.25], [from, 0.25]], &[]);
        let lanes =
            vec![strip([-3.0, -0.25]), strip([0.25, 3.0]), rest(-50.0, from), rest(to, 150.0)];
        let mut record = on(lanes);
        record.ego.iter_mut().for_each(|sample| sample.origin_m.x = 0.0);
        record
    };
    assert_value(&standing(1.0), OFF_ROAD, 1.0);
    assert_value(&standing(2.5), OFF_ROAD, 1.0);
    assert_value(&standing(3.3), OFF_ROAD, 0.0);
}

#[test]
fn the_corners_of_the_ego_are_round() {
    // A standing ego reaches to x = 2.96 m and y = 0.98 m. Its corner has a radius of 0.49 m: the
    // arc is 0.203 m from the corner of the box. A lane that lacks a triangle with legs of 0.2 m at
    // that corner ends 0.141 m from it, one with legs of 0.4 m 0.283 m.
    for (leg_m, expected) in [(0.2, 0.0), (0.4, 1.0)] {
        let lane = lane(
            &[[-5.0, -5.0], [2.97, -5.0], [2.97, 0.99 - leg_m], [2.97 - leg_m, 0.99], [-5.0, 0.99]],
            &[],
        );
        let mut record = on(vec![lane]);
        record.ego.iter_mut().for_each(|sample| sample.origin_m.x = 0.0);
        assert_value(&record, OFF_ROAD, expected);
    }
}

#[test]
fn a_heading_beyond_120_degrees_is_of_the_wrong_lane() {
    let outline_m = [[-50.0, -3.0], [150.0, -3.0], [150.0, 3.0], [-50.0, 3.0]];
    let heading = |yaw_rad: f64, center_m: &[[f64; 2]]| {
        let mut record = on(vec![lane(&outline_m, center_m)]);
        record.ego.truncate(1);
        record.ego[0].yaw_rad = yaw_rad;
        record
    };
    let east = [[-50.0, 0.0], [150.0, 0.0]];
    assert_value(&heading(0.0, &east), WRONG_LANE, 0.0);
    // 120 degrees are 2.094 rad.
    assert_value(&heading(2.09, &east), WRONG_LANE, 0.0);
    assert_value(&heading(-2.10, &east), WRONG_LANE, 1.0);
    // A heading of more than a turn is that within ±π.
    assert_value(&heading(2.0 * PI, &east), WRONG_LANE, 0.0);
    // The lane leads west, at π. An ego turned by 0.01 rad from it is at -π + 0.01: 6.27 rad apart,
    // as published.
    let west = [[150.0, 0.0], [-50.0, 0.0]];
    assert_value(&heading(PI - 0.01, &west), WRONG_LANE, 0.0);
    assert_value(&heading(PI + 0.01, &west), WRONG_LANE, 1.0);
    // The middle bends to the north before the ego's centre, which is 1 m ahead.
    let bend = [[-50.0, 0.0], [0.5, 0.0], [0.5, 100.0]];
    assert_value(&heading(-1.0, &bend), WRONG_LANE, 0.0);
    let mut turned = heading(-1.0, &bend);
    turned.ego[0].origin_m = DVec2::new(-0.4, 2.0);
    assert_value(&turned, WRONG_LANE, 1.0);
    // Half a metre behind the bend, the middle leads north: 2.17 rad from a heading of -0.6.
    let mut behind = heading(-0.6, &bend);
    behind.ego[0].origin_m = DVec2::new(-0.525, 1.065);
    assert_value(&behind, WRONG_LANE, 1.0);
    // Once is enough.
    let mut once = heading(3.0, &east);
    once.ego.push(EgoSample { yaw_rad: 0.0, ..once.ego[0] });
    assert_value(&once, WRONG_LANE, 1.0);
    // Beside the lane it is in none.
    let mut beside = heading(-3.0, &east);
    beside.ego[0].origin_m.y = 3.9;
    assert_value(&beside, WRONG_LANE, 0.0);
    assert_none(&heading(0.0, &[]), WRONG_LANE, "middles of the lanes");
    assert_none(&drive(100_000), WRONG_LANE, "needs a map");
}
