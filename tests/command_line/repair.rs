//! `wildcity dev repair`, and that other commands do not load the runtime.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Stdio};

use crate::demo::copy_demo_twin;
use crate::onnx_models::{Folder, library, trained};
use crate::support::{self, Agent};
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
        command.args(["dev", "repair"]).args(arguments).env_remove("ORT_DYLIB_PATH");
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

/// A server, to test which libraries it has mapped.
struct Serving(Child);

impl Serving {
    /// Serves the twins at an address of its own; `arguments` come last.
    fn start(twins: &Path, episodes: &Path, arguments: &[&str]) -> (Serving, SocketAddr) {
        let mut command = wildcity();
        command.args(["serve", "--listen", "127.0.0.1:0", "--threads", "2"]);
        command.arg("--twins").arg(twins).arg("--episodes").arg(episodes);
        command.arg("--uploads").arg(episodes.join("uploads")).args(arguments);
        let mut server = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(server.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line.split("ws://").nth(1).and_then(|rest| rest.split('/').next());
        let address = address.unwrap_or_else(|| panic!("{line}")).parse().unwrap();
        (Serving(server), address)
    }

    fn has_runtime(&self) -> bool {
        let maps = fs::read_to_string(format!("/proc/{}/maps", self.0.id())).unwrap();
        assert!(maps.contains("wildcity"), "{maps}");
        maps.contains("onnxruntime")
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The manifest of the trained model in a folder; none where the data is absent.
fn zero_dce() -> Option<Folder> {
    let changes = serde_json::json!({
        "name": "zero-dce", "timeout_ms": 10_000,
        "inputs": [{"name": "input", "role": "rgb"}], "outputs": [{"name": "output", "role": "rgb"}],
    });
    Some(Folder::new(&trained("zero_dce_pp_rgb.onnx")?, changes))
}

#[tokio::test]
async fn only_a_session_that_asks_loads_the_library_and_its_record_is_repaired_again() {
    let Some(folder) = zero_dce() else { return };
    let manifest = folder.path().display().to_string();
    let library = library().display().to_string();
    let twins = support::twins();
    let episodes = tempfile::tempdir().unwrap();
    let repair = ["--repair", &manifest, "--onnxruntime", &library];
    let (server, address) = Serving::start(twins.path(), episodes.path(), &repair);

    // These cameras see no ground, so the trust depends only on the distance.
    let camera = serde_json::json!({"name": "front", "width": 64, "height": 16, "fx": 40.0, "fy": 40.0, "cx": 32.0,
        "cy": 12.0, "camera_to_rig": {"xyz": [0.5, 0.0, 1.5], "q": [0.5, -0.5, 0.5, -0.5]}});
    let rig = serde_json::json!({"name": "one", "cameras": [camera]});
    let outputs = serde_json::json!({"encoding": "raw"});
    let beside = |y_m: f64| {
        let pose = serde_json::json!({"xyz": [2.0, y_m, 0.0], "q": [1.0, 0.0, 0.0, 0.0]});
        serde_json::json!({"type": "step", "pose": pose})
    };
    let mut plain = Agent::connect(address).await;
    plain.hello().await;
    plain.open(serde_json::json!({"session": "plain", "rig": rig, "outputs": outputs})).await;
    let rendered = plain.look(beside(2.0)).await;
    assert!(!server.has_runtime(), "no session has asked");

    let mut agent = Agent::connect(address).await;
    agent.hello().await;
    let asked = serde_json::json!({"session": "a", "rig": rig, "outputs": outputs, "repair": {"model": "zero-dce"}});
    agent.open(asked).await;
    assert!(server.has_runtime());
    for y_m in [0.0, 2.0] {
        let seen = agent.look(beside(y_m)).await;
        let image = &seen.meta["images"][0];
        let is_repaired = image["repair"]["status"] == "repaired";
        assert_eq!(is_repaired, y_m > 0.0, "{image}");
        assert_eq!(image["hash"] != image["repair"]["rendered_hash"], is_repaired, "{image}");
        if is_repaired {
            assert_eq!(image["repair"]["rendered_hash"], rendered.meta["images"][0]["hash"]);
        }
    }
    agent.ask(serde_json::json!({"type": "close"})).await;
    drop(server);

    let replay = |arguments: &[&str]| {
        let mut command = wildcity();
        command.args(["episode", "verify"]).arg(episodes.path().join("a-1.jsonl"));
        command.arg("--twins").arg(twins.path()).args(arguments);
        let output = command.output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        text
    };
    let text = replay(&repair);
    assert!(text.contains("zero-dce 1 on cpu, 1 image\n"), "{text}");
    assert!(text.contains("1 image, repaired again and compared"), "{text}");
    let text = replay(&[]);
    assert!(text.contains("1 image, compared as rendered only"), "{text}");
}

#[test]
fn the_demo_says_what_its_repair_needs() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = wildcity();
    command.args(["demo", "--off-trajectory", "3", "--repair", "--twins", "twins"]);
    command.env_remove("ORT_DYLIB_PATH").current_dir(folder.path());
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let said = String::from_utf8_lossy(&output.stderr);
    for what in ["pip install onnxruntime", "--onnxruntime PATH", "ORT_DYLIB_PATH"] {
        assert!(said.contains(what), "no {what} in: {said}");
    }
    // Before the street is built, which takes a minute.
    assert!(!folder.path().join("twins").exists());
}

#[test]
fn a_manifest_that_is_wrong_stops_the_server_before_it_listens() {
    let folder = folder();
    let refused = |arguments: &[&str]| {
        let mut command = wildcity();
        command.args(["serve", "--listen", "127.0.0.1:0", "--twins", "twins", "--episodes", "e"]);
        command.args(["--uploads", "u"]).args(arguments).env_remove("ORT_DYLIB_PATH");
        let output = command.current_dir(folder.path()).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(output.stdout.is_empty());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let said = refused(&["--repair", "model.json"]);
    assert!(said.contains("--onnxruntime") && said.contains("ORT_DYLIB_PATH"), "{said}");
    let said = refused(&["--repair", "model.json,nowhere.json"]);
    assert!(said.contains("nowhere.json: No such file"), "{said}");
    let said = refused(&["--repair", "model.json,model.json", "--onnxruntime", "model.onnx"]);
    assert!(said.contains("is also that of model.json"), "{said}");
}

/// The model that comes with the project, from the degraded street to the pictures.
#[test]
fn the_demo_repairs_views_beside_its_drive() {
    let folder = tempfile::tempdir().unwrap();
    copy_demo_twin(&folder.path().join("wildcity/twins"));
    let mut command = wildcity();
    command.args(["demo", "--off-trajectory", "3", "--repair", "--out", "out", "--onnxruntime"]);
    command.arg(library()).current_dir(folder.path()).env("XDG_DATA_HOME", folder.path());
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let table = String::from_utf8(output.stdout).unwrap();
    let mean_db = |kind: &str| {
        let row = table.lines().find_map(|line| line.strip_prefix(kind)).expect(&table);
        let db: Vec<f64> = row.split_whitespace().map(|db| db.parse().unwrap()).collect();
        db.iter().sum::<f64>() / db.len() as f64
    };
    assert!(mean_db("repaired") > mean_db("rendered") + 2.0, "{table}");
    let picture = image::open(folder.path().join("out/beside_090.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (3 * 360, 3 * 232));
}
