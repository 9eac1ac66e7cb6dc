//! The most that one scenario can ask for: its time does not depend on how it is written.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_sim::traffic::{
    Action, Actor, Attack, Behaviour, Body, Condition, Course, EgoMotion, EgoState, Idm, Measure,
    Near, Quantity, Traffic, Trigger, World,
};
use wildcity_sim::{Ground, limits};

use super::episodes::{actor, follow, traffic};

/// A simulated time of 10 s, in steps of 0.5 s.
const STEPS: i64 = 20;

const IDM: Idm = Idm {
    free_speed_mps: 10.0,
    least_gap_m: 2.0,
    headway_s: 1.5,
    acceleration_mps2: 1.5,
    braking_mps2: 2.0,
    exponent: 4.0,
    bracket: true,
    gap_floor_m: 0.1,
    clipped: false,
};

/// The ego on its way along x at 10 m/s.
fn ego(step: i64) -> EgoMotion {
    let state = |step: i64| EgoState {
        world_from_rig: Pose { position_m: step as f64 * 5.0 * DVec3::X, ..Pose::IDENTITY },
        velocity_mps: 10.0 * DVec3::X,
        yaw_rate_radps: 0.0,
    };
    EgoMotion { from: state(step), to: state(step + 1), smooth: true }
}

/// The time that 10 simulated seconds take, and a digest of where everything is then.
fn simulated(traffic: &Arc<Traffic>) -> (Duration, u64) {
    let begin = Instant::now();
    let mut world = World::new(traffic.clone());
    for step in 0..STEPS {
        world.step(500_000, &ego(step), &mut |_| {});
    }
    let time = begin.elapsed();
    let mut hasher = DefaultHasher::new();
    for (index, state) in world.states().iter().enumerate() {
        state.present.hash(&mut hasher);
        state.world_from_actor.position_m.to_array().map(f64::to_bits).hash(&mut hasher);
        state.velocity_mps.to_array().map(f64::to_bits).hash(&mut hasher);
        for trigger in 0..traffic.actors[index].script.len() {
            world.fired_us(index, trigger).hash(&mut hasher);
        }
    }
    (time, hasher.finish())
}

/// A road of 400 m that winds, through as many points as given.
fn road(points: usize) -> Arc<Course> {
    let points: Vec<DVec3> = (0..points)
        .map(|index| {
            let x_m = index as f64 / (points - 1) as f64 * 400.0;
            DVec3::new(x_m, 3.0 * (x_m / 30.0).sin(), 0.0)
        })
        .collect();
    Arc::new(Course::from_points(&points, &Ground::from_drives(&[])).unwrap())
}

fn idm_car(index: usize, course: &Arc<Course>, script: Vec<Trigger>) -> Actor {
    let station_m = 0.5 + index as f64 * 1.5;
    let behaviour = follow(course, station_m, 5.0, Some(IDM));
    actor(&format!("car-{index}"), behaviour, script)
}

/// 64 triggers that the ego does not meet, of the kinds that look something up.
fn script() -> Vec<Trigger> {
    let far = |index: usize| match index % 4 {
        0 => Condition { ego_station_m: Some(390.0 + index as f64 * 0.1), ..Condition::default() },
        1 => Condition { near: Some(Near { actor: None, within_m: 0.01 }), ..Condition::default() },
        2 => Condition { time_us: Some(9_000_000 + index as i64), ..Condition::default() },
        _ => Condition {
            measure: Some(Measure {
                quantity: Quantity::Speed,
                of: Body { actor: None, ahead_m: 0.0 },
                above: Some(50.0),
                below: None,
            }),
            ..Condition::default()
        },
    };
    let stop = || vec![Action::Speed { to_mps: 0.0, rate_mps2: 3.0 }];
    (0..limits::TRIGGERS).map(|index| Trigger { when: far(index), then: stop() }).collect()
}

fn attacker(index: usize, spacing_m: f64) -> Actor {
    let position_m =
        DVec3::new((index % 16) as f64, (index / 16) as f64, 0.0) * spacing_m + 10.0 * DVec3::X;
    let behaviour = Behaviour::Attack {
        attack: Attack { plan_us: 250_000, best: 2 },
        world_from_actor: Pose { position_m, rotation: DQuat::IDENTITY },
        speed_mps: 6.0,
    };
    actor(&format!("attacker-{index}"), behaviour, Vec::new())
}

/// Compares a time with another one of this run, and where everything is then.
#[track_caller]
fn assert_within(
    name: &str,
    (took, digest): (Duration, u64),
    (factor, other): (f64, Duration),
    expected: u64,
) {
    let is_fast = took < other.mul_f64(factor) + Duration::from_millis(20);
    assert!(is_fast, "{name}: {took:?}, more than {factor} times {other:?}; {digest:#x}");
    assert_eq!(digest, expected, "{name}: the motion has changed; {took:?} {other:?} {digest:#x}");
}

#[test]
fn triggers_cost_what_their_actors_cost() {
    let course = road(limits::COURSE_POINTS);
    let with = |script: &dyn Fn() -> Vec<Trigger>| {
        traffic((0..limits::ACTORS).map(|index| idm_car(index, &course, script())).collect())
    };
    let (bare, _) = simulated(&with(&Vec::new));
    let took = simulated(&with(&script));
    assert_within("16,384 triggers", took, (3.0, bare), 0x68e8_0caa_d708_afbc);
}

#[test]
fn a_course_of_many_points_costs_what_one_of_few_costs() {
    let on = |points: usize| {
        let course = road(points);
        let cars = (0..limits::ACTORS).map(|index| idm_car(index, &course, Vec::new()));
        traffic(cars.collect())
    };
    let (few, _) = simulated(&on(100));
    let took = simulated(&on(limits::COURSE_POINTS));
    assert_within("256 cars on 4096 points", took, (3.0, few), 0xcd64_a490_9bf9_db8d);
}

#[test]
fn a_crowd_of_attackers_costs_what_single_ones_cost() {
    let of = |spacing_m: f64| {
        traffic((0..limits::ACTORS).map(|index| attacker(index, spacing_m)).collect())
    };
    let (alone, _) = simulated(&of(1000.0));
    let took = simulated(&of(2.5));
    assert_within("256 attackers in a crowd", took, (4.0, alone), 0xa836_7196_0a90_65df);
}
