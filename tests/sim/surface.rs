//! Actors stand on the surface of what they follow: of a recorded drive, or of the lanes of a map.

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_sim::map::{Map, MapFile};
use wildcity_sim::scenario::{Document, NoAssets, Scenario, Surroundings};
use wildcity_sim::traffic::{EgoMotion, EgoState, World};

/// Uphill along x, 5 m above 0 at its start: a rise of 1 m in 10 m.
fn drive() -> Trajectory {
    let rotation = DQuat::from_rotation_y(-(0.1_f64).atan());
    let keyframe = |i: i64| {
        let x_m = 2.0 * i as f64;
        let position_m = DVec3::new(x_m, 0.0, 5.0 + 0.1 * x_m);
        Keyframe { time_us: 200_000 * i, world_from_rig: Pose { position_m, rotation } }
    };
    Trajectory { name: "log".into(), keyframes: (0..=100).map(keyframe).collect() }
}

/// A lane next to it that falls by 1 m in 20 m, from 30 m on.
fn map() -> Map {
    let at = |x_m: f64, y_m: f64| json!([x_m, y_m, 30.0 - 0.05 * x_m]);
    let line = |y_m: f64| -> Value { (0..=20).map(|i| at(10.0 * f64::from(i), y_m)).collect() };
    let file = json!({ "format": "wildcity.map/1", "lanes": [{
        "id": "down", "center": line(6.0), "left": line(8.0), "right": line(4.0) }] });
    Map::new(MapFile::parse(file.to_string().as_bytes()).unwrap()).unwrap()
}

#[test]
fn actors_follow_the_height_and_the_tilt_of_drives_and_lanes() {
    let scenario = json!({
    "format": "wildcity.scenario/1", "name": "hills", "twin": { "name": "street" },
    "map": { "file": "map.json" },
    "actors": [
        { "name": "up", "path": { "along": "log", "station_m": 20, "offset_m": 2, "speed": 10 } },
        { "name": "back", "path": { "along": "log", "station_m": 100, "speed": 5, "reverse": true } },
        { "name": "points", "path": { "points": [[10, 1, 0], [90, 1, 0]], "speed": 8 } },
        { "name": "down", "path": { "lanes": ["down"], "station_m": 10, "speed": 10 } },
    ]});
    let document = Document::parse(scenario.to_string().as_bytes()).unwrap();
    let file = document.with(&document.first_values()).unwrap();
    let (drives, map) = ([drive()], map());
    let around = Surroundings { drives: &drives, tracks: None, map: Some(&map), assets: &NoAssets };
    let scenario = Scenario::resolve(file, 0, &around).unwrap();
    let mut world = World::new(scenario.traffic.clone());
    let far = Pose { position_m: DVec3::new(0.0, 900.0, 0.0), ..Pose::IDENTITY };
    let ego = EgoState { world_from_rig: far, velocity_mps: DVec3::ZERO, yaw_rate_radps: 0.0 };
    let uphill = DVec3::new(-0.1, 0.0, 1.0).normalize();
    let downhill = DVec3::new(0.05, 0.0, 1.0).normalize();
    for _ in 0..20 {
        world.step(100_000, &EgoMotion::standing(ego), &mut |_| {});
        for (state, actor) in world.states().iter().zip(&scenario.traffic.actors) {
            let Pose { position_m, rotation } = state.world_from_actor;
            let (height_m, up) = match &*actor.spec.name {
                "down" => (30.0 - 0.05 * position_m.x, downhill),
                _ => (5.0 + 0.1 * position_m.x, uphill),
            };
            let off_m = (position_m.z - height_m).abs();
            assert!(off_m < 0.01, "{}: {off_m} m off at {position_m}", actor.spec.name);
            let tilt_rad = (rotation * DVec3::Z).angle_between(up);
            assert!(tilt_rad < 1e-3, "{}: {tilt_rad} rad off at {position_m}", actor.spec.name);
        }
    }
    let moved = world.states()[0].world_from_actor.position_m;
    assert!((moved.x - 39.9).abs() < 0.5, "{moved}");
}
