//! The formulas of traffic against the shared vectors.

use glam::DVec2;
use serde_json::Value;

use wildcity_scene::random::Random;
use wildcity_sim::route::turn;
use wildcity_sim::scenario::NavigationCommand;
use wildcity_sim::traffic::{Idm, attack, rolled};

use crate::vectors::{assert_near, cases, number};

/// The variant of a case, whose parameters must be those that the case lists.
fn variant(input: &Value) -> Idm {
    let idm = match input["kind"].as_str().unwrap() {
        "nuplan" => Idm::NUPLAN,
        "navsim_pdm" => Idm::NAVSIM,
        "hugsim" => Idm::HUGSIM,
        "wildcity" => Idm::WILDCITY,
        other => panic!("{other}"),
    };
    let listed = Idm {
        free_speed_mps: number(&input["v0"]),
        least_gap_m: number(&input["s0"]),
        headway_s: number(&input["T"]),
        acceleration_mps2: number(&input["a"]),
        braking_mps2: number(&input["b"]),
        exponent: number(&input["delta"]),
        bracket: input["bracket"].as_bool().unwrap(),
        gap_floor_m: number(&input["floor_m"]),
        clipped: input["clip"].as_bool().unwrap(),
    };
    assert_eq!(idm, listed);
    idm
}

#[test]
fn accelerations_of_the_driver_models_are_those_of_their_programs() {
    let Some(cases) = cases("idm", "") else { return };
    assert_eq!(cases.len(), 19);
    for case in cases {
        let [speed, lead, gap] = ["v", "v_lead", "gap_m"].map(|name| number(&case.input[name]));
        let acceleration = variant(&case.input).acceleration(speed, lead, gap);
        assert_near(acceleration, &case.expected["acceleration"], &case.name);
    }
}

#[test]
fn actors_roll_and_stop_exactly() {
    let Some(cases) = cases("own", "an actor ") else { return };
    assert_eq!(cases.len(), 4);
    for case in cases {
        let [v, a, dt] = ["v", "a", "dt"].map(|name| number(&case.input[name]));
        let [way_m, speed_mps] = rolled(v, a, dt);
        assert_near(way_m, &case.expected["x"], &case.name);
        assert_near(speed_mps, &case.expected["v"], &case.name);
    }
}

#[test]
fn streams_of_random_numbers_are_those_of_the_vectors() {
    let Some(cases) = cases("own", "stream of") else { return };
    assert_eq!(cases.len(), 4);
    for case in cases {
        let seed = case.input["seed"].as_u64().unwrap();
        let index = case.input["index"].as_u64().unwrap() as usize;
        let mut random = Random::new(seed, case.input["what"].as_str().unwrap(), index);
        for unit in case.expected["unit"].as_array().unwrap() {
            assert_eq!(random.unit(), number(unit), "{}", case.name);
        }
    }
}

#[test]
fn the_cost_of_an_attack_is_that_of_hugsim() {
    let Some(cases) = cases("hugsim", "attack") else { return };
    let points = |value: &Value| -> attack::Points {
        let points = value.as_array().unwrap();
        std::array::from_fn(|at| DVec2::new(number(&points[at][0]), number(&points[at][1])))
    };
    for case in cases {
        let attacked = points(&case.input["attacked"]);
        let neighbours = case.input["neighbours"].as_array().unwrap();
        let neighbours: Vec<_> = neighbours.iter().map(points).collect();
        let candidates = case.input["candidates"].as_array().unwrap();
        let plans: Vec<_> = candidates.iter().map(points).collect();
        let costs_m = attack::costs_m(&plans, &attacked, &neighbours);
        for (cost_m, expected) in costs_m.iter().zip(case.expected["cost"].as_array().unwrap()) {
            assert_near(*cost_m, expected, &case.name);
        }
        let best = (0..costs_m.len()).min_by(|a, b| costs_m[*a].total_cmp(&costs_m[*b]));
        assert_eq!(best.unwrap() as u64, case.expected["chosen"].as_u64().unwrap());
    }
}

#[test]
fn commands_turn_beyond_two_metres() {
    let Some(cases) = cases("neuroncap", "command") else { return };
    assert_eq!(cases.len(), 4);
    for case in cases {
        let command = match case.expected["command"].as_str().unwrap() {
            "left" => NavigationCommand::Left,
            "right" => NavigationCommand::Right,
            _ => NavigationCommand::Straight,
        };
        assert_eq!(turn(number(&case.input["route"][0][1])), command, "{}", case.name);
    }
}
