//! NAVSIM's rules, comfort and score.

use glam::DVec2;
use serde_json::Value;

use wildcity_scene::ActorClass;
use wildcity_score::navsim::{
    self, Rules, STATES, STEP_S, Scene, Submetrics, comfort_signals, epdms, extended_comfort,
    is_within,
};
use wildcity_score::{EgoSample, EgoShape, Lane, LaneMap, Polyline, RedArea, Track, TrackSample};
use wildcity_sim::contact::{CollisionType, Footprint};

use crate::vectors::{assert_near, cases, number, numbers};

/// [x, y, heading, vx, vy, ax, ay, steering, steering rate, yaw rate, yaw acceleration] of the rear
/// axle.
fn states(value: &Value) -> Vec<EgoSample> {
    let rows = value.as_array().unwrap().iter().map(numbers);
    rows.map(|row| EgoSample {
        origin_m: DVec2::new(row[0], row[1]),
        yaw_rad: row[2],
        velocity_mps: DVec2::new(row[3], row[4]),
        acceleration_mps2: DVec2::new(row[5], row[6]),
        yaw_rate_radps: row[9],
        yaw_acceleration_radps2: row[10],
    })
    .collect()
}

fn shape(value: &Value) -> EgoShape {
    EgoShape {
        length_m: number(&value["length"]),
        width_m: number(&value["width"]),
        center_x_m: number(&value["rear_axle_to_center"]),
    }
}

fn class(name: &Value) -> ActorClass {
    match name.as_str().unwrap() {
        "vehicle" => ActorClass::Vehicle,
        "pedestrian" => ActorClass::Pedestrian,
        "bicycle" => ActorClass::Bicycle,
        _ => ActorClass::Object,
    }
}

fn track(value: &Value) -> Track {
    let velocity_mps = DVec2::new(number(&value["vx"]), number(&value["vy"]));
    let start_m = DVec2::new(number(&value["x"]), number(&value["y"]));
    let size = ["yaw", "length", "width"].map(|key| number(&value[key]));
    let at = |step: usize| {
        let center_m = start_m + velocity_mps * STEP_S * step as f64;
        let footprint = Footprint::new(center_m, size[0], size[1], size[2]);
        Some(TrackSample { footprint, velocity_mps })
    };
    let samples = (0..STATES).map(at).collect();
    Track { name: "track".to_owned(), class: class(&value["class"]), samples }
}

fn rectangle(x_m: [f64; 2], y_m: [f64; 2]) -> Vec<DVec2> {
    let corner = |i: usize, j: usize| DVec2::new(x_m[i], y_m[j]);
    vec![corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)]
}

fn map(input: &Value) -> LaneMap {
    let lane = |row: &Value| Lane {
        center: None,
        outline_m: rectangle(
            [number(&row[1]), number(&row[2])],
            [number(&row[3]), number(&row[4])],
        ),
        is_on_route: row[5].as_bool().unwrap(),
        is_intersection: false,
    };
    let lanes = input["lanes"].as_array().unwrap().iter().map(lane).collect();
    let ends_m = [-50.0, 150.0].map(|x_m| DVec2::new(x_m, 0.0));
    let red = input["red_from_x"].as_f64().map(|from_m| RedArea {
        outline_m: rectangle([from_m, from_m + 20.0], [-1.75, 1.75]),
        samples: 0..STATES,
    });
    LaneMap {
        lanes,
        centerline: Polyline::new(ends_m.to_vec()).unwrap(),
        red: red.into_iter().collect(),
    }
}

fn scored(input: &Value) -> Rules {
    let tracks: Vec<Track> = input["tracks"].as_array().unwrap().iter().map(track).collect();
    navsim::rules(&Scene {
        shape: shape(&input["ego"]),
        ego: &states(&input["states"]),
        tracks: &tracks,
        map: &map(input),
        reference_progress_m: number(&input["reference_progress_m"]),
    })
}

#[test]
fn rules_are_as_in_the_vectors() {
    let Some(cases) = cases("navsim", "scores") else { return };
    for case in cases {
        let found = scored(&case.input);
        let expected = &case.expected;
        for (key, value) in [
            ("no_at_fault_collisions", found.no_at_fault_collisions),
            ("drivable_area_compliance", found.drivable_area_compliance),
            ("driving_direction_compliance", found.driving_direction_compliance),
            ("traffic_light_compliance", found.traffic_light_compliance),
            ("ego_progress", found.ego_progress),
            ("time_to_collision_within_bound", found.time_to_collision_within_bound),
            ("lane_keeping", found.lane_keeping),
        ] {
            assert_near(value, &expected[key], &format!("{}: {key}", case.name));
        }
        let step = |step: Option<usize>| step.map_or(Value::Null, Value::from);
        assert_eq!(
            step(found.first_at_fault_step),
            expected["first_at_fault_step"],
            "{}",
            case.name
        );
        assert_eq!(step(found.first_ttc_step), expected["first_ttc_step"], "{}", case.name);
        let kinds = found.collision_types.iter().enumerate();
        let kinds: serde_json::Map<String, Value> =
            kinds.filter_map(|(k, kind)| Some((k.to_string(), (*kind)?.name().into()))).collect();
        assert_eq!(Value::Object(kinds), expected["collision_types"], "{}", case.name);
    }
}

#[test]
fn a_standing_ego_is_never_at_fault_even_when_hit_in_front() {
    let input = serde_json::json!({
        "ego": { "width": 2.297, "length": 5.176, "rear_axle_to_center": 1.461 },
        "states": vec![vec![0.0; 11]; STATES],
        "tracks": [{ "x": 20.0, "y": 0.0, "vx": -15.0, "vy": 0.0, "yaw": std::f64::consts::PI, "length": 4.0,
            "width": 2.0, "class": "vehicle" }],
        "reference_progress_m": 0.0,
        "lanes": [["own", -50.0, 150.0, -1.75, 1.75, true]],
    });
    let found = scored(&input);
    assert_eq!(found.collision_types, [Some(CollisionType::StoppedEgo)]);
    assert_eq!(found.no_at_fault_collisions, 1.0);
    // Below 5 mm/s it has no time to collision, though the other drives into it.
    assert_eq!((found.time_to_collision_within_bound, found.first_ttc_step), (1.0, None));
}

#[test]
fn comfort_is_as_in_the_vectors() {
    let Some(cases) = cases("navsim", "comfort") else { return };
    for case in cases {
        let center_x_m = shape(&case.input["ego"]).center_x_m;
        let signals = comfort_signals(&states(&case.input["states"]), STEP_S, center_x_m).unwrap();
        let expected = &case.expected;
        let within: Value = is_within(&signals).to_vec().into();
        assert_eq!(within, expected["within"], "{}", case.name);
        for (at, wanted) in expected["lon_acceleration_at"].as_object().unwrap() {
            let at: usize = at.parse().unwrap();
            assert_near(signals.longitudinal_mps2[at], wanted, &format!("{} at {at}", case.name));
        }
        let largest =
            |values: &[f64]| values.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
        assert_near(largest(&signals.jerk_mps3), &expected["jerk_max"], &case.name);
        assert_near(largest(&signals.yaw_rate_radps), &expected["yaw_rate_max"], &case.name);
    }
}

#[test]
fn extended_comfort_is_as_in_the_vectors() {
    let Some(cases) = cases("navsim", "extended comfort") else { return };
    for case in cases {
        let signals = |key: &str| {
            let center_x_m = navsim::PACIFICA.center_x_m;
            comfort_signals(&states(&case.input[key]), STEP_S, center_x_m).unwrap()
        };
        let found = extended_comfort(&signals("one"), &signals("two"));
        for (rms, wanted) in found.rms.iter().zip(case.expected["rms"].as_array().unwrap()) {
            assert_near(*rms, wanted, &case.name);
        }
        assert_eq!(found.is_within, case.expected["within"], "{}", case.name);
    }
}

/// A lane that holds the whole ego counts, whatever other lane a corner lies in; edges belong to no
/// lane.
#[test]
fn a_lane_of_its_own_is_one_that_holds_all_corners() {
    let lane = |y_m: [f64; 2]| Lane {
        center: None,
        outline_m: rectangle([-10.0, 10.0], y_m),
        is_on_route: false,
        is_intersection: false,
    };
    let centerline = Polyline::new(vec![DVec2::ZERO, DVec2::X]).unwrap();
    let of = |lanes: Vec<Lane>| LaneMap { lanes, centerline: centerline.clone(), red: Vec::new() };
    let ego = Footprint::new(DVec2::ZERO, 0.0, 4.0, 2.0);
    let position = |lanes: Vec<Lane>| {
        let found = of(lanes).position(&ego);
        (found.in_multiple_lanes, found.off_drivable)
    };
    assert_eq!(position(vec![lane([-2.0, 2.0]), lane([0.0, 4.0])]), (false, false));
    assert_eq!(position(vec![lane([-2.0, 0.0]), lane([0.0, 2.0])]), (true, false));
    assert_eq!(position(vec![lane([-1.0, 2.0])]), (false, true), "a corner on the edge");
    let mut oncoming = lane([-2.0, 2.0]);
    assert!(of(vec![oncoming.clone()]).is_off_route(DVec2::ZERO));
    oncoming.is_intersection = true;
    assert!(!of(vec![oncoming]).is_off_route(DVec2::ZERO));
}

fn submetrics(value: &Value) -> Submetrics {
    let of = |key: &str| value[key].as_f64().unwrap_or(1.0);
    Submetrics {
        nc: of("NC"),
        dac: of("DAC"),
        ddc: of("DDC"),
        tlc: of("TLC"),
        ep: of("EP"),
        ttc: of("TTC"),
        lk: of("LK"),
        hc: of("HC"),
        ec: of("EC"),
    }
}

#[test]
fn the_score_is_as_in_the_vectors() {
    let Some(cases) = cases("navsim", "epdms") else { return };
    for case in cases {
        let human = &case.input["human"];
        let human = (!human.is_null()).then(|| submetrics(human));
        let found = epdms(&submetrics(&case.input["agent"]), human.as_ref());
        assert_near(found, &case.expected["epdms"], &case.name);
    }
}

/// At both ends, where the window has no samples beyond, the polynomial of the last window holds.
#[test]
fn the_filter_follows_a_parabola_to_its_ends() {
    let at = |k: i32| 0.1 * f64::from(k);
    let samples: Vec<f64> = (0..12).map(|k| 2.0 - at(k) + 3.0 * at(k) * at(k)).collect();
    let same = wildcity_score::savgol(&samples, 7, 2, 0, 0.1);
    let slopes = wildcity_score::savgol(&samples, 7, 2, 1, 0.1);
    for k in 0..12 {
        let slope = 6.0 * at(k) - 1.0;
        let k = k as usize;
        assert!((same[k] - samples[k]).abs() < 1e-12, "{k}: {}", same[k]);
        assert!((slopes[k] - slope).abs() < 1e-10, "{k}: {}", slopes[k]);
    }
}
