//! `wildcity repair check`, and what other commands do not load.

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::Stdio;

use crate::wildcity;

/// A manifest whose model file has the text "not a graph".
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let model = b"not a graph";
    fs::write(folder.path().join("model.onnx"), model).unwrap();
    let manifest = serde_json::json!({
        "format": "wildcity.repair/1", "name": "double", "version": "1", "licence": "MIT",
        "files": [{"path": "model.onnx", "blake3": blake3::hash(model).to_hex().to_string()}],
        "providers": ["cpu"], "timeout_ms": 1000,
        "size": {"multiple_of": 1, "fit": "pad"}, "merge": "replace",
        "inputs": [{"name": "image", "role": "rgb"}],
        "outputs": [{"name": "repaired", "role": "rgb"}],
    });
    fs::write(folder.path().join("model.json"), manifest.to_string()).unwrap();
    folder
}

#[test]
fn mistakes_are_told_before_and_with_the_runtime_library() {
    let folder = folder();
    let refused = |arguments: &[&str]| {
        let mut command = wildcity();
        command.args(["repair", "check"]).args(arguments).env_remove("ORT_DYLIB_PATH");
        let output = command.current_dir(folder.path()).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(output.stdout.is_empty());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let said = refused(&["nowhere.json"]);
    assert!(said.contains("nowhere.json: No such file"), "{said}");
    let said = refused(&["model.json"]);
    assert!(said.contains("--onnxruntime") && said.contains("ORT_DYLIB_PATH"), "{said}");
    let said = refused(&["model.json", "--onnxruntime", "model.onnx"]);
    assert!(said.contains("--onnxruntime model.onnx") && said.contains("1.18"), "{said}");
    let said = refused(&["model.json", "--size", "7"]);
    assert!(said.contains("--size \"7\": give WIDTHxHEIGHT"), "{said}");
    fs::write(folder.path().join("model.onnx"), "swapped").unwrap();
    let said = refused(&["model.json"]);
    assert!(said.contains("files[0].blake3") && said.contains("pin the new hash"), "{said}");
}

/// A server without repair maps no runtime library, even where the environment names one.
#[test]
fn a_server_loads_no_runtime_library() {
    let folder = tempfile::tempdir().unwrap();
    let mut server = wildcity()
        .args(["serve", "--listen", "127.0.0.1:0", "--twins", "twins", "--episodes", "episodes"])
        .args(["--uploads", "uploads"])
        .current_dir(folder.path())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let maps = fs::read_to_string(format!("/proc/{}/maps", server.id()));
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(line.contains("listening"), "{line}");
    let maps = maps.unwrap();
    assert!(maps.contains("wildcity") && !maps.contains("onnxruntime"), "{maps}");
}
