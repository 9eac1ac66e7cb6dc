//! Whole episodes of traffic: vectors of motion, order, and determinism.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_sim::Ground;
use wildcity_sim::traffic::{
    Action, Actor, ActorSpec, ActorState, After, Attack, Behaviour, Condition, Course,
    CourseFollower, EgoBox, EgoMotion, EgoState, Idm, Near, Phase, Track, TrackKeyframe, Traffic,
    Trigger, World,
};

use crate::vectors::{assert_near, cases, number};

pub(super) const CAR: ActorBox = ActorBox { length_m: 4.5, width_m: 1.8, height_m: 1.5 };
const EGO_BOX: EgoBox = EgoBox { box_: CAR, center_x_m: 1.3 };

pub(super) fn straight(length_m: f64) -> Arc<Course> {
    let points = [DVec3::ZERO, length_m * DVec3::X];
    Arc::new(Course::from_points(&points, &Ground::from_drives(&[])).unwrap())
}

/// A closed winding road of 600 m.
pub(super) fn winding() -> Arc<Course> {
    let points: Vec<DVec3> = (0..=600)
        .map(|s| {
            let s_m = f64::from(s);
            DVec3::new(s_m, 12.0 * (s_m / 40.0).sin(), 0.002 * s_m)
        })
        .collect();
    Arc::new(Course::from_points(&points, &Ground::from_drives(&[])).unwrap())
}

pub(super) fn follow(
    course: &Arc<Course>,
    station_m: f64,
    speed_mps: f64,
    idm: Option<Idm>,
) -> Behaviour {
    Behaviour::from(CourseFollower {
        courses: vec![course.clone()],
        station_m,
        offset_m: 0.0,
        speed_mps,
        idm,
        leaves: false,
    })
}

pub(super) fn actor(name: &str, behaviour: Behaviour, script: Vec<Trigger>) -> Actor {
    let spec = ActorSpec { name: name.into(), class: ActorClass::Vehicle, box_: CAR, asset: None };
    Actor { spec, behaviour, script, present: true }
}

pub(super) fn traffic(actors: Vec<Actor>) -> Arc<Traffic> {
    Arc::new(Traffic { seed: 7, ego_box: EGO_BOX, actors, end: None })
}

/// An ego that stands far away.
fn away() -> EgoMotion {
    at_rest(DVec3::new(0.0, 10_000.0, 0.0))
}

fn at_rest(position_m: DVec3) -> EgoMotion {
    EgoMotion::standing(EgoState {
        world_from_rig: Pose { position_m, ..Pose::IDENTITY },
        velocity_mps: DVec3::ZERO,
        yaw_rate_radps: 0.0,
    })
}

#[test]
fn an_idm_car_comes_to_rest_before_a_wall() {
    let Some(cases) = cases("own", "an IDM car") else { return };
    assert_eq!(cases.len(), 2);
    for case in cases {
        let step_us = case.input["step_us"].as_i64().unwrap();
        // The end of the course is the wall; the front is half a length ahead of the origin.
        let length_m = number(&case.input["gap_m"]) + 2.0 * 2.25;
        let speed_mps = number(&case.input["v"]);
        let car = follow(&straight(length_m), 2.25, speed_mps, Some(Idm::WILDCITY));
        let mut world = World::new(traffic(vec![actor("car", car, vec![])]));
        for (second, expected) in case.expected["at_s"].as_object().unwrap() {
            let second: i64 = second.parse().unwrap();
            // The map's keys are not in order of time.
            let mut world = if second == 5 {
                world.clone()
            } else {
                World::new(Arc::new(world.traffic().clone()))
            };
            while world.time_us() < second * 1_000_000 {
                world.step(step_us, &away(), &mut |_| {});
            }
            let state = world.states()[0];
            let name = format!("{} at {second} s", case.name);
            assert_near(state.world_from_actor.position_m.x - 2.25, &expected[0], &name);
            assert_near(state.velocity_mps.x, &expected[1], &name);
        }
        world.step(step_us, &away(), &mut |_| {});
    }
}

#[test]
fn sub_steps_are_at_most_ten_milliseconds_and_cover_the_step() {
    let mut world =
        World::new(traffic(vec![actor("a", follow(&straight(99.0), 5.0, 3.0, None), vec![])]));
    let mut ends = vec![0];
    world.step(25_000, &away(), &mut |sub_step| {
        assert_eq!(sub_step.begin_us, *ends.last().unwrap());
        assert_eq!((sub_step.before.len(), sub_step.after.len()), (1, 1));
        ends.push(sub_step.end_us);
    });
    assert_eq!(ends, [0, 8_333, 16_666, 25_000]);
    assert!((world.states()[0].world_from_actor.position_m.x - 5.075).abs() < 1e-12);
}

#[test]
fn a_car_follows_the_ego_and_brakes_for_what_cuts_in() {
    let road = straight(500.0);
    let idm = Some(Idm::WILDCITY);
    let car = actor("car", follow(&road, 10.0, 8.0, idm), vec![]);
    // The ego stands at 100 m: its rear is at 1.3 - 2.25 m from its origin.
    let mut world = World::new(traffic(vec![car.clone()]));
    for _ in 0..400 {
        world.step(100_000, &at_rest(100.0 * DVec3::X), &mut |_| {});
    }
    let front_m = world.states()[0].world_from_actor.position_m.x + 2.25;
    assert!((front_m - (100.0 + 1.3 - 2.25 - 1.0)).abs() < 1e-3, "{front_m}");
    // A car in the next lane is no lead until it moves over.
    let beside = Behaviour::from(CourseFollower {
        courses: vec![road.clone()],
        station_m: 60.0,
        offset_m: 3.5,
        speed_mps: 4.0,
        idm: None,
        leaves: false,
    });
    let over = Trigger {
        when: Condition { time_us: Some(2_000_000), ..Condition::default() },
        then: vec![Action::Offset { to_m: 0.0, over_s: 3.0 }],
    };
    let mut world = World::new(traffic(vec![car, actor("cut", beside, vec![over])]));
    let mut least_mps: f64 = 99.0;
    for step in 0..300 {
        world.step(100_000, &away(), &mut |_| {});
        if step == 19 {
            assert!(world.states()[0].velocity_mps.x > 8.0, "nothing is ahead");
        }
        least_mps = least_mps.min(world.states()[0].velocity_mps.x);
        let [car, cut] = [world.states()[0], world.states()[1]];
        let gap_m = cut.world_from_actor.position_m.x - car.world_from_actor.position_m.x - 4.5;
        assert!(step < 55 || gap_m > 0.5, "step {step}: {gap_m}");
    }
    assert!(least_mps < 5.0, "{least_mps}");
    assert!(world.states()[1].world_from_actor.position_m.y.abs() < 1e-9);
}

#[test]
fn triggers_fire_once_and_in_turn() {
    let road = straight(500.0);
    let brake = Trigger {
        when: Condition {
            near: Some(Near { actor: None, within_m: 30.0 + 1e-9 }),
            ..Condition::default()
        },
        then: vec![Action::Speed { to_mps: 0.0, rate_mps2: 4.0 }],
    };
    let go = Trigger {
        when: Condition {
            after: Some(After { actor: 0, trigger: 0, phase: Phase::Fired, delay_us: 3_000_000 }),
            speed_below_mps: Some(0.0),
            ..Condition::default()
        },
        then: vec![Action::Speed { to_mps: 6.0, rate_mps2: 2.0 }],
    };
    let vanish = Trigger {
        when: Condition { time_us: Some(9_000_000), ..Condition::default() },
        then: vec![Action::Remove],
    };
    let car = actor("car", follow(&road, 0.0, 8.0, None), vec![brake, go, vanish]);
    let mut world = World::new(traffic(vec![car]));
    // The middle of the ego's box is at 60 m: 30 m from the car after 30 m, 3.75 s.
    let ego = at_rest(58.7 * DVec3::X);
    for _ in 0..89 {
        world.step(100_000, &ego, &mut |_| {});
    }
    assert_eq!(world.fired_us(0, 0), Some(3_750_000));
    assert_eq!(world.fired_us(0, 1), Some(6_750_000));
    let state = world.states()[0];
    // It stopped 8 m on, at 38 m, and accelerated for 2.15 s.
    assert!((state.velocity_mps.x - 4.3).abs() < 1e-9, "{state:?}");
    assert!((state.world_from_actor.position_m.x - (38.0 + 2.15 * 2.15)).abs() < 1e-9);
    world.step(200_000, &ego, &mut |_| {});
    assert!(!world.states()[0].present);
}

#[test]
fn an_attacker_reaches_an_ego_that_does_nothing() {
    let begin = Pose { position_m: DVec3::new(-25.0, 4.0, 0.0), ..Pose::IDENTITY };
    let attack = Behaviour::Attack {
        attack: Attack { plan_us: 750_000, best: 1 },
        world_from_actor: begin,
        speed_mps: 8.0,
    };
    let mut world = World::new(traffic(vec![actor("attacker", attack, vec![])]));
    let mut least_m = f64::INFINITY;
    let mut state_before = world.states()[0];
    for _ in 0..80 {
        world.step(100_000, &at_rest(DVec3::ZERO), &mut |sub_step| {
            let state = sub_step.after[0];
            let way_m =
                state.world_from_actor.position_m - state_before.world_from_actor.position_m;
            assert!(way_m.length() < 0.5, "no jump between plans: {way_m}");
            state_before = state;
        });
        let to_ego_m = world.states()[0].world_from_actor.position_m - 1.3 * DVec3::X;
        least_m = least_m.min(to_ego_m.length());
    }
    assert!(least_m < 2.0, "{least_m}");
}

/// Fifty actors of every behaviour on a winding road.
fn fifty() -> Vec<Actor> {
    let road = winding();
    let back = Arc::new(road.reversed());
    let mut random = Random::new(3, "fifty", 0);
    let mut actors = Vec::new();
    for index in 0..50 {
        let name = format!("actor-{index}");
        let station_m = 11.0 * f64::from(index) + random.range(0.0, 4.0);
        let speed_mps = random.range(2.0, 12.0);
        let behaviour = match index % 5 {
            0 => follow(&road, station_m, speed_mps, Some(Idm::WILDCITY)),
            1 => follow(&back, station_m, speed_mps, Some(Idm::HUGSIM)),
            2 => follow(&road, station_m, speed_mps, None),
            3 => {
                let key = |time_us: i64| TrackKeyframe {
                    time_us,
                    world_from_actor: Pose {
                        position_m: road.point_m(station_m) + 1e-6 * time_us as f64 * DVec3::Y,
                        rotation: DQuat::from_rotation_z(1e-7 * time_us as f64),
                    },
                };
                Behaviour::from(Track::new((0..40).map(|k| key(k * 500_000)).collect()).unwrap())
            }
            _ => Behaviour::Attack {
                attack: Attack { plan_us: 750_000, best: 10 },
                world_from_actor: road.at(station_m),
                speed_mps,
            },
        };
        let script = match index % 5 {
            0..=2 => vec![Trigger {
                when: Condition {
                    near: Some(Near { actor: None, within_m: 60.0 }),
                    ..Condition::default()
                },
                then: vec![
                    Action::Offset { to_m: random.range(-2.0, 2.0), over_s: 2.5 },
                    Action::Speed { to_mps: speed_mps * 0.5, rate_mps2: 1.5 },
                ],
            }],
            _ => vec![],
        };
        actors.push(actor(&name, behaviour, script));
    }
    actors
}

/// The ego drives along the road and back.
fn ego_at(road: &Course, step: u32) -> EgoState {
    let station_m = 300.0 - 250.0 * (f64::from(step) * 1e-4).cos();
    let pose = road.at(station_m);
    let speed_mps = 2.5 * (f64::from(step) * 1e-4).sin();
    let velocity_mps = pose.rotation * (speed_mps * DVec3::X);
    EgoState { world_from_rig: pose, velocity_mps, yaw_rate_radps: 0.0 }
}

/// All bits of a state but its index.
fn bits(state: &ActorState) -> Vec<u64> {
    let pose = state.world_from_actor;
    let mut bits: Vec<u64> = Vec::new();
    bits.extend(pose.position_m.to_array().map(f64::to_bits));
    bits.extend(pose.q_wxyz().map(f64::to_bits));
    bits.extend(state.velocity_mps.to_array().map(f64::to_bits));
    bits.extend([state.yaw_rate_radps.to_bits(), u64::from(state.present)]);
    bits
}

/// Runs two orders of the same actors side by side, and compares every state bit by bit.
fn compare_orders(steps: u32, dt_us: i64) {
    let actors = fifty();
    let count = actors.len();
    // Every actor by itself goes to (17 i + 5) mod 50.
    let place = |index: usize| (17 * index + 5) % count;
    let mut shuffled = actors.clone();
    for (index, actor) in actors.iter().enumerate() {
        shuffled[place(index)] = actor.clone();
    }
    let road = winding();
    let mut one = World::new(traffic(actors));
    let mut other = World::new(traffic(shuffled));
    let mut moved = 0;
    for step in 0..steps {
        let ego =
            EgoMotion { from: ego_at(&road, step), to: ego_at(&road, step + 1), smooth: true };
        let begin = one.states().to_vec();
        one.step(dt_us, &ego, &mut |_| {});
        other.step(dt_us, &ego, &mut |_| {});
        for (index, before) in begin.iter().enumerate() {
            let [a, b] = [one.states()[index], other.states()[place(index)]];
            if bits(&a) != bits(&b) {
                panic!("step {step}, actor {index}: {a:?} is not {b:?}");
            }
            assert!(a.world_from_actor.position_m.is_finite(), "step {step}, actor {index}");
            moved += u32::from(a != *before);
        }
    }
    assert!(moved > steps, "only {moved} moves: nothing was compared");
}

#[test]
fn the_order_of_actors_does_not_matter() {
    compare_orders(300, 100_000);
}

/// A hash of the bits of all states after every step, actor by actor, of a world in which each
/// actor lies at `place(index)` of the list.
fn episode_hash(steps: u32, place: &dyn Fn(usize) -> usize) -> u64 {
    let actors = fifty();
    let mut listed = actors.clone();
    for (index, actor) in actors.iter().enumerate() {
        listed[place(index)] = actor.clone();
    }
    let road = winding();
    let mut world = World::new(traffic(listed));
    let mut hash = DefaultHasher::new();
    for step in 0..steps {
        let ego =
            EgoMotion { from: ego_at(&road, step), to: ego_at(&road, step + 1), smooth: true };
        world.step(10_000, &ego, &mut |_| {});
        for index in 0..actors.len() {
            bits(&world.states()[place(index)]).hash(&mut hash);
        }
    }
    hash.finish()
}

/// 100,000 steps of 50 actors: alone, and then in three orders at the same time, each on a thread
/// of its own.
#[test]
#[ignore = "a minute; run it after a change of traffic: cargo test -p wildcity-sim --test sim -- --ignored hundred_thousand"]
fn a_hundred_thousand_steps_are_deterministic() {
    const STEPS: u32 = 100_000;
    let alone = episode_hash(STEPS, &|index| index);
    std::thread::scope(|scope| {
        let orders = [(1, 0), (17, 5), (49, 49)];
        let running = orders.map(|(factor, first)| {
            scope.spawn(move || episode_hash(STEPS, &|index| (factor * index + first) % 50))
        });
        for (run, order) in running.into_iter().zip(orders) {
            assert_eq!(run.join().unwrap(), alone, "order {order:?}");
        }
    });
    assert_ne!(episode_hash(1, &|index| index), alone);
}

#[test]
fn steps_of_another_length_give_the_same_bits() {
    let road = winding();
    let run = |dt_us: i64| {
        let mut world = World::new(traffic(fifty()));
        let ego = EgoMotion::standing(ego_at(&road, 20_000));
        while world.time_us() < 10_000_000 {
            world.step(dt_us, &ego, &mut |_| {});
        }
        world.states().iter().flat_map(bits).collect::<Vec<_>>()
    };
    let tenth = run(100_000);
    assert!(tenth == run(500_000) && tenth == run(10_000_000), "states differ");
}

#[test]
fn a_world_that_is_cloned_goes_on_alike() {
    let road = winding();
    let mut world = World::new(traffic(fifty()));
    let ego = EgoMotion::standing(ego_at(&road, 0));
    world.step(1_000_000, &ego, &mut |_| {});
    let mut clone = world.clone();
    let threads = std::thread::spawn(move || {
        clone.step(5_000_000, &ego, &mut |_| {});
        clone
    });
    world.step(5_000_000, &ego, &mut |_| {});
    assert_eq!(world, threads.join().unwrap());
}
