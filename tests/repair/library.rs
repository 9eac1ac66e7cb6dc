//! The runtime library: loaded when the first model is, once, and never a second one. Each test has
//! a process of its own, since a library stays.

use std::fs;
use std::process::Command;

use serde_json::json;
use tempfile::TempDir;
use wildcity_repair::{LoadOptions, Model, RepairError, is_loaded};

use crate::onnx_doubles as doubles;
use crate::onnx_models::{Folder, library};
use crate::support::maps;

/// Runs `test` of this file by itself in a process, with `path` as its input.
fn alone(test: &str, path: &std::path::Path) {
    let output = Command::new(std::env::current_exe().unwrap())
        .args([&format!("library::{test}"), "--exact", "--ignored", "--nocapture"])
        .env("REPAIR_TEST_LIBRARY", path)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.contains("1 passed"), "{text}\n{errors}");
}

fn given() -> std::path::PathBuf {
    std::env::var_os("REPAIR_TEST_LIBRARY").unwrap().into()
}

fn refusal() -> String {
    let folder = Folder::new(&doubles::identity(), json!({}));
    let error = Model::load(&folder.path(), &LoadOptions::new(given())).unwrap_err();
    assert!(matches!(error, RepairError::Runtime { .. }), "{error}");
    assert!(!is_loaded());
    error.to_string()
}

#[test]
fn a_missing_or_foreign_library_is_an_error() {
    let folder = TempDir::new().unwrap();
    let text = folder.path().join("libonnxruntime.so");
    alone("missing", &text);
    fs::write(&text, "no library").unwrap();
    alone("no_library", &text);
    // A library that is always there, and has no models.
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let other =
        maps.split_whitespace().find(|word| word.contains("libc.so")).expect("libc is mapped");
    alone("another_library", std::path::Path::new(other));
}

#[test]
#[ignore = "run by another test, in a process of its own"]
fn missing() {
    let text = refusal();
    assert!(text.contains("No such file") && text.contains("name a libonnxruntime.so"), "{text}");
}

#[test]
#[ignore = "run by another test, in a process of its own"]
fn no_library() {
    let text = refusal();
    assert!(text.contains("name a libonnxruntime.so from version 1.18 on"), "{text}");
}

#[test]
#[ignore = "run by another test, in a process of its own"]
fn another_library() {
    let text = refusal();
    assert!(text.contains("OrtGetApiBase"), "{text}");
}

#[test]
fn the_library_is_loaded_by_the_first_model_and_only_by_one() {
    alone("lazily", &library());
}

#[test]
#[ignore = "run by another test, in a process of its own"]
fn lazily() {
    let library = given();
    let threads = || fs::read_dir("/proc/self/task").unwrap().count();
    let before = threads();
    assert!(!is_loaded() && !maps("self", "onnxruntime"));
    // A manifest that is refused opens no library.
    let wrong = Folder::new(&doubles::identity(), json!({"timeout_ms": 0}));
    Model::load(&wrong.path(), &LoadOptions::new(&library)).unwrap_err();
    assert!(!is_loaded() && !maps("self", "onnxruntime"));
    assert_eq!(threads(), before);

    let folder = Folder::new(&doubles::identity(), json!({}));
    let model = Model::load(&folder.path(), &LoadOptions::new(&library)).unwrap();
    assert!(is_loaded() && maps("self", "onnxruntime"));
    // A copy is another file: the process keeps the first.
    let copy = folder.folder.path().join("copy.so");
    fs::copy(&library, &copy).unwrap();
    let error = Model::load(&folder.path(), &LoadOptions::new(&copy)).unwrap_err();
    assert!(matches!(error, RepairError::RuntimeLoaded { .. }), "{error}");
    drop(model);
    folder.load_with_threads(1);
}
