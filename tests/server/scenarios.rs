//! Sessions with scenarios: actors, routes, events, ends and refusals.

use std::fs;

use serde_json::{Value, json};

use crate::http::get;
use crate::support::{Agent, TestServer, pose, refused};

/// On the 9 m of the twin `test`: a car that stands at 8 m, a walker that appears, and a van next
/// to the drive.
fn scenario() -> Value {
    json!({
        "format": "wildcity.scenario/1", "name": "short", "twin": {"name": "test"},
        "ego": {"start": {"trajectory": "log", "station_m": 0}, "warm_up_us": 0,
                "box": {"size": [2.0, 1.0, 1.5], "center_x": 0.0}},
        "actors": [
            {"name": "car", "size": [2.0, 1.0, 1.5], "path": {"along": "log", "station_m": 8, "speed": 0}},
            {"name": "van", "path": {"along": "log", "station_m": 1, "offset_m": 3, "speed": "$v"},
             "jitter": {"longitudinal_m": 0.5, "lateral_m": 0.1},
             "script": [{"name": "slow", "when": {"time_s": 0.2}, "do": [{"stop": {"rate": 5}}]}]},
            {"name": "walker", "class": "pedestrian", "stand": {"xyz": [4, 4, 0]}, "present": false,
             "script": [{"when": {"ego_speed_above": 5}, "do": [{"spawn": {}}]}]}],
        "sweep": {"seeds": [0, 3], "v": [2, 4]},
        "end": {"time_s": 5, "contact": "any"}})
}

/// A server whose directory of scenarios has `short`.
async fn server() -> TestServer {
    let server = TestServer::start().await;
    let dir = server.twins.path().join(".scenarios");
    fs::create_dir(&dir).unwrap();
    fs::write(dir.join("short.json"), scenario().to_string()).unwrap();
    fs::write(dir.join("other.json"), "{\"format\": \"wildcity.map/1\"}").unwrap();
    server
}

fn outputs() -> Value {
    json!({ "cameras": ["front"], "encoding": "raw", "actors": true })
}

/// The metadata of a step to a place on the drive.
async fn to(agent: &mut Agent, x_m: f64) -> Value {
    agent.look(json!({ "type": "step", "pose": pose(x_m) })).await.meta
}

#[tokio::test]
async fn scenarios_are_listed_by_name() {
    let server = server().await;
    let listed = async |server: &TestServer| {
        let (status, answer) = get(server, "/v1/scenarios").await;
        assert_eq!(status, 200, "{answer}");
        serde_json::from_str::<Value>(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap()
    };
    assert_eq!(listed(&server).await, json!({ "scenarios": ["short"] }), "a map is none");
    let without = TestServer::start().await;
    assert_eq!(listed(&without).await, json!({ "scenarios": [] }));
}

#[tokio::test]
async fn the_scenarios_of_a_twin_have_the_lanes_of_their_maps() {
    let server = server().await;
    let dir = server.twins.path().join(".scenarios");
    let lane = |id: &str, kind: &str, y_m: f64| {
        let line = |y_m: f64| json!([[0, y_m, 0], [9, y_m, 0]]);
        let edges = [y_m, y_m + 1.5, y_m - 1.5].map(line);
        json!({"id": id, "kind": kind, "center": edges[0], "left": edges[1], "right": edges[2]})
    };
    let lanes = [lane("a", "driving", 0.0), lane("walk", "sidewalk", 4.0)];
    let map = json!({"format": "wildcity.map/1", "lanes": lanes});
    fs::write(dir.join("road.map.json"), map.to_string()).unwrap();
    let write = |name: &str, twin: &str, map: Option<&str>| {
        let mut scenario = scenario();
        scenario["twin"]["name"] = json!(twin);
        if let Some(file) = map {
            scenario["map"] = json!({ "file": file });
        }
        fs::write(dir.join(format!("{name}.json")), scenario.to_string()).unwrap();
    };
    write("on-road", "test", Some("road.map.json"));
    write("lost", "test", Some("gone.map.json"));
    write("bad-map", "test", Some("bad.map.json"));
    write("bad-map-too", "test", Some("bad.map.json"));
    fs::write(dir.join("bad.map.json"), r#"{"format": "wildcity.map/1", "lanes": 3}"#).unwrap();
    write("elsewhere", "city", Some("road.map.json"));
    fs::write(dir.join("broken.json"), r#"{"format": "wildcity.scenario/1"}"#).unwrap();

    let (status, answer) = get(&server, "/v1/twins/test/scenarios").await;
    assert_eq!(status, 200, "{answer}");
    let answer: Value = serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap();
    let ring = json!([[0.0, 1.5], [9.0, 1.5], [9.0, -1.5], [0.0, -1.5]]);
    let wanted = json!({
        "scenarios": [{"name": "bad-map", "map": "bad.map.json"},
                      {"name": "bad-map-too", "map": "bad.map.json"},
                      {"name": "lost", "map": "gone.map.json"},
                      {"name": "on-road", "map": "road.map.json"}, {"name": "short"}],
        "maps": {"road.map.json": [ring]},
        "omitted_maps": ["bad.map.json", "gone.map.json"],
        "omitted_scenarios": 0,
    });
    assert_eq!(answer, wanted);
    let (unknown, answer) = get(&server, "/v1/twins/nowhere/scenarios").await;
    assert_eq!(unknown, 404, "{answer}");
}

#[tokio::test]
async fn an_episode_tells_actors_route_events_and_its_end() {
    let server = server().await;
    let mut agent = server.agent().await;
    let named = json!({ "name": "short", "values": { "v": 4 } });
    let opened = agent.open(json!({ "scenario": named, "outputs": outputs(), "seed": 3 })).await;
    assert_eq!(opened["scenario"]["name"], "short");
    assert_eq!(opened["scenario"]["actors"], 3);
    assert_eq!(opened["start"], pose(0.0));

    let first = agent.look(json!({ "type": "reset", "seed": 3 })).await.meta;
    assert_eq!(first.get("events"), None);
    let names = |metadata: &Value| -> Vec<String> {
        let actors = metadata["actors"].as_array().unwrap().iter();
        actors.map(|actor| actor["name"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names(&first), ["car", "van"]);
    assert_eq!(first["actors"][0]["size"], json!([2.0, 1.0, 1.5]));
    assert_eq!(first["route"]["command"], "straight");
    assert_eq!(first["route"]["length_m"], 9.0);
    assert_eq!(first["route"]["points"].as_array().unwrap().len(), 3, "0, 4.2 and 8.4 m");
    let van_m = first["actors"][1]["pose"]["xyz"][0].as_f64().unwrap();
    assert!(van_m != 1.0 && (van_m - 1.0).abs() <= 0.5, "jitter: {van_m}");

    // 0.1 s to 0.6 m, which is 6 m/s: the walker's trigger holds from the next sub-step on.
    let second = to(&mut agent, 0.6).await;
    let moved_m = second["actors"][1]["pose"]["xyz"][0].as_f64().unwrap() - van_m;
    assert!((moved_m - 0.4).abs() < 1e-9, "4 m/s: {moved_m}");
    assert_eq!(second["events"][0]["kind"], "trigger");
    assert_eq!(
        second["events"][1],
        json!({"time_us": 10_000 + second["events"][0]["time_us"].as_i64().unwrap(),
                                          "kind": "appeared", "actor": "walker"})
    );
    assert_eq!(names(&second), ["car", "van", "walker"]);
    let third = to(&mut agent, 1.2).await;
    assert_eq!(third.get("events"), None);
    let fourth = to(&mut agent, 1.8).await;
    assert_eq!(
        fourth["events"],
        json!([{"time_us": 200_000, "kind": "trigger", "actor": "van", "name": "slow"}])
    );

    // 60 m/s at most is swept: 4 m in 0.1 s. The ego's front is 1 m ahead, the car's rear at 7 m.
    let before = to(&mut agent, 5.5).await;
    assert_eq!((before.get("events"), &before["terminated"]), (None, &json!(false)));
    let hit = to(&mut agent, 6.5).await;
    let events = hit["events"].as_array().unwrap();
    assert_eq!((&events[0]["kind"], &events[0]["actor"]), (&json!("contact"), &json!("car")));
    assert_eq!((&events[0]["at_fault"], events.len()), (&json!(true), 2));
    let at_us = events[0]["time_us"].as_i64().unwrap();
    assert!((449_000..=451_000).contains(&at_us), "half the step: {at_us}");
    assert!((events[0]["impact"].as_f64().unwrap() - 10.0).abs() < 1e-9, "{events:?}");
    assert_eq!(events[1], json!({"time_us": 500_000, "kind": "end", "name": "contact"}));
    assert_eq!(hit["terminated"], true);
    refused(&agent.ask(json!({ "type": "step", "pose": pose(7.0) })).await, "session_state");
    let closed = agent.ask(json!({ "type": "close" })).await;
    assert_eq!(closed["summary"]["outcome"], "driving_failure");
}

#[tokio::test]
async fn a_seed_repeats_its_episode_and_another_differs() {
    let server = server().await;
    let drive = async |seed: u64, inline: bool| {
        let mut agent = server.agent().await;
        let mut file = scenario();
        file["actors"][1]["path"]["speed"] = 2.into();
        file.as_object_mut().unwrap().remove("sweep");
        let choice = if inline { file } else { json!("short") };
        let opened =
            agent.open(json!({ "scenario": choice, "outputs": outputs(), "seed": 9 })).await;
        agent.look(json!({ "type": "reset", "seed": seed })).await;
        let mut seen = Vec::new();
        for step in 1..5 {
            let metadata = to(&mut agent, 0.3 * f64::from(step)).await;
            seen.push((metadata["actors"].clone(), metadata["route"].clone()));
        }
        // A session from a snapshot continues in the same way.
        agent.ask(json!({ "type": "snapshot", "name": "here" })).await;
        let once = to(&mut agent, 1.6).await;
        agent.look(json!({ "type": "restore", "name": "here" })).await;
        let again = to(&mut agent, 1.6).await;
        assert_eq!(once["actors"], again["actors"]);
        (opened["scenario"]["hash"].clone(), seen)
    };
    let named = drive(5, false).await;
    assert_eq!(named, drive(5, false).await);
    assert_eq!(named, drive(5, true).await, "sent or by name");
    assert_ne!(named.1, drive(6, false).await.1);
}

#[tokio::test]
async fn a_session_without_a_scenario_tells_nothing_of_it() {
    let server = server().await;
    let mut agent = server.agent().await;
    let opened =
        agent.open(json!({ "outputs": { "cameras": ["front"], "encoding": "raw" } })).await;
    assert_eq!(opened.get("scenario"), None);
    let metadata = to(&mut agent, 1.0).await;
    for field in ["events", "route", "actors"] {
        assert_eq!(metadata.get(field), None);
    }
}

#[tokio::test]
async fn bad_scenarios_are_refused_with_their_place() {
    let server = server().await;
    let mut agent = server.agent().await;
    let with = |change: &dyn Fn(&mut Value)| {
        let mut file = scenario();
        change(&mut file);
        file
    };
    let answer = agent.try_open(json!({ "scenario": "shore" })).await;
    refused(&answer, "unknown_scenario");
    assert!(answer["message"].as_str().unwrap().contains("there is short"), "{answer}");
    refused(&agent.try_open(json!({ "scenario": "../short" })).await, "unknown_scenario");
    refused(
        &agent.try_open(json!({ "scenario": { "name": "short", "speed": 3 } })).await,
        "invalid_request",
    );
    for (file, field) in [
        (with(&|f| f["twin"]["name"] = "town".into()), "scenario.twin.name"),
        (
            with(&|f| f["twin"]["version_hash"] = "0".repeat(64).into()),
            "scenario.twin.version_hash",
        ),
        (
            with(&|f| f["actors"][0]["path"]["along"] = "lag".into()),
            "scenario.actors[0].path.along",
        ),
        (
            with(&|f| f["actors"][0]["path"]["station_m"] = 99.into()),
            "scenario.actors[0].path.station_m",
        ),
        (with(&|f| f["actors"][1]["name"] = "car".into()), "scenario.actors[1].name"),
        (with(&|f| f["sweep"]["v"] = json!([])), "scenario.sweep.v"),
        (with(&|f| f["sweep"]["v"] = json!(["fast"])), "scenario.actors[1].path.speed"),
        (with(&|f| f["map"] = json!({"file": "none.json"})), "scenario.map.file"),
        (with(&|f| f["tracks"] = json!({"file": "../short.json"})), "scenario.tracks.file"),
    ] {
        let answer = agent.try_open(json!({ "scenario": file })).await;
        refused(&answer, "scenario_invalid");
        assert_eq!(answer["field"], field, "{answer}");
    }
    agent.open(json!({ "scenario": "short" })).await;
}
