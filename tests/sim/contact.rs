//! Contacts: the vectors of boxes and of our own rules, and motions that a wrong sweep would miss.

use glam::{DQuat, DVec2, DVec3};
use serde_json::Value;

use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_sim::contact::{
    CollisionType, Contact, Detector, FaultInput, Footprint, Moving, SolidPoint, StaticLimit,
    is_ego_at_fault, solid_area_m2, time_to_contact_s,
};
use wildcity_sim::traffic::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};

use crate::vectors::{assert_near, cases, number, numbers};

fn footprint(of: &Value) -> Footprint {
    let center_m = DVec2::new(number(&of["x"]), number(&of["y"]));
    Footprint::new(center_m, number(&of["yaw"]), number(&of["length"]), number(&of["width"]))
}

fn moving(of: &Value) -> Moving {
    let velocity_mps = DVec2::new(number(&of["vx"]), number(&of["vy"]));
    Moving { footprint: footprint(of), velocity_mps }
}

#[test]
fn boxes_are_as_in_the_vectors() {
    let Some(cases) = cases("boxes", "") else { return };
    for case in cases {
        let a = footprint(&case.input["a"]);
        let b = footprint(&case.input["b"]);
        assert_near(a.gap_m(&b), &case.expected["gap_m"], &case.name);
        assert_near(b.gap_m(&a), &case.expected["gap_m"], &case.name);
        assert_eq!(a.touches(&b), case.expected["contact"], "{}", case.name);
        assert_near(a.distance_m(&b), &case.expected["distance_m"], &case.name);
    }
}

#[test]
fn times_to_contact_are_as_in_the_vectors() {
    let Some(cases) = cases("own", "time to contact") else { return };
    for case in cases {
        let ego = moving(&case.input["ego"]);
        let other = moving(&case.input["other"]);
        for found in [time_to_contact_s(&ego, &other), time_to_contact_s(&other, &ego)] {
            match found {
                Some(found) => assert_near(found, &case.expected["ttc_s"], &case.name),
                None => assert!(case.expected["ttc_s"].is_null(), "{}", case.name),
            }
        }
    }
}

#[test]
fn boxes_that_part_touch_no_more() {
    let at = |x_m: f64, x_mps: f64| Moving {
        footprint: Footprint::new(DVec2::new(x_m, 0.0), 0.0, 4.0, 2.0),
        velocity_mps: DVec2::new(x_mps, 0.0),
    };
    // They overlapped until 1 s ago: 6 m apart, 2 m of it between them, at 2 m/s.
    let (ego, other) = (at(0.0, 5.0), at(6.0, 7.0));
    assert_eq!(time_to_contact_s(&ego, &other), None);
    assert_eq!(time_to_contact_s(&other, &ego), None);
    assert_eq!(time_to_contact_s(&ego, &at(6.0, 4.0)).map(|s| (s - 2.0).abs() < 1e-6), Some(true));
}

#[test]
fn static_contacts_are_as_in_the_vectors() {
    let Some(cases) = cases("own", "static") else { return };
    for case in cases {
        let vector = |value: &Value| DVec3::from_slice(&numbers(value));
        let points = case.input["gaussians"].as_array().unwrap().iter().map(|point| SolidPoint {
            mean_m: vector(&point["mean"]),
            sigma_m: vector(&point["sigma"]),
            opacity: number(&point["opacity"]),
        });
        let area_m2 = solid_area_m2(points, vector(&case.input["box"]));
        assert_near(area_m2, &case.expected["area_m2"], &case.name);
        let limit = StaticLimit { most_on_drive_m2: number(&case.input["most_on_drive_m2"]) };
        assert_eq!(limit.is_exceeded_by(area_m2), case.expected["contact"], "{}", case.name);
    }
}

#[test]
fn lateral_faults_are_as_in_the_vectors() {
    let Some(cases) = cases("own", "lateral fault") else { return };
    for case in cases {
        let vector = |value: &Value| DVec2::from_slice(&numbers(value));
        // Side by side, with neither bumper in contact.
        let input = FaultInput {
            ego: Footprint::new(DVec2::ZERO, 0.0, 5.0, 2.0),
            ego_origin_m: DVec2::new(-1.4, 0.0),
            ego_velocity_mps: vector(&case.input["ego_velocity"]),
            other: Footprint::new(DVec2::new(0.0, 2.0), 0.0, 4.0, 2.0),
            other_velocity_mps: vector(&case.input["other_velocity"]),
            other_is_agent: true,
        };
        assert_eq!(CollisionType::classify(&input), CollisionType::ActiveLateral);
        let at_fault = is_ego_at_fault(&input, vector(&case.input["normal"]), None);
        assert_eq!(at_fault, case.expected["ego_at_fault"], "{}", case.name);
    }
}

#[test]
fn a_nanometre_decides_alike_at_any_origin() {
    for origin in [DVec2::ZERO, DVec2::new(450_000.25, 5_400_000.5), DVec2::new(-3e6, 9e6)] {
        let ego = Footprint::new(origin, 0.0, 4.0, 2.0);
        for (gap_m, touches) in [(-1e-9, true), (0.0, true), (1e-9, false)] {
            for axis in [DVec2::X, DVec2::Y] {
                let reach_m = 4.0 * axis.x + 2.0 * axis.y;
                let center_m = origin + (reach_m + gap_m) * axis;
                let other = Footprint::new(center_m, 0.0, 4.0, 2.0);
                assert_eq!(ego.touches(&other), touches, "{origin} {axis} {gap_m:e}");
            }
        }
    }
    // Close to the origin coordinates are fine enough for half of it.
    let ego = Footprint::new(DVec2::ZERO, 0.7, 4.0, 2.0);
    for (gap_m, touches) in [(-5e-10, true), (5e-10, false)] {
        let other = ego.shifted((4.0 + gap_m) * DVec2::from_angle(0.7));
        assert_eq!(ego.touches(&other), touches, "{gap_m:e}");
    }
}

const CAR: ActorBox = ActorBox { length_m: 4.0, width_m: 2.0, height_m: 1.5 };
const EGO: EgoBox =
    EgoBox { box_: ActorBox { length_m: 5.0, width_m: 2.0, height_m: 1.5 }, center_x_m: 1.4 };

fn spec(class: ActorClass, box_: ActorBox) -> ActorSpec {
    ActorSpec { name: "other".to_owned(), class, box_, asset: None }
}

fn state(position_m: DVec3, yaw_rad: f64, velocity_mps: DVec3) -> ActorState {
    let world_from_actor = Pose { position_m, rotation: DQuat::from_rotation_z(yaw_rad) };
    ActorState { index: 0, world_from_actor, velocity_mps, yaw_rate_radps: 0.0, present: true }
}

fn ego_at(x_m: f64, y_m: f64, yaw_rad: f64, velocity_mps: DVec3) -> EgoState {
    let world_from_rig =
        Pose { position_m: DVec3::new(x_m, y_m, 0.0), rotation: DQuat::from_rotation_z(yaw_rad) };
    EgoState { world_from_rig, velocity_mps, yaw_rate_radps: 0.0 }
}

/// Contacts over `seconds` of a motion in steps of `dt_us`, cut into sub-steps of at most 10 ms.
fn contacts(
    class: ActorClass,
    box_: ActorBox,
    dt_us: i64,
    seconds: i64,
    motion: &dyn Fn(f64) -> (EgoState, ActorState),
) -> Vec<Contact> {
    let specs = [spec(class, box_)];
    let at = |time_us: i64| motion(time_us as f64 * 1e-6);
    let (ego, actor) = at(0);
    let (mut detector, mut found) = Detector::at_start(EGO, &specs, &ego, &[actor]);
    let count = (dt_us + 9_999) / 10_000;
    for step in 0..seconds * 1_000_000 / dt_us {
        for k in 0..count {
            let begin_us = step * dt_us + k * dt_us / count;
            let end_us = step * dt_us + (k + 1) * dt_us / count;
            let (ego_before, before) = at(begin_us);
            let (ego_after, after) = at(end_us);
            let sub_step = SubStep {
                begin_us,
                end_us,
                ego: [ego_before, ego_after],
                before: &[before],
                after: &[after],
            };
            found.extend(detector.advance(&sub_step, &specs, None));
        }
    }
    found
}

/// The ego drives along x at 10 m/s; a bicycle crosses in front of it at 12 m/s.
fn crossing(time_s: f64) -> (EgoState, ActorState) {
    let ego = ego_at(10.0 * time_s, 0.0, 0.0, 10.0 * DVec3::X);
    let other = DVec3::new(30.0, -30.0 + 12.0 * time_s, 0.0);
    (ego, state(other, std::f64::consts::FRAC_PI_2, 12.0 * DVec3::Y))
}

#[test]
fn every_step_length_finds_the_same_contacts() {
    let bicycle = ActorBox { length_m: 1.8, width_m: 0.6, height_m: 1.75 };
    let find = |dt_us| contacts(ActorClass::Bicycle, bicycle, dt_us, 5, &crossing);
    let found = find(100_000);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found, find(50_000));
    assert_eq!(found, find(500_000));
    // y: |12 t - 30| <= 1.9 from 2.3417 s; x: the front, at 10 t + 3.9, reaches 29.7 at 2.58 s.
    assert_eq!(found[0].time_us, 2_580_000);
    assert!(found[0].ego_at_fault && found[0].kind == CollisionType::ActiveFront, "{found:?}");
}

/// Two cars pass each other with a lateral gap of a nanometre less or more than 0.
#[test]
fn every_step_length_decides_alike_about_a_nanometre() {
    for origin_m in [DVec3::ZERO, DVec3::new(450_000.25, 5_400_000.5, 30.0)] {
        for (gap_m, count) in [(-1e-9, 1), (0.0, 1), (1e-9, 0)] {
            let motion = |time_s: f64| {
                let mut ego = ego_at(10.0 * time_s, 0.0, 0.0, 10.0 * DVec3::X);
                ego.world_from_rig.position_m += origin_m;
                let side_m = 0.5 * (EGO.box_.width_m + CAR.width_m);
                let other_m = DVec3::new(40.0 - 7.0 * time_s, side_m + gap_m, 0.0);
                (ego, state(origin_m + other_m, std::f64::consts::PI, -7.0 * DVec3::X))
            };
            let find = |dt_us| contacts(ActorClass::Vehicle, CAR, dt_us, 5, &motion);
            let found = find(100_000);
            assert_eq!(found.len(), count, "{gap_m:e} at {origin_m}: {found:?}");
            // The fronts meet after 40 - 3.9 - 2 m at 17 m/s: 2.005883 s.
            assert!(found.iter().all(|contact| contact.time_us == 2_005_883), "{found:?}");
            assert_eq!(found, find(50_000), "{gap_m:e} at {origin_m}");
            assert_eq!(found, find(500_000), "{gap_m:e} at {origin_m}");
        }
    }
}

#[test]
fn what_lies_between_two_sub_steps_is_swept() {
    // A sign of 5 cm cuts the ego's front left corner (3.9, 1.0) at 50 m/s: it is in the box from
    // 0.3834 s to 0.3848 s, within one sub-step.
    let sign = ActorBox { length_m: 0.05, width_m: 0.05, height_m: 2.0 };
    let motion = |time_s: f64| {
        let way_m = 35.0 * (time_s - 0.3834);
        let position_m = DVec3::new(3.875 + way_m, 1.025 - way_m, 0.0);
        let velocity_mps = DVec3::new(35.0, -35.0, 0.0);
        (ego_at(0.0, 0.0, 0.0, DVec3::ZERO), state(position_m, 0.0, velocity_mps))
    };
    let found = contacts(ActorClass::Object, sign, 100_000, 1, &motion);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].kind, CollisionType::StoppedEgo);
    assert_eq!(found[0].time_us, 383_400);
}

#[test]
fn a_teleport_sweeps_nothing() {
    let motion = |time_s: f64| {
        let x_m = if time_s < 0.5 { 0.0 } else { 100.0 };
        let ego = ego_at(x_m, 0.0, 0.0, DVec3::ZERO);
        (ego, state(DVec3::new(50.0, 0.0, 0.0), 0.0, DVec3::ZERO))
    };
    assert_eq!(contacts(ActorClass::Vehicle, CAR, 100_000, 1, &motion), []);
}

#[test]
fn a_bridge_is_not_touched_from_below() {
    let motion = |time_s: f64| {
        let (ego, other) = crossing(time_s);
        let height_m = 1.500_001 * DVec3::Z;
        let position_m = other.world_from_actor.position_m + height_m;
        let world_from_actor = Pose { position_m, ..other.world_from_actor };
        (ego, ActorState { world_from_actor, ..other })
    };
    assert_eq!(contacts(ActorClass::Vehicle, CAR, 100_000, 5, &motion), []);
}

#[test]
fn an_overlap_at_the_start_is_said_once_and_marked() {
    let stands = |_| (ego_at(0.0, 0.0, 0.0, DVec3::ZERO), state(DVec3::X, 0.0, DVec3::ZERO));
    let found = contacts(ActorClass::Vehicle, CAR, 100_000, 1, &stands);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].at_start);
}

#[test]
fn two_contacts_of_a_sub_step_are_both_found() {
    let specs =
        [spec(ActorClass::Vehicle, CAR), spec(ActorClass::Pedestrian, ActorBox::PEDESTRIAN)];
    let ego = [0.0, 0.1].map(|x_m| ego_at(x_m, 0.0, 0.0, 10.0 * DVec3::X));
    let car = state(DVec3::new(5.95, 0.9, 0.0), 0.0, DVec3::ZERO);
    let person = ActorState { index: 1, ..state(DVec3::new(4.25, -0.5, 0.0), 0.0, DVec3::ZERO) };
    let actors = [car, person];
    let (mut detector, at_start) = Detector::at_start(EGO, &specs, &ego[0], &actors);
    assert_eq!(at_start, []);
    let sub_step = SubStep { begin_us: 0, end_us: 10_000, ego, before: &actors, after: &actors };
    let found = detector.advance(&sub_step, &specs, None);
    assert_eq!(found.iter().map(|contact| contact.actor).collect::<Vec<_>>(), [0, 1]);
    assert!(found.iter().all(|contact| contact.ego_at_fault && !contact.at_start));
    assert_eq!(detector.advance(&sub_step, &specs, None), [], "still in contact");
}

#[test]
fn a_heading_beyond_pi_and_a_negated_quaternion_change_nothing() {
    let turned = |time_s: f64| {
        let (ego, other) = crossing(time_s);
        let negated = Pose { rotation: -ego.world_from_rig.rotation, ..ego.world_from_rig };
        let full_turn = DQuat::from_rotation_z(std::f64::consts::TAU);
        let rotation = full_turn * other.world_from_actor.rotation;
        let world_from_actor = Pose { rotation, ..other.world_from_actor };
        (EgoState { world_from_rig: negated, ..ego }, ActorState { world_from_actor, ..other })
    };
    let find = |motion| contacts(ActorClass::Vehicle, CAR, 100_000, 5, motion);
    let [plain, other] = [find(&crossing), find(&turned)];
    assert_eq!((plain.len(), plain[0].time_us), (1, other[0].time_us));
    assert_eq!(plain[0].ego_at_fault, other[0].ego_at_fault);
}
