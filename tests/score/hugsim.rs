//! HUGSIM's HD-Score and its parts.

use glam::{DVec2, DVec3};
use serde_json::Value;

use wildcity_score::hugsim::{
    Decision, HugsimBox, PlanPose, decision, drivable, hd_score, route_completion,
};
use wildcity_sim::contact::Footprint;

use crate::vectors::{assert_near, cases, number, numbers};

/// x, y, z, width, length, height, yaw.
fn footprint(row: &[f64]) -> Footprint {
    Footprint::new(DVec2::new(row[0], row[1]), row[6], row[4], row[3])
}

fn hugsim_box(value: &Value) -> HugsimBox {
    let row = numbers(value);
    HugsimBox { footprint: footprint(&row), bottom_m: row[2], height_m: row[5] }
}

fn points3(value: &Value) -> Vec<DVec3> {
    value.as_array().unwrap().iter().map(|row| DVec3::from_slice(&numbers(row))).collect()
}

fn points2(value: &Value) -> Vec<DVec2> {
    value.as_array().unwrap().iter().map(|row| DVec2::from_slice(&numbers(row))).collect()
}

fn plan(value: &Value) -> Vec<PlanPose> {
    let rows = value.as_array().unwrap().iter().map(numbers);
    rows.map(|row| PlanPose { position_m: DVec2::new(row[0], row[1]), yaw_rad: row[2] }).collect()
}

#[test]
fn static_collisions_are_as_in_the_vectors() {
    let Some(cases) = cases("hugsim", "static") else { return };
    for case in cases {
        let ego = hugsim_box(&case.input["box"]);
        let points_m = points3(&case.input["points"]);
        assert_eq!(ego.points_within(&points_m), case.expected["within"], "{}", case.name);
        assert_eq!(ego.hits_static(&points_m), case.expected["collides"], "{}", case.name);
    }
}

#[test]
fn drivable_areas_are_as_in_the_vectors() {
    let Some(cases) = cases("hugsim", "drivable") else { return };
    for case in cases {
        let ego = hugsim_box(&case.input["box"]).footprint;
        let found =
            drivable(&points2(&case.input["ground"]), &plan(&case.input["trajectory"]), &ego);
        assert_near(found, &case.expected["dac"], &case.name);
    }
}

#[test]
fn decisions_are_as_in_the_vectors() {
    let Some(cases) = cases("hugsim", "frame") else { return };
    for case in cases {
        let frames = case.input["objects"].as_array().unwrap().iter();
        let objects: Vec<Vec<Footprint>> = frames
            .map(|frame| {
                frame.as_array().unwrap().iter().map(|row| footprint(&numbers(row))).collect()
            })
            .collect();
        let found = decision(&Decision {
            ego: hugsim_box(&case.input["box"]),
            yaw_rad: number(&case.input["box"][6]),
            plan: &plan(&case.input["plan"]),
            objects: &objects,
            points_m: &points3(&case.input["points"]),
            ground_m: &points2(&case.input["ground"]),
        });
        for (key, value) in [
            ("nc", found.nc),
            ("dac", found.dac),
            ("ttc", found.ttc),
            ("c", found.c),
            ("pdms", found.pdms()),
        ] {
            assert_near(value, &case.expected[key], &format!("{}: {key}", case.name));
        }
    }
}

/// A constant acceleration has no jerk: only the bounds of the acceleration decide.
#[test]
fn the_comfort_of_a_plan_is_within_the_bounds_of_its_acceleration() {
    let comfort = |acceleration_mps2: f64| {
        let pose = |k: i32| {
            let time_s = 0.5 * f64::from(k);
            let way_m = 10.0 * time_s + 0.5 * acceleration_mps2 * time_s * time_s;
            PlanPose { position_m: DVec2::new(way_m, 0.0), yaw_rad: 0.0 }
        };
        let plan: Vec<PlanPose> = (1..=4).map(pose).collect();
        let ego = HugsimBox {
            footprint: Footprint::new(DVec2::ZERO, 0.0, 3.0, 1.6),
            bottom_m: 0.0,
            height_m: 1.5,
        };
        let around =
            Decision { ego, yaw_rad: 0.0, plan: &plan, objects: &[], points_m: &[], ground_m: &[] };
        decision(&around).c
    };
    for (acceleration_mps2, expected) in [(2.3, 1.0), (2.5, 0.0), (-4.0, 1.0), (-4.1, 0.0)] {
        assert_eq!(comfort(acceleration_mps2), expected, "{acceleration_mps2} m/s²");
    }
}

#[test]
fn the_score_is_as_in_the_vectors() {
    let Some(scores) = cases("hugsim", "hd-score") else { return };
    for case in scores {
        let found = hd_score(&numbers(&case.input["pdms"]), &numbers(&case.input["rc"]));
        assert_near(found, &case.expected["hd_score"], &case.name);
    }
    for case in cases("hugsim", "route completion").unwrap() {
        let [nearest, cameras] =
            ["nearest_camera", "cameras"].map(|key| case.input[key].as_u64().unwrap() as usize);
        assert_near(route_completion(nearest, cameras), &case.expected["rc"], &case.name);
    }
}
