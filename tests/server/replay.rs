//! Recorded episodes, rendered again.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use wildcity_render::Backend;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_session::{
    FrameRequest, RecordedEpisode, ReplayError, ReplayReport, ReplayUntil, Sensor,
};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::episodes::{drive, tamper};
use crate::support::{Painter, TestServer};

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
    recording.replay(&cache, backend, ReplayUntil::FirstDifference, &mut |_| Ok(()))
}

#[tokio::test]
async fn what_was_recorded_is_rendered_again() {
    let (server, path) = recorded().await;
    let report = replay(&server, &path, &Painter::default()).unwrap();
    assert_eq!(
        report,
        ReplayReport {
            images: 24,
            sweeps: 0,
            changes: vec![],
            diverged: None,
            difference: None,
            wrong_value: None,
            repaired: wildcity_session::RepairedImages::default(),
        }
    );
}

#[tokio::test]
async fn the_first_differing_image_is_named() {
    let (server, path) = recorded().await;
    tamper(&path, 8, 0);
    tamper(&path, 4, 1);
    let report = replay(&server, &path, &Painter::default()).unwrap();
    let found = report.difference.unwrap();
    assert_eq!((found.line, found.step, found.sensor), (5, 4, Sensor::Camera("rear".into())));
    assert_eq!(report.images, 8);

    let (server, path) = recorded().await;
    tamper(&path, 11, 2);
    let found = replay(&server, &path, &Painter::default()).unwrap().difference.unwrap();
    let front = Sensor::Camera("front".into());
    assert_eq!((found.request, found.pose, found.sensor), (FrameRequest::Observe, 1, front));
}

#[tokio::test]
async fn every_altered_value_is_named() {
    let (server, path) = recorded().await;
    let whole = std::fs::read_to_string(&path).unwrap();
    let lines = whole.lines().count();
    let hash = "0".repeat(64);
    for (line, field, value) in [
        (3, "time_us", json!(200_001)),
        (3, "step", json!(7)),
        (4, "frame_hash", json!(hash)),
        (12, "frame_hash", json!(hash)),
        (lines, "steps", json!(11)),
        (lines, "time_us", json!(1_000_001)),
        (lines, "distance_m", json!(6.0)),
        (lines, "outcome", json!("off_model")),
    ] {
        let mut changed: Vec<Value> =
            whole.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert!(!changed[line - 1][field].is_null(), "line {line} has no {field}");
        changed[line - 1][field] = value;
        let text: Vec<String> = changed.iter().map(Value::to_string).collect();
        std::fs::write(&path, text.join("\n") + "\n").unwrap();
        let wrong = replay(&server, &path, &Painter::default()).unwrap().wrong_value.unwrap();
        assert_eq!((wrong.line, wrong.field), (line, field), "{wrong}");
    }
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
    // A recording that was cut is read as far as it goes.
    std::fs::write(&path, &whole[..whole.len() - 30]).unwrap();
    let cut = RecordedEpisode::read(&path).unwrap();
    assert_eq!((cut.frames.len(), cut.end), (lines.len() - 2, None));
    assert_eq!(damaged(&whole.replace("\"step\":3", "\"step\":x")).0, 4);
    assert_eq!(damaged(&lines[1..].join("\n")).0, 1);
    assert_eq!(damaged(&format!("{whole}{}\n", lines[1])).0, lines.len() + 1);
    assert_eq!(damaged(&format!("{}\n{}\n", lines[0], lines[0])).0, 2);
    let (line, reason) = damaged(&whole.replace("\"format\":0", "\"format\":7"));
    assert!(line == 1 && reason.contains('7'), "{reason}");
    // Line 2 may have a scenario with a large map, and so be longer than the others.
    let long = "x".repeat(2 << 20);
    let (line, reason) = damaged(&format!("{}\n{}\n\"{long}\"\n", lines[0], lines[1]));
    assert!(line == 3 && reason.contains("longer"), "{reason}");
    assert!(matches!(
        RecordedEpisode::read(Path::new("/nowhere.jsonl")),
        Err(ReplayError::Read { .. })
    ));
    // Without its last line, the episode of a killed server can still be replayed.
    std::fs::write(&path, lines[..lines.len() - 1].join("\n") + "\n").unwrap();
    assert_eq!(replay(&server, &path, &Painter::default()).unwrap().difference, None);
}
