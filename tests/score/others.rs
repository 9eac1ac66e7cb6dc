//! NeuroNCAP, Bench2Drive and AlpaSim.

use glam::DVec2;
use serde_json::{Value, json};

use wildcity_score::alpasim::{self, Collision, Rollout, Side};
use wildcity_score::bench2drive::{self, Infraction, MotionSample};
use wildcity_score::{EgoSample, alpasim_plans, neuroncap};
use wildcity_sim::contact::Footprint;

use crate::vectors::{assert_near, cases, number, numbers};

#[test]
fn stars_are_as_in_the_vectors() {
    let Some(cases) = cases("neuroncap", "score") else { return };
    for case in cases {
        let velocity = |key: &str| {
            let value = &case.input[key];
            (!value.is_null()).then(|| DVec2::from_slice(&numbers(value)))
        };
        let impact = velocity("ego_velocity")
            .zip(velocity("actor_velocity"))
            .map(|(ego, actor)| neuroncap::impact_speed_mps(ego, actor));
        match impact {
            Some(impact) => assert_near(impact, &case.expected["impact_speed"], &case.name),
            None => assert!(case.expected["impact_speed"].is_null(), "{}", case.name),
        }
        let found = neuroncap::stars(impact, number(&case.input["reference_speed"]));
        assert_near(found, &case.expected["score"], &case.name);
    }
}

#[test]
fn a_collision_between_two_steps_is_found_at_the_published_sub_step() {
    let Some(cases) = cases("neuroncap", "a collision between") else { return };
    for case in cases {
        let ego = ["from_x", "to_x"].map(|key| {
            let origin_m = DVec2::new(number(&case.input[key]), 0.0);
            neuroncap::EGO.footprint(&EgoSample { origin_m, ..EgoSample::default() })
        });
        let obstacle = &case.input["obstacle"];
        let center_m = DVec2::new(number(&obstacle["x"]), 0.0);
        let size = ["length", "width"].map(|key| number(&obstacle[key]));
        let other = Footprint::new(center_m, 0.0, size[0], size[1]);
        let sub_steps = case.input["sub_steps"].as_u64().unwrap() as usize;
        let found = neuroncap::first_touching_sub_step(ego, [other; 2], sub_steps);
        assert_eq!(json!(found), case.expected["first_sub_step"], "{}", case.name);
        let at_ends = ego.iter().any(|ego| ego.touches(&other));
        assert_eq!(at_ends, case.expected["at_ends_alone"], "{}", case.name);
    }
}

fn infraction(name: &Value) -> Infraction {
    match name.as_str().unwrap() {
        "pedestrian" => Infraction::Pedestrian,
        "vehicle" => Infraction::Vehicle,
        "static" => Infraction::Static,
        "red_light" => Infraction::RedLight,
        "min_speed" => Infraction::MinSpeed,
        other => panic!("{other}"),
    }
}

#[test]
fn driving_scores_are_as_in_the_vectors() {
    let Some(cases) = cases("bench2drive", "driving score") else { return };
    for case in cases {
        let route = number(&case.input["route_percent"]);
        let outside = number(&case.input["outside_percent"]);
        let events: Vec<_> =
            case.input["events"].as_array().unwrap().iter().map(infraction).collect();
        let found = bench2drive::driving_score(route, &events, outside);
        assert_near(found, &case.expected["driving_score"], &case.name);
        let success = bench2drive::is_success(route, &events, outside);
        assert_eq!(success, case.expected["success"], "{}", case.name);
    }
}

#[test]
fn every_infraction_has_its_published_factor() {
    // statistics_manager.py, PENALTY_VALUE_DICT.
    for (infraction, factor) in [
        (Infraction::Pedestrian, 0.5),
        (Infraction::Vehicle, 0.6),
        (Infraction::Static, 0.65),
        (Infraction::RedLight, 0.7),
        (Infraction::Stop, 0.8),
        (Infraction::ScenarioTimeout, 0.7),
        (Infraction::Yield, 0.7),
        (Infraction::MinSpeed, 1.0),
    ] {
        let score = bench2drive::driving_score(100.0, &[infraction], 0.0);
        assert_eq!(score, 100.0 * factor, "{infraction:?}");
    }
}

#[test]
fn efficiency_and_smoothness_are_as_in_the_vectors() {
    let Some(efficiencies) = cases("bench2drive", "efficiency") else { return };
    for case in efficiencies {
        let found = bench2drive::efficiency(&numbers(&case.input["percent_of_traffic"]));
        assert_near(found.unwrap(), &case.expected["efficiency"], &case.name);
    }
    for case in cases("bench2drive", "smoothness").unwrap() {
        let vector = |value: &Value| DVec2::from_slice(&numbers(value)[..2]);
        let rows = case.input["acceleration"].as_array().unwrap().iter();
        let samples: Vec<MotionSample> = rows
            .map(|row| MotionSample {
                acceleration_mps2: vector(row),
                forward: vector(&case.input["forward"]),
                right: vector(&case.input["right"]),
                angular_velocity_degps: number(&case.input["angular_velocity"][2]),
            })
            .collect();
        let segments = bench2drive::smooth_segments(&samples).unwrap();
        assert_eq!(json!(segments), case.expected["segments"], "{}", case.name);
        let found = bench2drive::smoothness(&segments);
        assert_near(found, &case.expected["smoothness"], &case.name);
    }
}

#[test]
fn scene_scores_are_as_in_the_vectors() {
    let Some(cases) = cases("alpasim", "scene score") else { return };
    for case in cases {
        let found = alpasim::scene_score(&Rollout {
            progress: number(&case.input["progress_clipped_rel"]),
            recorded_m: number(&case.input["gt_dist_traveled_m"]),
            collision_at_fault: number(&case.input["collision_at_fault"]) != 0.0,
            offroad: number(&case.input["offroad"]) != 0.0,
        });
        assert_near(found, &case.expected["score"], &case.name);
    }
}

fn name(side: Side) -> &'static str {
    match side {
        Side::Front => "front",
        Side::Rear => "rear",
        Side::Lateral => "lateral",
    }
}

#[test]
fn sides_of_collisions_are_as_in_the_vectors() {
    let Some(cases) = cases("alpasim", "collision") else { return };
    for case in cases {
        let footprint = |value: &Value| {
            let of = |key: &str| value[key].as_f64().unwrap_or(0.0);
            Footprint::new(DVec2::new(of("x"), of("y")), of("yaw"), of("length"), of("width"))
        };
        let ego = footprint(&case.input["ego"]);
        let others = case.input["others"].as_array().unwrap().iter().map(footprint);
        let sides: Vec<Side> = others.filter_map(|other| alpasim::side(&ego, &other)).collect();
        let expected = &case.expected;
        let names: Vec<&str> = sides.iter().copied().map(name).collect();
        assert_eq!(json!(names), expected["each"], "{}", case.name);
        let collision = Collision::from_sides(&sides);
        let published = expected["as_published"].as_object().unwrap();
        for (side, hit) in published {
            let found = collision.published.map(name) == Some(side.as_str());
            assert_eq!(found, *hit, "{}: {side}", case.name);
        }
        assert_eq!(collision.is_at_fault(), expected["at_fault_as_published"], "{}", case.name);
        assert_eq!(collision.any_at_fault, expected["at_fault_of_any"], "{}", case.name);
    }
}

#[test]
fn plan_deviation_is_as_in_the_vector() {
    let Some(cases) = cases("alpasim", "plan deviation") else { return };
    for case in cases {
        let distances_m = numbers(&case.input["distances"]);
        let found =
            alpasim_plans::plan_deviation(&distances_m, number(&case.input["decay"])).unwrap();
        assert_near(found, &case.expected["deviation"], &case.name);
    }
}
