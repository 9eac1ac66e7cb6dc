//! What one client may cause: it is refused before it costs anything, or ends with its deadline, and
//! others are served meanwhile.

use std::fs;
use std::io::Cursor;
use std::time::{Duration, Instant};

use data_encoding::BASE64;
use image::{GrayImage, ImageFormat};
use serde_json::{Value, json};
use wildcity_server::Tokens;

use crate::http::{get, request};
use crate::support::{Agent, TEST_TIMEOUT, TestServer, pose, refused};

const ANN: &str = "ann-ann-ann-ann-ann";
const BOB: &str = "bob-bob-bob-bob-bob";

/// 256 attackers in a crowd, each with 64 triggers.
fn crowd() -> Value {
    let attacker = |index: usize| {
        let xyz = [(index % 16) as f64 * 2.5, (index / 16) as f64 * 2.5, 0.0];
        let attack = json!({ "pose": { "xyz": xyz, "q": [1, 0, 0, 0] }, "speed": 6, "ticks": 1 });
        json!({ "name": format!("a{index}"), "size": [2.0, 1.0, 1.5], "attack": attack })
    };
    let actors: Vec<Value> = (0..256).map(attacker).collect();
    json!({ "format": "wildcity.scenario/1", "name": "crowd", "twin": { "name": "test" },
            "ego": { "dynamics": { "model": "kinematic" } }, "actors": actors })
}

/// The longest time that a health check took while `work` ran, and what came of it.
async fn longest_silence<T>(server: &TestServer, work: impl Future<Output = T>) -> (Duration, T) {
    let mut longest = Duration::ZERO;
    let checks = async {
        loop {
            let begin = Instant::now();
            assert_eq!(get(server, "/healthz").await.0, 200);
            longest = longest.max(begin.elapsed());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let done = tokio::select! {
        done = work => done,
        () = checks => unreachable!("it has no end"),
    };
    (longest, done)
}

/// One thread answers all requests, so that a simulation on it would be a silence.
#[tokio::test]
async fn a_minute_of_the_largest_traffic_delays_nobody() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let opened = agent.try_open(json!({
        "scenario": crowd(), "dt_us": 100_000, "deadline_ms": 1500,
        "outputs": { "encoding": "raw", "actors": true } }));
    assert_eq!(opened.await["type"], "opened");
    let step = json!({ "type": "step", "action": { "acceleration": 0, "curvature": 0 },
                       "until_us": 60_000_000 });
    let begin = Instant::now();
    let (silence, answer) = longest_silence(&server, agent.ask(step)).await;
    refused(&answer, "deadline_exceeded");
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(5), "its deadline is 1.5 s: {took:?}");
    assert!(silence < took / 4, "{silence:?} of {took:?}");
    // The session is as it was before, and a short step is carried out.
    let short = json!({ "type": "step", "action": { "acceleration": 0, "curvature": 0 } });
    assert_eq!(agent.look(short).await.meta["step"], 1);
}

#[tokio::test]
async fn a_sweep_that_grows_is_refused() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    let bomb = json!({ "format": "wildcity.scenario/1", "name": "bomb", "twin": { "name": "test" },
                       "actors": vec!["$v"; 10_000], "sweep": { "v": ["x".repeat(60_000)] } });
    let answer = agent.try_open(json!({ "scenario": bomb })).await;
    refused(&answer, "scenario_invalid");
    assert!(answer["message"].as_str().unwrap().contains("of its sweep"), "{answer}");
    server.still_serves().await;
}

#[tokio::test]
async fn a_rig_that_is_refused_decodes_no_overlay() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    // Both have an end that is missing, which decoding would notice.
    let mut file = Cursor::new(Vec::new());
    GrayImage::new(4096, 4096).write_to(&mut file, ImageFormat::Png).unwrap();
    let file = file.into_inner();
    let png = BASE64.encode(&file[..file.len() / 2]);
    let camera = |name: &str| {
        json!({ "name": name, "width": 4096, "height": 4096, "fx": 2000.0, "fy": 2000.0,
                "cx": 2048.0, "cy": 2048.0, "overlay": format!("data:image/png;base64,{png}"),
                "camera_to_rig": pose(0.0) })
    };
    let open = |cameras: Vec<Value>| json!({ "rig": { "name": "bomb", "cameras": cameras } });
    let answer = agent.try_open(open(vec![camera("a"), camera("b")])).await;
    refused(&answer, "out_of_range");
    assert_eq!(answer["field"], "rig.cameras[1].overlay", "{answer}");
    let answer = agent.try_open(open(vec![camera("a")])).await;
    refused(&answer, "camera_invalid");
    server.still_serves().await;
}

#[tokio::test]
async fn a_page_of_another_site_causes_nothing() {
    let server = TestServer::start().await;
    for path in ["/v1/twins", "/v1/episodes", "/v1/twins/test/ground", "/metrics"] {
        let asked = format!("GET {path} HTTP/1.1\nHost: localhost\nSec-Fetch-Site: cross-site\n\n");
        assert_eq!(request(&server, &asked).await.0, 403, "{path}");
    }
    let asked = "GET /v1/twins HTTP/1.1\nHost: localhost\nAuthorization: a\nAuthorization: b\n\n";
    assert_eq!(request(&server, asked).await.0, 400);
    let (status, answer) = get(&server, "/v1/twins/demo%ff").await;
    assert!(status == 400 && answer.contains("\"code\""), "{answer}");
}

async fn with_tokens(change: impl FnOnce(&mut wildcity_server::Config)) -> TestServer {
    let text = json!({ "tokens": [
        { "name": "ann", "role": "drive", "token": ANN },
        { "name": "bob", "role": "drive", "token": BOB },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    TestServer::configured(|config| {
        config.tokens = Some(tokens);
        change(config);
    })
    .await
}

async fn greeted_agent(server: &TestServer, token: &str) -> Agent {
    let mut agent = Agent::connect_as(server.address(), Some(token)).await;
    agent.hello().await;
    agent
}

#[tokio::test]
async fn a_recorded_episode_belongs_to_its_token() {
    let server = with_tokens(|_| {}).await;
    let mut ann = greeted_agent(&server, ANN).await;
    ann.open(json!({ "session": "anns", "outputs": { "encoding": "raw" } })).await;
    ann.step(1.0).await;
    let branch = |episode: &str| json!({ "type": "branch", "session": "branch", "from": { "episode": episode, "step": 1 } });
    let mut bob = greeted_agent(&server, BOB).await;
    let hidden = bob.ask(branch("anns-1")).await;
    let missing = bob.ask(branch("none-1")).await;
    refused(&hidden, "unknown_state");
    let text = |answer: &Value| answer["message"].as_str().unwrap().replace("anns", "none");
    assert_eq!(text(&hidden), text(&missing), "both answers are the same");
    let own = ann.ask(branch("anns-1")).await;
    assert_eq!(own["type"], "opened", "{own}");
}

#[tokio::test]
async fn records_of_a_token_have_a_quota() {
    let server = with_tokens(|config| config.limits.records.owner_bytes = 40_000).await;
    let mut ann = greeted_agent(&server, ANN).await;
    ann.open(json!({ "outputs": { "encoding": "raw" } })).await;
    ann.step(1.0).await;
    let noted =
        json!({ "type": "step", "pose": pose(2.0), "notes": { "text": "n".repeat(60_000) } });
    let answer = ann.ask(noted).await;
    refused(&answer, "storage_full");
    assert!(answer["message"].as_str().unwrap().contains("--token-records-gib"), "{answer}");
    // Nothing of it is on the disk, the session goes on, and others have quotas of their own.
    ann.step(2.0).await;
    let mut bob = greeted_agent(&server, BOB).await;
    bob.open(json!({ "session": "bobs", "outputs": { "encoding": "raw" } })).await;
    bob.step(1.0).await;
}

#[tokio::test]
async fn one_token_leaves_sessions_to_others() {
    let server = with_tokens(|config| config.limits.sessions = 4).await;
    let mut ann = greeted_agent(&server, ANN).await;
    for name in ["a", "b", "c"] {
        ann.open(json!({ "session": name })).await;
    }
    refused(&ann.try_open(json!({ "session": "d" })).await, "busy");
    greeted_agent(&server, BOB).await.open(json!({ "session": "e" })).await;
}

/// A scenario takes memory as long as its session, and each snapshot a copy of its state.
#[tokio::test]
async fn scenarios_and_snapshots_count() {
    let server = TestServer::start().await;
    let counted = || server.running.engine().answer_bytes();
    let before = counted();
    let mut agent = server.agent().await;
    let mut scenario = crowd();
    // After the end of what is driven here.
    let never = json!([{ "when": { "time_s": 99 }, "do": [{ "remove": {} }] }]);
    for actor in scenario["actors"].as_array_mut().unwrap() {
        actor["script"] = never.clone();
    }
    let asked = json!({ "session": "s", "scenario": scenario, "outputs": { "encoding": "raw" } });
    let opened = agent.try_open(asked).await;
    assert_eq!(opened["type"], "opened", "{opened}");
    // 3 KiB for each trigger and 8 KiB for each actor.
    let opened = counted() - before;
    assert!(opened >= 256 * 11 * 1024, "{opened}");
    let step = json!({ "type": "step", "action": { "acceleration": 0, "curvature": 0 } });
    agent.look(step).await;
    let driven = counted();
    for name in ["a", "b"] {
        let snapshot = json!({ "type": "snapshot", "name": name });
        assert_eq!(agent.ask(snapshot).await["type"], "ok");
    }
    let taken = counted() - driven;
    assert!(taken >= 2 * 256 * 100, "{taken}");
    agent.ask(json!({ "type": "close" })).await;
    assert_eq!(counted(), before, "all of it is free");
}

#[tokio::test]
async fn an_inline_scenario_learns_nothing_of_other_files() {
    let server = TestServer::start().await;
    let dir = server.twins.path().join(".scenarios");
    fs::create_dir(&dir).unwrap();
    fs::write(dir.join("secret.json"), r#"{"format": "wildcity.map/1", "password": 7}"#).unwrap();
    let mut agent = server.agent().await;
    let mut answers = Vec::new();
    for file in ["secret.json", "absent.json"] {
        let scenario = json!({ "format": "wildcity.scenario/1", "name": "spy",
                               "twin": { "name": "test" }, "map": { "file": file } });
        let answer = agent.try_open(json!({ "scenario": scenario })).await;
        refused(&answer, "scenario_invalid");
        answers.push(answer["message"].as_str().unwrap().replace(file, ""));
    }
    assert_eq!(answers[0], answers[1]);
}

/// A pipe in place of a record is left out, and asking for it does not wait for a writer.
#[tokio::test]
async fn a_pipe_in_place_of_a_record_is_no_record() {
    let server = TestServer::start().await;
    let pipe = server.episodes.path().join("pipe-1.jsonl");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
    assert!(made.success());
    let asked = async {
        assert_eq!(get(&server, "/v1/episodes").await.0, 200);
        assert_eq!(get(&server, "/v1/episodes/pipe-1").await.0, 404);
    };
    tokio::time::timeout(TEST_TIMEOUT, asked).await.expect("the pipe is not waited for");
}

/// A token that is limited to some twins learns no names of scenarios: of one of another twin as
/// little as of one that is not there.
#[tokio::test]
async fn a_limited_token_learns_no_names_of_scenarios() {
    let text = json!({ "tokens": [
        { "name": "ann", "role": "drive", "token": ANN, "twins": ["test"] },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    let server = TestServer::configured(|config| config.tokens = Some(tokens)).await;
    let dir = server.twins.path().join(".scenarios");
    fs::create_dir(&dir).unwrap();
    let scenario = json!({ "format": "wildcity.scenario/1", "name": "heist",
                           "twin": { "name": "vault" }, "actors": [] });
    fs::write(dir.join("heist.json"), scenario.to_string()).unwrap();
    let mut ann = greeted_agent(&server, ANN).await;
    let mut answers = Vec::new();
    for name in ["heist", "absent"] {
        let answer = ann.try_open(json!({ "scenario": name })).await;
        assert_eq!(answer["type"], "error", "{answer}");
        let message = answer["message"].as_str().unwrap();
        assert!(!message.contains("vault") && !message.contains("heist"), "{message}");
        answers.push((answer["code"].clone(), message.to_owned()));
    }
    assert_eq!(answers[0], answers[1]);
}

/// Metrics count what happens on all twins.
#[tokio::test]
async fn a_limited_administrator_gets_no_metrics() {
    let text = json!({ "tokens": [
        { "name": "ann", "role": "admin", "token": ANN, "twins": ["test"] },
        { "name": "bob", "role": "admin", "token": BOB },
    ]});
    let tokens = Tokens::parse(text.to_string().as_bytes()).unwrap();
    let server = TestServer::configured(|config| config.tokens = Some(tokens)).await;
    for (token, status) in [(ANN, 403), (BOB, 200)] {
        let asked =
            format!("GET /metrics HTTP/1.1\nHost: localhost\nAuthorization: Bearer {token}\n\n");
        let (found, answer) = request(&server, &asked).await;
        assert_eq!(found, status, "{answer}");
        assert_eq!(answer.contains("wildcity_steps_total"), status == 200, "{answer}");
    }
}
