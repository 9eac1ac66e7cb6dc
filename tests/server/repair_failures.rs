//! Models that fail, hang, are swapped or cannot be used: each has its own refusal or flag, and
//! sessions continue.

use std::fs;

use serde_json::{Value, json};
use wildcity_repair::{LoadOptions, Models};

use crate::episodes::lines;
use crate::onnx_doubles as doubles;
use crate::onnx_models::{Folder, library, trained};
use crate::repair::{beside, brighter, hashes, opening, pixels, replay, server, statuses, step};
use crate::support::refused;

/// A model with the inputs `image` and `trust`.
fn with_trust(onnx: &[u8], name: &str, timeout_ms: u64) -> Folder {
    let inputs = json!([{"name": "image", "role": "rgb"}, {"name": "trust", "role": "trust"}]);
    Folder::new(onnx, json!({"name": name, "timeout_ms": timeout_ms, "inputs": inputs}))
}

#[tokio::test]
async fn what_cannot_be_repaired_is_refused_at_open_and_names_the_field() {
    let slow = Folder::new(&doubles::identity(), json!({"name": "slow", "timeout_ms": 60_000}));
    let small = Folder::new(
        &doubles::identity(),
        json!({"name": "small", "size": {"fixed": [8, 8], "fit": "pad"}}),
    );
    let swapped = Folder::new(&doubles::identity(), json!({"name": "swapped"}));
    let server = server(&[&slow, &small, &swapped], 1).await;
    // Swapped while the server runs, before a session asked for it.
    fs::write(swapped.folder.path().join("model.onnx"), doubles::global()).unwrap();
    let mut agent = server.agent().await;
    for (repair, code, field, message) in [
        (
            json!({"model": "nix"}),
            "unknown_repair",
            "repair.model",
            "there is slow, small, swapped",
        ),
        (
            json!({"model": "small"}),
            "repair_unavailable",
            "repair.model",
            "camera \"left\": image: 24 x 16 px",
        ),
        (json!({"model": "swapped"}), "repair_unavailable", "repair.model", "the manifest pins"),
        (json!({"model": "slow"}), "out_of_range", "deadline_ms", "timeout_ms"),
        (json!({"model": "slow", "below": 2}), "out_of_range", "repair.below", "trust is 0 to 1"),
        (json!({"model": "slow", "above": 0.5}), "out_of_range", "repair.above", "less than below"),
        (
            json!({"model": "slow", "at_least": 0.8}),
            "out_of_range",
            "repair.at_least",
            "nothing would",
        ),
        (
            json!({"model": "slow", "on_failure": "hide"}),
            "invalid_request",
            "repair.on_failure",
            "unrepaired",
        ),
        (json!({"modell": "slow"}), "invalid_request", "repair.modell", "modell"),
    ] {
        let answer = agent.try_open(opening("a", repair.clone())).await;
        refused(&answer, code);
        assert_eq!(answer["field"], field, "{repair}: {answer}");
        assert!(answer["message"].as_str().unwrap().contains(message), "{repair}: {answer}");
    }
    // The connection continues.
    agent.open(opening("a", Value::Null)).await;
    step(&mut agent, 2.0).await;
    assert_eq!(server.recorded().len(), 1);
}

#[tokio::test]
async fn super_resolution_is_refused_by_its_scale() {
    let Some(onnx) = trained("super_resolution_224_niazwazir.onnx") else { return };
    let changes = json!({
        "name": "super", "size": {"fixed": [224, 224], "fit": "tile"},
        "inputs": [{"name": "input", "role": "luma"}],
        "outputs": [{"name": "output", "role": "luma", "scale": 3}],
    });
    let folder = Folder::new(&onnx, changes);
    let server = server(&[&folder], 1).await;
    let answer = server.agent().await.try_open(opening("a", json!({"model": "super"}))).await;
    refused(&answer, "repair_unavailable");
    assert!(answer["message"].as_str().unwrap().contains("3 times as large"), "{answer}");
}

#[tokio::test]
async fn a_hung_model_flags_the_frame_and_is_loaded_again_after_ten() {
    let hung = with_trust(&doubles::endless_if_doubtful(), "hung", 200);
    let server = server(&[&hung], 1).await;
    let mut agent = server.agent().await;
    agent.open(opening("a", json!({"model": "hung", "per_step": 1}))).await;
    let mut plain = server.agent().await;
    plain.open(opening("b", Value::Null)).await;
    assert_eq!(statuses(&step(&mut agent, 2.0).await), ["repaired", "kept"]);
    // The trust is 0.3 at 6 m: the model does not end, and the frame is delivered as rendered and
    // marked so.
    let rendered = step(&mut plain, 6.0).await;
    for _ in 0..9 {
        let seen = step(&mut agent, 6.0).await;
        assert_eq!(statuses(&seen), ["failed", "kept"]);
        assert_eq!(seen.meta["images"][0]["repair"]["failure"], "timed_out");
        assert_eq!(pixels(&seen, "left"), pixels(&rendered, "left"));
        assert_eq!(hashes(&seen), hashes(&rendered));
    }
    assert_eq!(statuses(&step(&mut agent, 2.0).await), ["repaired", "kept"], "it is usable");
    for _ in 0..2 {
        let seen = step(&mut agent, 6.0).await;
        assert_eq!(seen.meta["images"][0]["repair"]["failure"], "withdrawn");
    }
    let seen = step(&mut agent, 2.0).await;
    assert_eq!(seen.meta["images"][0]["repair"]["failure"], "withdrawn");
    // A new session loads it again.
    let mut other = server.agent().await;
    other.open(opening("c", json!({"model": "hung"}))).await;
    assert_eq!(statuses(&step(&mut other, 2.0).await), ["repaired"; 2]);
    // The failure is on record, and a replay agrees.
    agent.ask(json!({"type": "close"})).await;
    let report = replay(&server, "a-1", &Models::default());
    assert_eq!((report.difference, report.wrong_value), (None, None));
    let frame = &lines(&server.episodes.path().join("a-1.jsonl"))[2];
    assert_eq!(frame["repairs"], json!([{"failed": "timed_out"}, null]));
}

#[tokio::test]
async fn nan_is_flagged_or_an_error_as_the_session_chose() {
    let nan = with_trust(&doubles::nan_if_doubtful(), "nan", 10_000);
    let server = server(&[&nan], 1).await;
    let mut flagged = server.agent().await;
    flagged.open(opening("a", json!({"model": "nan"}))).await;
    let seen = step(&mut flagged, 6.0).await;
    assert_eq!(statuses(&seen), ["failed"; 2]);
    assert_eq!(seen.meta["images"][1]["repair"]["failure"], "not_finite");
    assert_eq!(statuses(&step(&mut flagged, 2.0).await), ["repaired"; 2]);

    let mut strict = server.agent().await;
    strict.open(opening("b", json!({"model": "nan", "on_failure": "error"}))).await;
    assert_eq!(statuses(&step(&mut strict, 2.0).await), ["repaired"; 2]);
    let answer = strict.ask(beside(6.0)).await;
    refused(&answer, "repair_failed");
    let message = answer["message"].as_str().unwrap();
    assert!(message.contains("\"left\"") && message.contains("NaN"), "{answer}");
    // Nothing changed: the next step is the second, and the record has no other.
    let seen = step(&mut strict, 2.0).await;
    assert_eq!(seen.meta["step"], 2);
    assert_eq!(lines(&server.episodes.path().join("b-1.jsonl")).len(), 3);
}

#[tokio::test]
async fn a_model_that_is_swapped_on_disk_goes_on_as_it_was_loaded() {
    let folder = brighter();
    let server = server(&[&folder], 1).await;
    let mut agent = server.agent().await;
    let opened = agent.open(opening("a", json!({"model": "brighter"}))).await;
    let before = hashes(&step(&mut agent, 2.0).await);
    fs::write(folder.folder.path().join("model.onnx"), doubles::identity()).unwrap();
    assert_eq!(hashes(&step(&mut agent, 2.0).await), before);
    let mut other = server.agent().await;
    let again = other.open(opening("b", json!({"model": "brighter"}))).await;
    assert_eq!(again["repair"]["repair_hash"], opened["repair"]["repair_hash"]);
    assert_eq!(hashes(&step(&mut other, 2.0).await), before);
}

#[tokio::test]
async fn manifests_are_checked_before_a_server_starts() {
    let a = brighter();
    let b = brighter();
    let paths = [a.path(), b.path()];
    let error = Models::read(&paths, LoadOptions::new(library())).unwrap_err();
    assert!(error.to_string().contains("name: \"brighter\" is also that of"), "{error}");
    let error = Models::read(&paths[..1], LoadOptions::default()).unwrap_err();
    assert!(error.to_string().contains("--onnxruntime"), "{error}");
    let nowhere = a.folder.path().join("nowhere.so");
    let error = Models::read(&paths[..1], LoadOptions::new(nowhere)).unwrap_err();
    assert!(error.to_string().contains("nowhere.so"), "{error}");
}
