//! Ten thousand damaged files: scenarios, tracks and maps, of every format. None may panic, and
//! each error has a place and a message.

use serde_json::{Value, json};

use wildcity_convert::{geojson, opendrive, openscenario};
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_sim::map::{Map, MapFile};
use wildcity_sim::scenario::{Document, NoAssets, Scenario, Surroundings, TracksFile};
use wildcity_sim::traffic::{EgoMotion, EgoState, World};

/// Files of each kind are damaged so often.
const DAMAGES: usize = 2_000;

fn drive() -> Trajectory {
    let keyframe = |i: i64| Keyframe {
        time_us: i * 50_000,
        world_from_rig: Pose {
            position_m: glam::DVec3::new(0.5 * i as f64, 0.0, 0.0),
            ..Pose::IDENTITY
        },
    };
    Trajectory { name: "log".into(), keyframes: (0..=400).map(keyframe).collect() }
}

fn tracks() -> Value {
    json!({"format": "wildcity.tracks/1", "tracks": [
        {"id": "a3", "class": "vehicle", "size": [4.5, 1.8, 1.5], "keyframes": [
            {"time_us": 0, "pose": {"xyz": [0, 3, 0], "yaw_rad": 0.1}},
            {"time_us": 500000, "pose": {"xyz": [5, 3, 0], "q": [1, 0, 0, 0]}}]}]})
}

fn map() -> MapFile {
    geojson::read(crate::geojson::own().as_bytes(), None).unwrap()
}

/// A scenario with every section and every behaviour.
fn scenario() -> Value {
    json!({
        "format": "wildcity.scenario/1", "name": "all", "note": "every section",
        "twin": {"name": "street", "version_hash": "ab".repeat(32)},
        "map": {"file": "map.json"},
        "ego": {"start": {"trajectory": "log", "station_m": 40}, "jitter_frames": 2,
                "dynamics": {"model": "dynamic", "speed": 8.5}, "warm_up_us": 1600000,
                "box": {"size": [5.393, 2.109, 1.503], "center_x": 1.3}},
        "route": {"trajectory": "log", "commands": [{"station_m": 120, "command": "left", "text": "in {m} m"}]},
        "tracks": {"file": "tracks.json", "without": []},
        "actors": [
            {"name": "van", "idm": {"along": "log", "offset_m": -3.5, "station_m": 55, "speed": "$v", "v0": 9},
             "jitter": {"longitudinal_m": 5, "lateral_m": 0.5},
             "script": [{"name": "in", "when": {"within_m": 20, "time_s": 1}, "do": [{"offset": {"to_m": 0, "over_s": 3}}]},
                        {"when": {"after": "in", "delay_s": 2}, "do": [{"speed": {"to": 3, "rate": 2}}, {"stop": {"rate": 3}}]},
                        {"when": {"station_m": 90}, "do": [{"path": {"lanes": ["a", "b"]}}, {"remove": {}}]}]},
            {"name": "walker", "class": "pedestrian", "path": {"points": [[80, -5, 0], [80, 5, 0]], "speed": 1.34}},
            {"name": "copy", "log": {"track": "a3"}},
            {"name": "cross", "collide": {"along": "log", "station_m": 80, "time_s": 5, "angle_rad": 1.57, "speed": 6}},
            {"name": "front", "collide": {"positions": [{"time_s": 0, "xyz": [150, 0, 0]}, {"time_s": 9, "xyz": [0, 0, 0]}]},
             "jitter": {"longitudinal_m": 3, "lateral_m": 1, "yaw_rad": 0.1}},
            {"name": "foe", "attack": {"pose": {"xyz": [20, 3, 0]}, "speed": 8, "ticks": 3, "best_k": 2}},
            {"name": "box", "class": "object", "stand": {"xyz": [100, 3, 0], "yaw_rad": 1}, "present": false,
             "script": [{"when": {"ego_station_m": 50}, "do": [{"spawn": {}}]}]}],
        "sweep": {"seeds": [0, 4], "v": [6, 8, 10]},
        "end": {"time_s": 30, "off_route_m": 10, "contact": "any", "stuck_s": 60},
        "verdict": {"progress": 0.8}})
}

/// A few bytes changed, removed, repeated, or replaced by what files have.
fn damage(text: &[u8], random: &mut Random) -> Vec<u8> {
    const WORDS: [&str; 14] = [
        "null",
        "-1",
        "1e308",
        "1e999",
        "[]",
        "{}",
        "\"\"",
        "0",
        "true",
        "\"$v\"",
        "[[[[",
        "NaN",
        "-0.0",
        "9223372036854775807",
    ];
    let mut bytes = text.to_vec();
    for _ in 0..1 + random.below(3) {
        let at = random.below(bytes.len());
        let to = (at + 1 + random.below(12)).min(bytes.len());
        match random.below(5) {
            0 => bytes[at] = random.seed() as u8,
            1 => drop(bytes.drain(at..to)),
            2 => {
                let part = bytes[at..to].to_vec();
                bytes.splice(at..at, part);
            }
            // Replace a whole value: from a colon to the next comma or bracket.
            _ => {
                let Some(colon) = bytes[at..].iter().position(|b| *b == b':') else { continue };
                let from = at + colon + 1;
                let end = bytes[from..].iter().position(|b| b",]}".contains(b));
                let to = end.map_or(bytes.len(), |end| from + end);
                let word = WORDS[random.below(WORDS.len())];
                bytes.splice(from..to, word.bytes());
            }
        }
        if bytes.is_empty() {
            bytes.push(b'{');
        }
    }
    bytes
}

#[test]
fn the_whole_scenario_resolves_and_runs() {
    // Seven of the file, and the recorded one.
    assert_eq!(run(&serde_json::to_vec(&scenario()).unwrap()), Ok(8));
}

/// Resolves a scenario with its first values and runs it for two seconds. Returns the number of
/// actors.
fn run(text: &[u8]) -> Result<usize, String> {
    let document = Document::parse(text).map_err(|error| told(&error.path, &error.message))?;
    let refused = |error: wildcity_sim::scenario::FileError| told(&error.path, &error.message);
    assert!(!document.cases().is_empty());
    let file = document.with(&document.first_values()).map_err(refused)?;
    let drives = [drive()];
    let tracks = TracksFile::parse(tracks().to_string().as_bytes()).unwrap();
    let map = Map::new(map()).unwrap();
    let around =
        Surroundings { drives: &drives, tracks: Some(&tracks), map: Some(&map), assets: &NoAssets };
    let scenario = Scenario::resolve(file, 3, &around).map_err(refused)?;
    // What was resolved resolves again to the same.
    let again = Scenario::resolve(scenario.file.clone(), 99, &around).map_err(refused)?;
    assert_eq!(again.traffic, scenario.traffic);
    let mut world = World::new(scenario.traffic.clone());
    let ego = EgoMotion::standing(EgoState {
        world_from_rig: drives[0].at_station(60.0),
        velocity_mps: glam::DVec3::ZERO,
        yaw_rate_radps: 0.0,
    });
    for _ in 0..4 {
        world.step(500_000, &ego, &mut |sub_step| {
            for state in sub_step.after.iter().filter(|state| state.present) {
                assert!(state.world_from_actor.position_m.is_finite(), "{state:?}");
            }
        });
    }
    Ok(world.states().len())
}

/// A refusal, which must name a place and say something.
fn told(place: &str, message: &str) -> String {
    // The place of an unknown field at the top whose name is empty is empty.
    let names_place = !place.is_empty() || message.contains("field ``");
    assert!(names_place && message.len() > 3, "{place:?}: {message:?}");
    format!("{place}: {message}")
}

/// Damages a text many times. Returns how many of them were refused.
fn refusals(name: &str, text: &[u8], read: impl Fn(&[u8]) -> Result<(), String>) -> usize {
    let mut refused = 0;
    for index in 0..DAMAGES {
        let damaged = damage(text, &mut Random::new(11, name, index));
        refused += usize::from(read(&damaged).is_err());
    }
    // Most damage is found, and some leaves a valid file: then both ways were tried.
    assert!(refused > DAMAGES / 4 && refused < DAMAGES, "{name}: {refused} of {DAMAGES}");
    refused
}

#[test]
fn damaged_scenarios_are_refused_or_run() {
    let text = serde_json::to_vec(&scenario()).unwrap();
    refusals("scenario", &text, |text| run(text).map(|_| ()));
}

#[test]
fn damaged_tracks_are_refused() {
    let text = tracks().to_string();
    refusals("tracks", text.as_bytes(), |text| {
        TracksFile::parse(text).map(|_| ()).map_err(|error| told(&error.path, &error.message))
    });
}

#[test]
fn damaged_maps_are_refused() {
    let text = map().to_json();
    refusals("map", text.as_bytes(), |text| {
        let map = MapFile::parse(text).and_then(Map::new);
        map.map(|_| ()).map_err(|error| told(&error.path, &error.message))
    });
    refusals("geojson", crate::geojson::own().as_bytes(), |text| {
        let map = geojson::read(text, Some([10.0, 48.0]));
        map.map(|_| ()).map_err(|error| told(&error.place, &error.message))
    });
}

#[test]
fn damaged_files_of_others_are_refused() {
    refusals("opendrive", crate::opendrive::ROADS.as_bytes(), |text| {
        let map = opendrive::read(text, None);
        map.map(|_| ()).map_err(|error| told(&error.place, &error.message))
    });
    refusals("openscenario", crate::openscenario::CUT_IN.as_bytes(), |text| {
        let file = openscenario::read(text, &crate::openscenario::settings());
        file.map(|_| ()).map_err(|error| told(&error.place, &error.message))
    });
}
