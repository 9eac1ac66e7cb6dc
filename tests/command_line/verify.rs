//! `wildcity episode verify`.

use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use serde_json::json;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_server::Config;

use crate::episodes::{drive, lines, tamper};
use crate::support::{self, Agent};

fn wildcity(arguments: &[&str], episode: &Path, twins: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.args(["episode", "verify"]).arg(episode).arg("--twins").arg(twins).args(arguments);
    command.output().unwrap()
}

#[tokio::test]
async fn the_command_verifies_what_the_cpu_backend_served() {
    let (twins, episodes) = (support::twins(), tempfile::tempdir().unwrap());
    let directories = support::directories(twins.path(), episodes.path());
    let config = Config::local(directories, Arc::new(Cpu::new(2, Simd::Best).unwrap()));
    let running = wildcity_server::start(config).await.unwrap();
    let mut agent = Agent::connect(running.address()).await;
    agent.hello().await;
    // The session overrides the profile: the replay must use the recorded profile and not the
    // twin's.
    let own =
        json!({ "session": "a", "profile": { "blur": 4.0 }, "outputs": { "encoding": "raw" } });
    agent.open(own).await;
    drive(&mut agent).await;
    let path = episodes.path().join("a-1.jsonl");

    let verified = wildcity(&["--threads", "1"], &path, twins.path());
    let text = String::from_utf8(verified.stdout).unwrap();
    assert!(text.contains("test version 1") && text.contains("10 steps"), "{text}");
    assert!(verified.status.success() && text.contains("24 images"), "{text}");
    let out = episodes.path().join("pictures");
    let drawn = wildcity(&["--out", out.to_str().unwrap()], &path, twins.path());
    assert!(drawn.status.success());
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 24);
    let front = image::open(out.join("000003_step_front.png")).unwrap().into_rgb8();
    let recorded = lines(&path);
    assert_eq!(recorded[4]["images"][0], blake3::hash(&front).to_hex().as_str());

    let whole = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = whole.lines().collect();
    // A recording that was cut, between two lines or within one, is verified as far as it goes.
    let (head, last) = (lines[..lines.len() - 2].join("\n") + "\n", lines[lines.len() - 2]);
    for (text, code, wanted) in [
        (format!("{}\n", lines[0]), 1, "the recording has no frames"),
        (format!("{head}{last}\n"), 3, "the recording is cut, verified to step 10"),
        (format!("{head}{}", &last[..last.len() / 2]), 3, "the recording is cut, verified to step"),
    ] {
        std::fs::write(&path, text).unwrap();
        let partial = wildcity(&[], &path, twins.path());
        let error = String::from_utf8(partial.stderr).unwrap();
        assert_eq!(partial.status.code(), Some(code), "{error}");
        assert!(error.contains(wanted), "{error}");
        let mut show = Command::new(env!("CARGO_BIN_EXE_wildcity"));
        let shown = show.args(["episode", "show"]).arg(&path).output().unwrap();
        assert!(shown.status.success(), "it can still be looked at");
    }
    std::fs::write(&path, whole).unwrap();

    // Another backend gives different images, and `--out` writes them nevertheless.
    let others = episodes.path().join("others");
    let arguments = ["--backend", "reference", "--out", others.to_str().unwrap()];
    tamper(&path, 2, 0);
    tamper(&path, 5, 1);
    let drawn = wildcity(&arguments, &path, twins.path());
    let error = String::from_utf8(drawn.stderr).unwrap();
    assert!(drawn.status.code() == Some(1) && error.contains("differs at step"), "{error}");
    assert_eq!(std::fs::read_dir(&others).unwrap().count(), 24);

    let failed = wildcity(&[], &path, twins.path());
    assert_eq!(failed.status.code(), Some(1));
    let error = String::from_utf8(failed.stderr).unwrap();
    assert!(error.contains("step 2") && error.contains("\"front\""), "{error}");

    // By its name, in the folder of the records.
    let named = wildcity(
        &["--episodes", &episodes.path().display().to_string()],
        Path::new("a-1"),
        twins.path(),
    );
    assert_eq!(named.status.code(), Some(1));
    let missing = wildcity(&[], &episodes.path().join("b-1.jsonl"), twins.path());
    assert_eq!(missing.status.code(), Some(2));
    running.stop().await;
}
