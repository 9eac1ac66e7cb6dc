//! Recorded episodes, rendered again.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::Arc;

use serde_json::json;
use wildcity::render::Backend;
use wildcity::render::cpu::{Cpu, Simd};
use wildcity::residency::Cache;
use wildcity::scene::ProfileChanges;
use wildcity::server::{self, Config, Limits};
use wildcity::session::{FrameRequest, RecordedEpisode, ReplayError, ReplayReport, ReplayUntil};
use wildcity::store::Catalog;

use crate::support::{self, Agent, Painter, TestServer, pose};

/// An episode of ten steps, one look around, and a turn that no quaternion holds exactly.
async fn drive(agent: &mut Agent) {
    for step in 0..10 {
        agent.step(f64::from(step) * 0.7).await;
    }
    let turned = json!({ "xyz": [0.1, 0.2, 0.3], "q": [0.9, 0.1, -0.3, 0.3] });
    agent.look(json!({ "type": "observe", "poses": [pose(4.0), turned] })).await;
    agent.ask(json!({ "type": "close" })).await;
}

async fn recorded() -> (TestServer, PathBuf) {
    let server = TestServer::start().await;
    drive(&mut server.driver("a").await).await;
    let path = server.recorded().remove(0);
    (server, path)
}

pub(crate) fn replay(
    server: &TestServer,
    path: &Path,
    backend: &dyn Backend,
) -> Result<ReplayReport, ReplayError> {
    let recording = RecordedEpisode::read(path)?;
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    let mut open = |version| cache.open(&recording.header.twin, Some(version));
    recording.replay(&mut open, backend, ReplayUntil::FirstDifference, &mut |_| Ok(()))
}

/// Changes one hex digit of the hash of an image, in a line counted from 0.
fn tamper(path: &Path, line: usize, image: usize) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let mut value: serde_json::Value = serde_json::from_str(&lines[line]).unwrap();
    let mut hash = value["images"][image].as_str().unwrap().to_owned();
    let digit = if hash.starts_with('0') { "1" } else { "0" };
    hash.replace_range(..1, digit);
    value["images"][image] = hash.into();
    lines[line] = value.to_string();
    std::fs::write(path, lines.join("\n") + "\n").unwrap();
}

#[tokio::test]
async fn what_was_recorded_is_rendered_again() {
    let (server, path) = recorded().await;
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!(
        report,
        ReplayReport { images: 24, changes: vec![], diverged: None, difference: None }
    );
}

#[tokio::test]
async fn the_first_differing_image_is_named() {
    let (server, path) = recorded().await;
    tamper(&path, 8, 0);
    tamper(&path, 4, 1);
    let report = replay(&server, &path, &Painter::default()).unwrap();
    let found = report.difference.unwrap();
    assert_eq!((found.line, found.step, &*found.camera), (5, 4, "rear"));
    assert_eq!(report.images, 8);

    let (server, path) = recorded().await;
    tamper(&path, 11, 2);
    let found = replay(&server, &path, &Painter::default()).unwrap().difference.unwrap();
    assert_eq!((found.request, found.pose, &*found.camera), (FrameRequest::Observe, 1, "front"));
}

#[tokio::test]
async fn another_backend_is_noticed() {
    let (server, path) = recorded().await;
    let report = replay(&server, &path, &Cpu::new(1, Simd::Best).unwrap()).unwrap();
    assert_eq!(report.changes.len(), 2);
    let detail = &report.changes[1];
    assert_eq!((detail.what, &*detail.recorded), ("backend detail", ""));
    assert!(
        ["Avx512", "Avx2", "Sse4_2", "Neon", "Fallback"].contains(&&*detail.now),
        "{}",
        detail.now
    );
    let change = &report.changes[0];
    assert_eq!((change.what, &*change.recorded, &*change.now), ("backend", "painter", "cpu"));
    assert_eq!(report.difference.unwrap().step, 1);
}

#[tokio::test]
async fn damaged_files_are_named_by_line() {
    let (server, path) = recorded().await;
    let whole = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = whole.lines().collect();
    let damaged = |text: &str| {
        std::fs::write(&path, text).unwrap();
        match RecordedEpisode::read(&path) {
            Err(ReplayError::Line { line, reason, .. }) => (line, reason),
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(damaged("").0, 1);
    assert_eq!(damaged(lines[0]).0, 1, "no end of line");
    assert_eq!(damaged(&whole[..whole.len() - 30]).0, lines.len());
    assert_eq!(damaged(&whole.replace("\"step\":3", "\"step\":x")).0, 4);
    assert_eq!(damaged(&lines[1..].join("\n")).0, 1);
    assert_eq!(damaged(&format!("{whole}{}\n", lines[1])).0, lines.len() + 1);
    assert_eq!(damaged(&format!("{}\n{}\n", lines[0], lines[0])).0, 2);
    let (line, reason) = damaged(&whole.replace("\"format\":0", "\"format\":7"));
    assert!(line == 1 && reason.contains('7'), "{reason}");
    let (line, reason) = damaged(&format!("{}\n\"{}\"\n", lines[0], "x".repeat(2 << 20)));
    assert!(line == 2 && reason.contains("longer"), "{reason}");
    assert!(matches!(
        RecordedEpisode::read(Path::new("/nowhere.jsonl")),
        Err(ReplayError::Read { .. })
    ));
    // Without its last line, the episode of a killed server can still be replayed.
    std::fs::write(&path, lines[..lines.len() - 1].join("\n") + "\n").unwrap();
    assert_eq!(replay(&server, &path, &Painter::default()).unwrap().difference, None);
}

fn wildcity(arguments: &[&str], episode: &Path, twins: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.arg("replay").arg(episode).arg("--twins").arg(twins).args(arguments);
    command.output().unwrap()
}

#[tokio::test]
async fn the_command_verifies_what_the_cpu_backend_served() {
    let (twins, episodes) = (support::twins(), tempfile::tempdir().unwrap());
    let config = Config {
        listen: "127.0.0.1:0".parse().unwrap(),
        twins: twins.path().to_owned(),
        cache: None,
        episodes: episodes.path().to_owned(),
        uploads: twins.path().join(".uploads"),
        tokens: None,
        backend: Arc::new(Cpu::new(2, Simd::Best).unwrap()),
        profile: ProfileChanges::default(),
        limits: Limits::default(),
    };
    let running = server::start(config).await.unwrap();
    let mut agent = Agent::connect(running.address()).await;
    agent.hello().await;
    // With a profile of its own: what was recorded is drawn, not what the twin says.
    let own =
        json!({ "session": "a", "profile": { "blur": 4.0 }, "outputs": { "encoding": "raw" } });
    agent.open(own).await;
    drive(&mut agent).await;
    let path = episodes.path().join("a-1.jsonl");

    let shown = wildcity(&[], &path, twins.path());
    let text = String::from_utf8(shown.stdout).unwrap();
    assert!(text.contains("test version 1") && text.contains("10 steps"), "{text}");
    let verified = wildcity(&["--verify", "--threads", "1"], &path, twins.path());
    let text = String::from_utf8(verified.stdout).unwrap();
    assert!(verified.status.success() && text.contains("24 images"), "{text}");
    let out = episodes.path().join("pictures");
    let drawn = wildcity(&["--out", out.to_str().unwrap()], &path, twins.path());
    assert!(drawn.status.success());
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 24);
    let front = image::open(out.join("000003_step_front.png")).unwrap().into_rgb8();
    let recorded = crate::record::lines(&path);
    assert_eq!(recorded[4]["images"][0], blake3::hash(&front).to_hex().as_str());

    let whole = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = whole.lines().collect();
    for (kept, wanted) in [(1, "it has no frames"), (lines.len() - 1, "it has no end")] {
        std::fs::write(&path, lines[..kept].join("\n") + "\n").unwrap();
        let partial = wildcity(&["--verify"], &path, twins.path());
        assert_eq!(partial.status.code(), Some(1));
        let error = String::from_utf8(partial.stderr).unwrap();
        assert!(error.contains("the recording is incomplete") && error.contains(wanted), "{error}");
        assert!(wildcity(&[], &path, twins.path()).status.success(), "it can still be looked at");
    }
    std::fs::write(&path, whole).unwrap();

    // Another backend differs, and its pictures are wanted all the same.
    let others = episodes.path().join("others");
    let arguments = ["--backend", "reference", "--out", others.to_str().unwrap()];
    tamper(&path, 2, 0);
    tamper(&path, 5, 1);
    let drawn = wildcity(&arguments, &path, twins.path());
    let text = String::from_utf8(drawn.stdout).unwrap();
    assert!(drawn.status.success() && text.contains("differs     step"), "{text}");
    assert_eq!(std::fs::read_dir(&others).unwrap().count(), 24);

    let failed = wildcity(&["--verify"], &path, twins.path());
    assert_eq!(failed.status.code(), Some(1));
    let error = String::from_utf8(failed.stderr).unwrap();
    assert!(error.contains("step 2") && error.contains("\"front\""), "{error}");
    running.stop().await;
}
