//! Requests that were valid until a generator changed them. Each gets an answer, no answer is
//! `internal`, and no session is lost.

use std::collections::BTreeMap;
use std::time::Instant;

use serde_json::{Value, json};

use crate::support::{Agent, Reply, TestServer, pose};

const REQUESTS: usize = 20_000;

/// A small generator of numbers (SplitMix64), so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit.max(1) as u64) as usize
    }
}

fn valid(seq: u64) -> Vec<Value> {
    let camera = json!({
        "name": "c", "width": 8, "height": 6, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0,
        "lens": { "model": "fisheye", "k": [0.0, 0.0, 0.0, 0.0], "max_angle": 1.2 },
        "shutter": { "direction": "top_to_bottom", "duration_us": 1000 },
        "exposure": { "gain": [1.0, 1.5, 2.0], "offset": [0.0, 0.1, 0.0] },
        "camera_to_rig": pose(0.0),
    });
    let outputs = json!({
        "cameras": ["c"], "images": { "c": { "crop": [0, 0, 4, 4], "size": [4, 4] } },
        "encoding": "raw", "quality": 90, "depth": true, "frames": 2, "period_us": { "c": 200_000 },
    });
    let planned = json!([{ "time_us": 100_000, "pose": pose(1.0) }]);
    let effects = json!({
        "drop": 0.1, "late": { "chance": 0.1, "by_us": 100_000 }, "freeze": { "chance": 0.1, "for_us": 200_000 },
        "noise": { "full_well": 500.0, "read": 5.0 }, "exposure": { "stops": 0.5, "period_us": 700_000 },
        "dirt": { "spots": 3, "radius": 0.1, "opacity": 0.5 },
    });
    let sensors = json!({
        "cameras": { "front": effects }, "imu": { "gyroscope": { "noise": 0.1, "bias": 0.1 }, "bias_period_us": 1_000_000 },
        "wheel_speed": { "noise": 0.1, "scale": 0.01 }, "delay_us": 100_000,
    });
    vec![
        json!({ "type": "step", "seq": seq, "pose": pose(1.0), "terminate": false }),
        json!({ "type": "step", "seq": seq, "trajectory": planned }),
        json!({ "type": "step", "seq": seq, "action": { "acceleration": 1.0, "curvature": 0.01 } }),
        json!({ "type": "step_many", "seq": seq, "steps": [
            { "session": "mutated", "pose": pose(1.0), "notes": { "a": 1 } },
            { "session": "gone", "trajectory": planned, "until_us": 100_000, "terminate": false },
        ] }),
        json!({ "type": "step", "seq": seq, "session": "mutated", "pose": pose(1.0) }),
        json!({ "type": "observe", "seq": seq, "poses": [pose(1.0), pose(2.0)] }),
        json!({ "type": "prefetch", "seq": seq, "poses": [pose(1.0), pose(2.0)] }),
        json!({ "type": "reset", "seq": seq, "seed": 3, "start": { "trajectory": "log", "station_m": 2.5 } }),
        json!({ "type": "reset", "seq": seq, "start": { "pose": pose(2.0) } }),
        json!({ "type": "switch_version", "seq": seq, "version": 1 }),
        json!({
            "type": "reset", "seq": seq, "dynamics": { "model": "kinematic", "speed": 2.0 }, "speed": 3.0,
            "start": { "random": { "trajectory": "log", "from_m": 1.0, "to_m": 8.0, "lateral_m": 0.5, "heading_rad": 0.1 } },
        }),
        json!({ "type": "snapshot", "seq": seq, "name": "s" }),
        json!({ "type": "restore", "seq": seq, "name": "s" }),
        json!({
            "type": "branch", "seq": seq, "from": { "session": "mutated", "snapshot": "s" }, "session": "other",
        }),
        json!({ "type": "branch", "seq": seq, "from": { "episode": "mutated-1", "step": 0 }, "session": "other" }),
        json!({ "type": "share_memory", "seq": seq, "proof": "x" }),
        json!({
            "type": "open", "seq": seq, "twin": "test", "session": "other", "sensors": sensors,
            "trajectory": { "name": "log", "from_m": 1.0, "to_m": 5.0, "every_m": 0.5 },
            "start": { "random": { "lateral_m": 0.5 } }, "outputs": { "frames": 2, "trust": true },
        }),
        json!({
            "type": "open", "seq": seq, "twin": "test", "session": "other", "scenario": { "name": "none", "values": { "v": 1 } },
            "repair": { "model": "none", "below": 0.7, "above": 0.8, "at_least": 0.1, "per_step": 2, "on_failure": "error" },
        }),
        json!({ "type": "resume", "seq": seq, "session": "mutated", "last_seq": 3 }),
        json!({
            "type": "open", "seq": seq, "twin": "test", "version": 1, "session": "other", "seed": 1,
            "start": { "trajectory": "log", "station_m": 1.0 }, "dt_us": 100_000,
            "rig": { "name": "r", "cameras": [camera] }, "outputs": outputs, "profile": { "near": 0.1 },
            "dynamics": { "model": "dynamic", "speed": 2.0, "reverse": true },
            "decision_us": 200_000, "warm_up_us": 100_000, "deadline_ms": 10_000,
        }),
    ]
}

/// Places in a value, each as a JSON pointer.
fn places(value: &Value, here: &str, all: &mut Vec<String>) {
    all.push(here.to_owned());
    match value {
        Value::Object(fields) => {
            for (name, inner) in fields {
                places(inner, &format!("{here}/{name}"), all);
            }
        }
        Value::Array(items) => {
            for (index, inner) in items.iter().enumerate() {
                places(inner, &format!("{here}/{index}"), all);
            }
        }
        _ => {}
    }
}

/// A request with up to two changes: a value replaced, a field left out or added, or bytes of the
/// text changed.
fn mutated(random: &mut Random, seq: u64) -> String {
    const TOKENS: [&str; 22] = [
        "null",
        "true",
        "NaN",
        "-Infinity",
        "1e999",
        "-1",
        "0",
        "1e5",
        "1.5",
        "1e30",
        "\"\"",
        "\"x\"",
        "\"log\"",
        "[]",
        "{}",
        "[[]]",
        "[0,0,0]",
        "{\"xyz\":[0,0,0]}",
        "18446744073709551615",
        "\"\\u0000\"",
        "[null]",
        "9007199254740993.0",
    ];
    let requests = valid(seq);
    let mut request = requests[random.below(requests.len())].clone();
    let mut replaced: Vec<&str> = Vec::new();
    for _ in 0..random.below(3) {
        let mut all = Vec::new();
        places(&request, "", &mut all);
        let at = all[random.below(all.len())].clone();
        let Some(value) = request.pointer_mut(&at) else { continue };
        match (random.below(4), value) {
            (0, Value::Object(fields)) => {
                let name = fields.keys().nth(random.below(fields.len())).cloned();
                name.and_then(|name| fields.remove(&name));
            }
            (1, Value::Object(fields)) => {
                fields.insert("extra".to_owned(), json!(1));
            }
            (0, Value::Array(items)) => {
                items.pop();
            }
            (1, Value::Array(items)) => items.extend(items.first().cloned()),
            (_, value) => {
                *value = json!(format!("@{}@", replaced.len()));
                replaced.push(TOKENS[random.below(TOKENS.len())]);
            }
        }
    }
    let mut text = request.to_string();
    for (index, token) in replaced.iter().enumerate() {
        text = text.replace(&format!("\"@{index}@\""), token);
    }
    if random.below(5) == 0 {
        // Bytes of ASCII, so that the text stays UTF-8.
        let mut bytes = text.into_bytes();
        for _ in 0..=random.below(3) {
            let at = random.below(bytes.len());
            match random.below(3) {
                0 => bytes[at] = 32 + random.below(95) as u8,
                1 => bytes.truncate(at.max(1)),
                _ => bytes.insert(at, b"{}[],:\"0-e."[random.below(11)]),
            }
        }
        text = String::from_utf8(bytes).expect("ASCII");
    }
    text
}

/// The kind of a binary answer, and its number.
fn observed(bytes: &[u8]) -> (&'static str, u64) {
    let (_, header) = safetensors::SafeTensors::read_metadata(bytes).expect("a header");
    let texts = header.metadata().as_ref().expect("metadata");
    let kinds = ["observation", "many"];
    let kind = kinds.into_iter().find(|kind| texts.contains_key(*kind)).expect("a kind");
    let metadata: Value = serde_json::from_str(&texts[kind]).expect("JSON");
    (kind, metadata["seq"].as_u64().expect("a number"))
}

async fn driver(server: &TestServer) -> Agent {
    let mut agent = server.agent().await;
    let open =
        json!({ "session": "mutated", "outputs": { "encoding": "raw", "cameras": ["rear"] } });
    agent.open(open).await;
    agent
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn mutated_requests_lose_no_session() {
    let server = TestServer::start().await;
    let mut agent = driver(&server).await;
    let mut random = Random(14);
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let began = Instant::now();
    for number in 0..REQUESTS {
        let text = mutated(&mut random, agent.seq);
        agent.send_text(&text).await;
        let outcome = match agent.receive().await {
            Reply::Binary(bytes) => {
                // A change of the number may ask for the last answer again.
                let (kind, seq) = observed(&bytes);
                agent.seq = seq + 1;
                kind.to_owned()
            }
            Reply::Text(answer) if answer["type"] == "error" => {
                assert_ne!(answer["code"], "internal", "{number}: {text}\n{answer}");
                assert_eq!(answer["fatal"], false, "{number}: {text}\n{answer}");
                answer["code"].as_str().expect("a code").to_owned()
            }
            Reply::Text(answer) => {
                agent.seq = answer["seq"].as_u64().expect("a number") + 1;
                if answer["type"] == "opened" && answer["session"] != "mutated" {
                    // With two sessions, requests without a name are refused.
                    let close = json!({ "type": "close", "session": answer["session"] });
                    assert_eq!(agent.ask(close).await["type"], "closed");
                }
                answer["type"].as_str().expect("a type").to_owned()
            }
            Reply::Closed => panic!("{number}: {text} ended the connection"),
        };
        *counts.entry(outcome).or_default() += 1;
    }
    let took = began.elapsed();
    eprintln!("{REQUESTS} requests in {took:.1?}: {counts:?}");
    assert!(
        counts["observation"] > 500 && counts["many"] > 100 && counts["invalid_request"] > 5_000,
        "{counts:?}"
    );
    assert!(counts.len() > 12, "{counts:?}");
    for kind in ["opened", "ok", "switched", "out_of_range", "unknown_scenario"] {
        assert!(counts.get(kind).is_some_and(|&count| count > 20), "{kind}: {counts:?}");
    }

    // The session is the same, and takes steps.
    let seen = agent.look(json!({ "type": "reset" })).await;
    assert_eq!((&seen.meta["session"], &seen.meta["step"]), (&json!("mutated"), &json!(0)));
    assert_eq!(agent.step(1.0).await.meta["step"], 1);
    assert_eq!(server.running.sessions(), 1);
}
