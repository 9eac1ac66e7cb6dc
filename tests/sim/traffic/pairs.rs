//! Actors that move with others: a distance that is kept, and an arrival together; and the
//! condition that ends an episode.

use std::sync::Arc;

use glam::DVec3;
use wildcity_scene::geometry::Pose;
use wildcity_sim::traffic::{
    Action, ArriveTogether, Bounds, Condition, EgoMotion, EgoState, FinalSpeed, Gap, KeepDistance,
    Measure, Quantity, Side, Traffic, Trigger, World,
};

use super::episodes::{actor, follow, straight, traffic, winding};

const KEEP: KeepDistance = KeepDistance {
    of: None,
    gap: Gap::Length(20.0),
    side: Some(Side::Behind),
    is_free: true,
    is_on_course: true,
    ahead_m: 0.0,
    to_ahead_m: 0.0,
    is_once: false,
    bounds: Some(Bounds { acceleration_mps2: 2.0, braking_mps2: 3.0, speed_mps: 40.0 }),
};

fn at_once(action: Action) -> Vec<Trigger> {
    vec![Trigger { when: Condition::default(), then: vec![action] }]
}

/// An ego that drives along x from a place on, for `dt_us`.
fn ego(from_m: f64, speed_mps: f64, dt_us: i64) -> EgoMotion {
    let state = |x: f64| EgoState {
        world_from_rig: Pose { position_m: x * DVec3::X, ..Pose::IDENTITY },
        velocity_mps: speed_mps * DVec3::X,
        yaw_rate_radps: 0.0,
    };
    let to_m = from_m + speed_mps * dt_us as f64 * 1e-6;
    EgoMotion { from: state(from_m), to: state(to_m), smooth: true }
}

/// The gaps between the boxes and the speeds of a car that keeps its distance behind the ego, each
/// 10 ms.
fn followed(keep: KeepDistance, from_m: f64, own_mps: f64, ego_mps: f64) -> Vec<[f64; 2]> {
    let car = follow(&straight(5000.0), from_m, own_mps, None);
    let mut world =
        World::new(traffic(vec![actor("car", car, at_once(Action::KeepDistance(keep)))]));
    let states = (0..4000).map(|index| {
        let ego_m = 200.0 + ego_mps * 0.01 * f64::from(index);
        let motion = ego(ego_m, ego_mps, 10_000);
        world.step(10_000, &motion, &mut |_| {});
        let state = world.states()[0];
        // Boxes of 4.5 m; the ego's is 1.3 m ahead of its place.
        let ego_m = motion.to.world_from_rig.position_m.x + 1.3;
        [ego_m - state.world_from_actor.position_m.x - 4.5, state.velocity_mps.x]
    });
    states.collect()
}

#[test]
fn a_distance_is_reached_by_braking_as_the_formula_says() {
    for (from_m, own_mps) in [(50.0, 10.0), (50.0, 0.0), (150.0, 18.0), (188.0, 14.0)] {
        let states = followed(KEEP, from_m, own_mps, 14.0);
        for pair in states.windows(2) {
            let change_mps = pair[1][1] - pair[0][1];
            assert!((-0.03 - 1e-9..=0.02 + 1e-9).contains(&change_mps), "{from_m}: {change_mps}");
        }
        // While it brakes with 3 m/s², the speed of approach is √(2 b (way - b τ² / 2)) with τ =
        // 0.5 s.
        let is_braking = |pair: &&[[f64; 2]]| pair[1][1] - pair[0][1] < -0.028 && pair[0][0] > 22.0;
        let braking: Vec<_> = states.windows(2).filter(is_braking).collect();
        assert!(braking.len() > 100 || from_m > 160.0, "{from_m}: {}", braking.len());
        for pair in braking {
            let way_m = pair[0][0] - 20.0;
            let expected_mps = (2.0 * 3.0 * (way_m - 0.375)).sqrt();
            assert!((pair[0][1] - 14.0 - expected_mps).abs() < 0.2, "{from_m}: {pair:?}");
        }
        let [gap_m, speed_mps] = states[states.len() - 1];
        assert!((gap_m - 20.0).abs() < 0.02 && (speed_mps - 14.0).abs() < 0.02, "{gap_m}");
        // It comes from one side, and stays on it.
        let is_beyond = |gap_m: f64| if from_m > 160.0 { gap_m > 20.1 } else { gap_m < 19.9 };
        assert!(states.iter().all(|state| !is_beyond(state[0])), "{from_m}: it overshoots");
    }
}

#[test]
fn a_headway_is_the_way_of_the_follower() {
    let headway = KeepDistance { gap: Gap::Headway(1.5), ..KEEP };
    let states = followed(headway, 100.0, 8.0, 12.0);
    let [gap_m, _] = states[states.len() - 1];
    assert!((gap_m - 18.0).abs() < 0.02, "{gap_m}");
}

#[test]
fn without_bounds_it_is_there_at_once() {
    let states = followed(KeepDistance { bounds: None, ..KEEP }, 100.0, 3.0, 12.0);
    for [gap_m, speed_mps] in states {
        assert!((gap_m - 20.0).abs() < 1e-6 && (speed_mps - 12.0).abs() < 1e-9, "{gap_m}");
    }
    // Once: then it keeps its speed.
    let once = KeepDistance { bounds: None, is_once: true, ..KEEP };
    let car = follow(&straight(5000.0), 100.0, 3.0, None);
    let mut world =
        World::new(traffic(vec![actor("car", car, at_once(Action::KeepDistance(once)))]));
    world.step(10_000, &ego(200.0, 12.0, 10_000), &mut |_| {});
    world.step(1_000_000, &ego(500.0, 30.0, 1_000_000), &mut |_| {});
    assert!((world.states()[0].velocity_mps.x - 12.0).abs() < 1e-9);
}

fn arrival() -> ArriveTogether {
    ArriveTogether {
        at_m: DVec3::new(300.0, 0.0, 0.0),
        of: None,
        of_at_m: DVec3::new(320.0, 3.0, 0.0),
        ahead_m: 0.0,
        to_ahead_m: -1.3,
        speed: Some(FinalSpeed::Relative { factor: 1.0, delta_mps: 2.0 }),
        steady_m: 0.0,
        within_m: 0.0,
        of_within_m: 0.0,
    }
}

/// The place and the speed of a car when an ego at 12 m/s is at its place, 10 s later.
fn arrived(arrive: ArriveTogether, from_m: f64, own_mps: f64) -> [f64; 2] {
    let car = follow(&straight(5000.0), from_m, own_mps, None);
    let script = at_once(Action::ArriveTogether(arrive));
    let mut world = World::new(traffic(vec![actor("car", car, script)]));
    for index in 0..100 {
        world.step(100_000, &ego(200.0 + 1.2 * f64::from(index), 12.0, 100_000), &mut |_| {});
    }
    let state = world.states()[0];
    [state.world_from_actor.position_m.x, state.velocity_mps.x]
}

#[test]
fn both_are_at_their_places_at_one_time() {
    for (from_m, own_mps) in [(100.0, 5.0), (150.0, 20.0), (250.0, 10.0)] {
        let [place_m, speed_mps] = arrived(arrival(), from_m, own_mps);
        assert!(
            (place_m - 300.0).abs() < 0.2 && (speed_mps - 14.0).abs() < 0.3,
            "{place_m} {speed_mps}"
        );
    }
    // At a constant rate: v + 2 (s / t - v).
    let [place_m, speed_mps] = arrived(ArriveTogether { speed: None, ..arrival() }, 180.0, 9.0);
    assert!(
        (place_m - 300.0).abs() < 0.2 && (speed_mps - 15.0).abs() < 0.1,
        "{place_m} {speed_mps}"
    );
}

#[test]
fn the_last_metres_are_steady() {
    let steady = ArriveTogether { steady_m: 42.0, ..arrival() };
    let car = follow(&straight(5000.0), 150.0, 10.0, None);
    let script = at_once(Action::ArriveTogether(steady));
    let mut world = World::new(traffic(vec![actor("car", car, script)]));
    for index in 0..100 {
        world.step(100_000, &ego(200.0 + 1.2 * f64::from(index), 12.0, 100_000), &mut |_| {});
        let state = world.states()[0];
        let is_steady = state.world_from_actor.position_m.x > 259.0;
        assert!(!is_steady || (state.velocity_mps.x - 14.0).abs() < 0.2, "{state:?}");
    }
    assert!((world.states()[0].world_from_actor.position_m.x - 300.0).abs() < 0.3);
}

#[test]
fn pairs_are_the_same_however_time_is_cut() {
    let run = |step_us: i64| {
        let course = winding();
        let keep = KeepDistance { of: Some(1), side: None, ..KEEP };
        let arrive = ArriveTogether { of: Some(0), ..arrival() };
        let cars = vec![
            actor("first", follow(&course, 20.0, 9.0, None), at_once(Action::KeepDistance(keep))),
            actor(
                "second",
                follow(&course, 70.0, 8.0, None),
                at_once(Action::ArriveTogether(arrive)),
            ),
        ];
        let mut world = World::new(traffic(cars));
        while world.time_us() < 8_000_000 {
            world.step(step_us, &ego(-500.0, 0.0, step_us), &mut |_| {});
        }
        world.states().to_vec()
    };
    let states = run(100_000);
    assert_eq!(states, run(100_000));
    assert_eq!(states, run(500_000), "the same sub-steps");
}

#[test]
fn a_condition_ends_an_episode_in_the_step_in_which_it_holds() {
    let ended = |end: Condition, step_us: i64, from_m: f64| {
        let setup = Traffic { end: Some(end), ..(*traffic(Vec::new())).clone() };
        let mut world = World::new(Arc::new(setup));
        let mut ego_m = from_m;
        while world.end_us().is_none() && world.time_us() < 5_000_000 {
            world.step(step_us, &ego(ego_m, 10.0, step_us), &mut |_| {});
            ego_m += 10.0 * step_us as f64 * 1e-6;
        }
        (world.end_us(), world.time_us())
    };
    let time = Condition { time_us: Some(1_000_000), ..Condition::default() };
    assert_eq!(ended(time.clone(), 100_000, 0.0), (Some(1_000_000), 1_000_000));
    assert_eq!(ended(time.clone(), 7_000, 0.0), (Some(1_001_000), 1_001_000));
    let later = Condition { later_us: 500_000, ..time };
    assert_eq!(ended(later, 100_000, 0.0), (Some(1_500_000), 1_500_000));
    let near = Measure {
        quantity: Quantity::Point(DVec3::new(21.3, 0.0, 0.0)),
        of: wildcity_sim::traffic::Body { actor: None, ahead_m: 0.0 },
        above: None,
        below: Some(10.0),
    };
    // The ego's middle is 1.3 m ahead of its place.
    let near = Condition { measure: Some(near), ..Condition::default() };
    let at_us = ended(near.clone(), 100_000, 0.0).0.unwrap();
    assert!((1_000_000..=1_010_000).contains(&at_us), "{at_us}");
    let rising = Condition { edge: Some(wildcity_sim::traffic::Edge::Rising), ..near };
    assert!(ended(rising.clone(), 100_000, 0.0).0.is_some());
    assert_eq!(ended(rising, 100_000, 15.0).0, None, "it held from the start on: that is no edge");
}
