//! `wildcity push`, as users run it.

use std::fs::{self, File};
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::format_files::streamed;
use crate::http::{get, in_cell, post, write};
use crate::served::Served;
use crate::support::{self, TestServer};

#[tokio::test(flavor = "multi_thread")]
async fn a_file_is_pushed_and_reported() {
    let server = TestServer::start().await;
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "block.ply", &in_cell([0, 0], 40, 1));
    let run = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_wildcity"))
            .arg("push")
            .arg(&path)
            .args(["--twin", "test", "--server", &format!("http://{}", server.address())])
            .args(arguments)
            .output()
            .unwrap()
    };
    let done = tokio::task::block_in_place(|| run(&["--cells", "0,0", "--note", "first"]));
    let (out, err) =
        (String::from_utf8(done.stdout).unwrap(), String::from_utf8(done.stderr).unwrap());
    assert!(done.status.success(), "{out}{err}");
    for line in [
        "block.ply: 40 Gaussians",
        "cells       1, with 32 Gaussians before and 40 after",
        "version 2 is ready",
    ] {
        assert!(out.contains(line), "no {line:?} in {out}");
    }
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 2);

    let done = tokio::task::block_in_place(|| run(&["--cells", "9,9"]));
    let err = String::from_utf8(done.stderr).unwrap();
    assert!(!done.status.success() && err.contains("(9, 9)"), "{err}");
    let done = tokio::task::block_in_place(|| run(&["--base", "1"]));
    // The change since the base is this same content, as after a lost answer.
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let done = tokio::task::block_in_place(|| run(&["--cells", "x"]));
    assert!(!done.status.success());
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 3);
}

/// Runs the command, and returns whether it succeeded, and its output.
fn wildcity(arguments: &[&str]) -> (bool, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    let done = tokio::task::block_in_place(|| command.args(arguments).output().unwrap());
    let text = [done.stdout, done.stderr].concat();
    (done.status.success(), String::from_utf8(text).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_frame_of_a_push_is_said_and_the_log_has_its_note() {
    let server = TestServer::start().await;
    let url = format!("http://{}", server.address());
    let twins = server.twins.path().to_str().unwrap().to_owned();
    let dir = tempfile::tempdir().unwrap();
    let block = write(dir.path(), "block.ply", &in_cell([0, 0], 40, 1));
    let block = block.to_str().unwrap();
    let push = |note: &str, more: &[&str]| {
        let (ok, said) = wildcity(
            &[&["push", block, "--twin", "test", "--server", &url, "--note", note], more].concat(),
        );
        assert!(ok, "{said}");
        said
    };
    let never = push("first", &["--frame", "capture"]);
    assert!(never.contains("frame       the capture's, which is the twin's"), "{never}");
    assert!(!never.contains("warning"), "{never}");
    assert!(!push("first", &["--cells", "all"]).contains("frame"));
    let twice = json!({"scale": {"points": [[0, 0, 0], [0, 0, 1]], "distance_m": 2}});
    assert_eq!(post(&server, "/v1/twins/test/edits", &twice).await.status, 200);
    let twin = push("in\nmetres", &["--cells", "0,0"]);
    assert!(twin.contains("it was aligned") && twin.contains("need --frame capture"), "{twin}");
    assert!(twin.contains("warning: twin test was aligned"), "{twin}");
    let capture = push("epoch 30", &["--cells", "0,0", "--frame", "capture"]);
    assert!(capture.contains("frame       the capture's; turned, moved"), "{capture}");
    assert!(!capture.contains("warning"), "{capture}");
    let (ok, wrong) = wildcity(&["push", block, "--twin", "test", "--frame", "world"]);
    assert!(!ok && wrong.contains("--frame"), "{wrong}");

    let (_, inspected) = wildcity(&["twin", "show", "test", "--twins", &twins]);
    assert!(inspected.contains("alignment   2.000000 m per unit of the capture"), "{inspected}");
    assert!(inspected.contains("objects     1 chunk,"), "{inspected}");
    // The note of a push is not that of a later edit.
    let (ok, log) = wildcity(&["twin", "log", "test", "--twins", &twins]);
    let notes: Vec<&str> = log.lines().map(|line| line[46..].trim_start()[64..].trim()).collect();
    assert!(ok, "{log}");
    let aligned = "align=0,0,0,1,0,0,0,2";
    assert_eq!(notes, ["", "first", "first", aligned, "in metres", "epoch 30"], "{log}");
    let (_, log) = wildcity(&["twin", "log", "test", "--twins", &twins, "--json"]);
    let notes: Vec<Value> = log
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap()["note"].clone())
        .collect();
    assert_eq!(json!(notes), json!([null, "first", "first", null, "in\nmetres", "epoch 30"]));
    // A damaged manifest loses only its own note.
    let hash = log.lines().nth(1).unwrap();
    let hash = serde_json::from_str::<Value>(hash).unwrap()["hash"].as_str().unwrap().to_owned();
    let object = server.twins.path().join("test/objects").join(&hash[..2]).join(&hash);
    fs::write(object, "{}").unwrap();
    let (ok, log) = wildcity(&["twin", "log", "test", "--twins", &twins]);
    assert!(ok && log.contains("version 2: no note: ") && log.contains("epoch 30"), "{log}");
}

/// A streamed SOG has more files than a push: its folder is one archive.
#[tokio::test(flavor = "multi_thread")]
async fn the_folder_of_a_sog_is_pushed_as_one_file() {
    let server = TestServer::start().await;
    let url = format!("http://{}", server.address());
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("street");
    for (name, bytes) in streamed() {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
    let hash = |text: &str| text.lines().last().unwrap().to_owned();
    let mut pushed = Vec::new();
    for given in [folder.clone(), folder.join("lod-meta.json")] {
        let given = given.to_str().unwrap();
        let (ok, said) = wildcity(&["push", given, "--twin", "sog", "--server", &url]);
        assert!(ok && said.contains("street.zip: 50 Gaussians"), "{said}");
        pushed.push(hash(&said));
        for other in ["photo.webp", "notes.json", "0/video.mp4"] {
            fs::write(folder.join(other), "not named").unwrap();
        }
    }
    assert_eq!(pushed[0], pushed[1], "the same archive: what is not named is no part");
    // The command line reads the folder itself.
    let twins = dir.path().join("twins");
    let import = ["import", folder.to_str().unwrap(), "--twin", "sog", "--twins"];
    let (ok, said) = wildcity(&[&import[..], &[twins.to_str().unwrap()]].concat());
    assert!(ok && said.contains("twin sog version 1: 50 Gaussians"), "{said}");
    // A level of it, which the version records.
    let level = |number| [&import[..], &[twins.to_str().unwrap(), "--level", number]].concat();
    let (ok, said) = wildcity(&level("1"));
    assert!(ok && said.contains("twin sog version 2: 20 Gaussians"), "{said}");
    let (_, shown) = wildcity(&["twin", "show", "sog", "--twins", twins.to_str().unwrap()]);
    assert!(shown.contains("scale=1 level=1\n"), "{shown}");
    let (ok, said) = wildcity(&level("7"));
    assert!(!ok && said.contains("no level 7; the levels are 0, 1, 0 being the finest"), "{said}");
    // A single block.
    let block = folder.join("0/meta.json");
    let (ok, said) =
        wildcity(&["push", block.to_str().unwrap(), "--twin", "block", "--server", &url]);
    assert!(ok && said.contains("0.zip: 45 Gaussians"), "{said}");
    // The server has these bytes already, under another name.
    let again = dir.path().join("again");
    fs::rename(folder.join("0"), &again).unwrap();
    let asked = ["push", again.to_str().unwrap(), "--twin", "block", "--server", &url];
    let (ok, said) = wildcity(&asked);
    assert!(ok && said.contains("again.zip: 45 Gaussians"), "{said}");
    let (ok, said) = wildcity(&[&asked[..], &["--cells", "all", "--cells", "3,7"]].concat());
    assert!(!ok && said.contains("--cells all replaces all cells"), "{said}");
    fs::rename(&again, folder.join("0")).unwrap();
    let outside = dir.path().join("outside");
    fs::write(&outside, "secret").unwrap();
    std::os::unix::fs::symlink(&outside, folder.join("link.json")).unwrap();
    for (damaged, reason) in [
        (r#"{"filenames": ["link.json"]}"#, "a link that leads out of the folder"),
        (r#"{"filenames": ["../street/0/meta.json"]}"#, "which is not below its folder"),
        (r#"{"filenames": ["/etc/meta.json"]}"#, "which is not below its folder"),
        ("{", "lod-meta.json"),
    ] {
        fs::write(folder.join("lod-meta.json"), damaged).unwrap();
        let (ok, said) = wildcity(&["push", folder.to_str().unwrap(), "--twin", "sog"]);
        assert!(!ok && said.contains("cannot pack") && said.contains(reason), "{said}");
    }
    fs::remove_file(folder.join("lod-meta.json")).unwrap();
    let (ok, said) = wildcity(&["push", folder.to_str().unwrap(), "--twin", "sog"]);
    assert!(!ok && said.contains("is a folder without lod-meta.json or meta.json"), "{said}");
}

#[test]
fn a_push_is_followed_by_a_release_of_memory() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("log");
    let twins = support::twins();
    let at = twins.path().as_os_str().to_owned();
    let filter = "warn,wildcity_server::shutdown=debug";
    let server = Served::logging(filter, &at, twins, |command| {
        command.args(["--memory-release-s", "0.05"]).stderr(File::create(&log).unwrap())
    });
    let releases = || fs::read_to_string(&log).unwrap().matches("released free memory").count();
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(releases(), 0, "nothing was evicted or pushed");

    let block = write(dir.path(), "block.ply", &in_cell([0, 0], 40, 1));
    let url = format!("http://{}", server.address);
    let mut push = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    push.arg("push").arg(block).args(["--twin", "test", "--cells", "0,0", "--server", &url]);
    let pushed = push.output().unwrap();
    assert!(pushed.status.success(), "{pushed:?}");
    let deadline = Instant::now() + Duration::from_secs(60);
    while releases() == 0 {
        assert!(Instant::now() < deadline, "no memory was released");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Runs `wildcity actor` with some arguments. Returns whether it succeeded, and its output.
fn actor(arguments: &[&str]) -> (bool, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    let command = command.arg("actor").args(arguments);
    let done = tokio::task::block_in_place(|| command.output().unwrap());
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (done.status.success(), text(done.stdout), text(done.stderr))
}

/// `wildcity actor push` to a server, and `wildcity actor import` on this machine, with the same
/// options.
#[tokio::test(flavor = "multi_thread")]
async fn an_actor_is_pushed_as_it_is_imported() {
    let Some(van) = crate::data::real("vehicles/kenney_carkit/van.glb") else { return };
    let server = TestServer::start().await;
    let url = format!("http://{}", server.address());
    let dir = tempfile::tempdir().unwrap();
    let ply = write(dir.path(), "block.ply", &in_cell([0, 0], 400, 1));
    let own = dir.path().join("own").display().to_string();
    let paint = van.parent().unwrap().join("Textures/colormap-car.png");
    let axes = ["--axes", "0 0 1 1 0 0 0 1 0", "--gaussians", "2000", "--record", "q32"];
    let scale = ["--class", "object", "--scale", "0.5", "--record", "f32"];
    for (file, parts, options) in
        [(&van, vec![paint.to_str().unwrap()], &axes[..]), (&ply, vec![], &scale[..])]
    {
        let file = file.to_str().unwrap();
        let run = |command: &str, parts: &[&str], place: [&str; 2]| {
            actor(&[&[command, file], parts, options, &place[..]].concat())
        };
        let (imported, wanted, said) = run("import", &[], ["--twins", &own]);
        assert!(imported, "{said}");
        let (pushed, found, said) = run("push", &parts, ["--server", &url]);
        assert!(pushed, "{said}");
        let hash = |text: &str| text.lines().last().unwrap().to_owned();
        assert!(hash(&wanted).starts_with("blake3 ") && hash(&found) == hash(&wanted), "{found}");
        assert_eq!(found, wanted, "both say the same of it");
    }
    let listed = get(&server, "/v1/actors").await.body;
    let name = |index: usize| listed["actors"][index]["name"].as_str().unwrap_or_default();
    assert_eq!([name(0), name(1)], ["block", "van"]);

    let ply = ply.to_str().unwrap();
    for (arguments, why) in [
        (vec!["push", ply, "--server", &url, "--name", "van"], "another content"),
        (vec!["push", ply, "--server", &url, "--class", "tank"], "there is no class \"tank\""),
        (vec!["push", ply, "--server", &url, "--gaussians", "10"], "10"),
        (vec!["push", ply, "--server", &url, "--name", "A b"], "give --name"),
        (vec!["push", ply, "--server", &url, "--scale", "1000"], "check the axes and the scale"),
        (vec!["push", "nowhere.ply", "--server", &url], "cannot upload nowhere.ply"),
        (vec!["push", ply, "--server", "http://127.0.0.1:1"], "127.0.0.1:1"),
    ] {
        let (done, _, said) = actor(&arguments);
        assert!(!done && said.contains(why), "{arguments:?}: {said}");
    }
}
