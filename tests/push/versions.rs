//! Sessions and versions: each session keeps its version until its agent switches.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::json;
use wildcity_client::PushState;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_session::options::{Encoding, Open, Outputs};
use wildcity_session::{Engine, EngineSettings, RecordedEpisode, ReplayUntil, Scenarios, Session};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Retention};

use crate::http::{get, in_cell, post, push};
use crate::metrics::scrape;
use crate::support::{
    Agent, Seen, TEST_TIMEOUT, TestServer, commit_twin_with_opacity, pose, refused,
};

/// Versions that are pushed while agents drive.
const VERSIONS: u64 = 50;

/// An observation of an agent: the version, the ego's x, and the frame's hash.
type Sight = (u64, u64, String);

fn sight(seen: &Seen) -> Sight {
    let version = seen.meta["version"].as_u64().unwrap();
    let x_m = seen.meta["ego"]["pose"]["xyz"][0].as_f64().unwrap();
    (version, x_m.to_bits(), seen.frame_hash().to_owned())
}

/// A server that renders, and another on the same twins.
async fn rendering(twins: Option<&Path>) -> TestServer {
    let cpu = Arc::new(Cpu::new(2, Simd::Best).unwrap());
    TestServer::configured(|config| {
        config.backend = cpu;
        if let Some(twins) = twins {
            config.directories.twins = twins.to_owned();
        }
    })
    .await
}

async fn driver(server: &TestServer, name: &str) -> Agent {
    let mut agent = server.agent().await;
    let start = json!({ "pose": pose(0.0) });
    agent.open(json!({ "session": name, "start": start, "outputs": { "encoding": "raw" } })).await;
    agent
}

#[tokio::test]
async fn agents_drive_while_versions_are_pushed() {
    let server = Arc::new(rendering(None).await);
    let mut pinned = driver(&server, "pinned").await;
    let mut switching = driver(&server, "switching").await;
    let over = Arc::new(AtomicBool::new(false));
    let pushing = async {
        for number in 0..VERSIONS {
            let pushed = push(&server, &in_cell([0, 0], 60, 1000 + number), |_| {}).await;
            assert_eq!((pushed.state, pushed.version), (PushState::Ready, Some(number + 2)));
        }
        over.store(true, Ordering::SeqCst);
    };
    let places = |step: usize| (step % 5) as f64;
    let staying = async {
        let mut sights = Vec::new();
        let mut step = 0;
        while !over.load(Ordering::SeqCst) {
            sights.push(sight(&pinned.step(places(step)).await));
            step += 1;
        }
        sights
    };
    let following = async {
        let mut sights = Vec::new();
        let mut step = 0;
        let mut version = 1;
        while !over.load(Ordering::SeqCst) {
            if step % 3 == 2 {
                let switched = switching.ask(json!({ "type": "switch_version" })).await;
                assert_eq!(switched["type"], "switched", "{switched}");
                let now = switched["version"].as_u64().unwrap();
                assert!(now >= version, "back from {version} to {now}");
                version = now;
            }
            let seen = switching.step(places(step)).await;
            assert_eq!(seen.meta["version"], version, "it switches when told, and not before");
            sights.push(sight(&seen));
            step += 1;
        }
        sights
    };
    let ((), pinned_sights, mut sights) = tokio::join!(pushing, staying, following);
    assert!(pinned_sights.iter().all(|(version, ..)| *version == 1), "the pinned one changed");
    let versions: std::collections::BTreeSet<_> = sights.iter().map(|sight| sight.0).collect();
    assert!(versions.len() > 3, "only {versions:?} were seen");

    // Every observation shows only one version, with the images of a new server.
    sights.extend(pinned_sights);
    let mut seen: BTreeMap<(u64, u64), String> = BTreeMap::new();
    for (version, x_m, hash) in sights {
        let same = seen.entry((version, x_m)).or_insert_with(|| hash.clone());
        assert_eq!(*same, hash, "two pictures of version {version}");
    }
    let fresh = rendering(Some(server.twins.path())).await;
    for ((version, x_m), hash) in &seen {
        let mut agent = fresh.agent().await;
        agent.open(json!({ "version": version, "outputs": { "encoding": "raw" } })).await;
        let poses = [pose(f64::from_bits(*x_m))];
        let drawn = agent.look(json!({ "type": "observe", "poses": poses })).await;
        assert_eq!(drawn.frame_hash(), hash, "version {version}");
    }
    let distinct: std::collections::BTreeSet<_> = seen.values().collect();
    assert!(distinct.len() > 3, "the versions look alike");
}

#[tokio::test]
async fn a_session_switches_between_steps_and_its_episode_goes_on() {
    let server = rendering(None).await;
    let mut agent = driver(&server, "a").await;
    let before = agent.step(1.0).await;
    let pushed = push(&server, &in_cell([0, 0], 60, 1), |_| {}).await;
    assert_eq!(pushed.version, Some(2), "{pushed:?}");
    assert_eq!(agent.step(1.0).await.frame_hash(), before.frame_hash(), "it was not asked to");
    let switched = agent.ask(json!({ "type": "switch_version", "version": 2 })).await;
    assert_eq!(switched["version_hash"], *pushed.version_hash.as_ref().unwrap());
    assert!(switched["profile_hash"].is_string() && switched["profile"].is_object(), "{switched}");
    let after = agent.step(1.0).await;
    assert_ne!(after.frame_hash(), before.frame_hash());
    assert_eq!((&after.meta["version"], &after.meta["step"]), (&json!(2), &json!(3)));
    assert_eq!(after.meta["version_hash"], switched["version_hash"]);
    let sessions = get(&server, "/v1/sessions").await.body["sessions"].clone();
    assert_eq!((&sessions[0]["session"], &sessions[0]["version"]), (&json!("a"), &json!(2)));
    assert_eq!((&sessions[0]["step"], &sessions[0]["connected"]), (&json!(3), &json!(true)));
    refused(&agent.ask(json!({ "type": "switch_version", "version": 7 })).await, "unknown_version");
    assert_eq!(agent.step(1.0).await.frame_hash(), after.frame_hash(), "nothing changed");
    let back = agent.ask(json!({ "type": "switch_version", "version": 1 })).await;
    assert_eq!(back["version"], 1);
    assert_eq!(agent.step(1.0).await.frame_hash(), before.frame_hash());
    let closed = agent.ask(json!({ "type": "close" })).await;
    assert_eq!(closed["summary"]["steps"], 5, "{closed}");

    // The recording has the switches as well.
    let recording = RecordedEpisode::read(&server.recorded()[0]).unwrap();
    let switches: Vec<_> = recording.versions.iter().map(|(at, v)| (*at, v.version)).collect();
    assert_eq!(switches, [(2, 2), (4, 1)]);
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    let cpu = Cpu::new(2, Simd::Best).unwrap();
    let replay = |recording: &RecordedEpisode| {
        recording.replay(&cache, &cpu, ReplayUntil::End, &mut |_| Ok(())).unwrap()
    };
    let report = replay(&recording);
    assert_eq!((report.difference, report.images, report.changes), (None, 10, vec![]));
    let mut forgetful = recording.clone();
    forgetful.versions.clear();
    let difference = replay(&forgetful).difference.expect("the wrong version is noticed");
    // The file has the header, two frames and the switch before it.
    assert_eq!(difference.line, 5);
}

/// While a new version is made ready, sessions that open the latest get the previous version.
#[tokio::test]
async fn the_latest_is_the_one_before_until_the_new_one_is_ready() {
    let server = TestServer::start().await;
    push(&server, &in_cell([0, 0], 60, 1), |_| {}).await;
    let episodes = tempfile::tempdir().unwrap();
    let engine = Engine::start(EngineSettings {
        cache: Cache::new(Catalog::open(server.twins.path()).unwrap()),
        episodes: episodes.path().to_owned(),
        scenarios: Scenarios::in_dir(""),
        backend: server.painter.clone(),
        step_timeout: TEST_TIMEOUT,
        repairs: Arc::default(),
        mcap: false,
    });
    let engine = engine.unwrap();
    let latest = async || {
        let opening = Open { outputs: Outputs::colour(Encoding::Raw), ..Open::twin("test") };
        let session = Session::open(engine.clone(), "a".to_owned(), opening).await.unwrap();
        session.resident().version.number
    };
    assert_eq!(latest().await, 2);
    let listed = async || engine.twins().await.unwrap().twins[0].number;
    assert_eq!(listed().await, 2);
    let held = engine.pin_latest("test", 1);
    assert_eq!((latest().await, listed().await), (1, 1));
    // A rollback in between is the latest at once.
    engine.move_latest_pin("test", 2);
    assert_eq!((latest().await, listed().await), (2, 2));
    drop(held);
    engine.move_latest_pin("test", 1);
    assert_eq!((latest().await, listed().await), (2, 2), "nothing is held");
}

/// The same test over the wire, during a push that takes a while to load its version.
#[tokio::test]
async fn a_version_that_is_not_ready_is_not_the_latest() {
    let server = rendering(None).await;
    let mut agent = driver(&server, "a").await;
    agent.step(1.0).await;
    let seen = std::cell::Cell::new(0);
    for round in 0..20 {
        let over = std::cell::Cell::new(false);
        let pushing = async {
            let gaussians = in_cell([0, 0], 20_000, 2000 + round);
            let pushed = push(&server, &gaussians, |push| {
                push.id = Some(format!("p-{round}"));
            });
            assert_eq!(pushed.await.version, Some(round + 2));
            over.set(true);
        };
        let looking = async {
            let path = format!("/v1/twins/test/pushes/p-{round}");
            while !over.get() {
                let twin = get(&server, "/v1/twins/test").await.body;
                let versions = get(&server, "/v1/twins/test/versions").await.body;
                // It was not ready yet when the others were asked.
                let state = get(&server, &path).await.body["state"].clone();
                if state == "prefetching" {
                    let last = versions["versions"].as_array().unwrap().last().unwrap().clone();
                    seen.set(seen.get() + u64::from(last["version"] == round + 2));
                    assert_eq!(twin["version"], round + 1, "{twin}");
                    assert_eq!(last["ready"], last["version"] == round + 1, "{last}");
                }
            }
        };
        tokio::join!(pushing, looking);
        if seen.get() > 0 {
            break;
        }
    }
    assert!(seen.get() > 0, "no push was seen while it was made ready");
    let versions = get(&server, "/v1/twins/test/versions").await.body["versions"].clone();
    assert!(versions.as_array().unwrap().iter().all(|version| version["ready"] == true));
}

/// When a push is ready, the parts of its version that sessions need are in memory.
#[tokio::test]
async fn a_ready_version_does_not_keep_its_sessions_waiting() {
    let server = rendering(None).await;
    let mut agent = driver(&server, "a").await;
    agent.step(1.0).await;
    push(&server, &in_cell([0, 0], 60, 1), |_| {}).await;
    let waits = async || {
        let text = scrape(&server).await;
        let line =
            text.lines().find_map(|line| line.strip_prefix("wildcity_residency_waits_total "));
        line.expect("a count of waits").parse::<u64>().unwrap()
    };
    let before = waits().await;
    let switched = agent.ask(json!({ "type": "switch_version" })).await;
    assert_eq!(switched["version"], 2, "{switched}");
    agent.step(1.0).await;
    assert_eq!(waits().await, before);
}

#[tokio::test]
async fn without_a_session_there_is_nothing_to_switch() {
    let server = TestServer::start().await;
    let mut agent = server.agent().await;
    refused(&agent.ask(json!({ "type": "switch_version" })).await, "session_state");
}

/// A version that garbage collection removed is gone for HTTP as well, and no fault of the server.
#[tokio::test]
async fn a_rollback_to_a_collected_version_is_refused() {
    let server = TestServer::start().await;
    commit_twin_with_opacity(server.twins.path(), 1.0);
    let catalog = Catalog::open(server.twins.path()).unwrap();
    let retention = Retention { versions: 1, grace: Duration::ZERO };
    // The first run notes the garbage, the second one removes it.
    for _ in 0..2 {
        assert_eq!(catalog.collect("test", retention, false).unwrap().kept, [2]);
    }
    let body = json!({ "version": 1 });
    post(&server, "/v1/twins/test/rollback", &body).await.refused(404, "unknown_version");
}
