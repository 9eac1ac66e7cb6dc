use std::fs;
use std::path::Path;
use std::process::Output;

use crate::scene_files::{gaussians, inria_columns, ply};
use crate::wildcity;

fn import(dir: &Path, bytes: &[u8], more: &[&str]) -> Output {
    let source = dir.join("scene.ply");
    fs::write(&source, bytes).unwrap();
    let mut command = wildcity();
    command.arg("import").arg(source).args(["--twin", "street", "--twins"]).arg(dir.join("twins"));
    command.args(more).output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn refusal(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert_eq!(output.stdout, b"");
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[test]
fn import_inspect_and_verify_print_the_contents() {
    let dir = tempfile::tempdir().unwrap();
    let scene = ply(&gaussians(3_000, 1, 100.0, 1), &inria_columns(1, true));
    let rig = r#"{"name": "car", "cameras": [{"name": "front",
        "width": 64, "height": 48, "fx": 50, "fy": 50.0, "cx": 32.0, "cy": 24.0,
        "camera_to_rig": {"xyz": [1.5, 0, 1.6], "q": [0.5, -0.5, 0.5, -0.5]}}]}"#;
    let log = r#"{"name": "log", "keyframes": [
        {"time_us": 0, "world_from_rig": {"xyz": [0, 0, 0], "q": [1, 0, 0, 0]}},
        {"time_us": 100000, "world_from_rig": {"xyz": [3, 4, 0], "q": [1, 0, 0, 0]}}]}"#;
    let path = |name: &str| dir.path().join(name).display().to_string();
    fs::write(path("rig.json"), rig).unwrap();
    fs::write(path("log.json"), log).unwrap();
    let options = [
        "--axes",
        "y-down-z-forward",
        "--scale",
        "2",
        "--rig",
        &path("rig.json"),
        "--trajectory",
        &path("log.json"),
        "--set",
        "near=0.2",
        "--set",
        "alpha_cap=0.999",
    ];
    let output = import(dir.path(), &scene, &options);
    let said = stdout(&output);
    assert!(said.starts_with("twin street version 1: 3000 Gaussians of SH degree 1 in "), "{said}");
    let phases = String::from_utf8(output.stderr.clone()).unwrap();
    let has_phases = phases.starts_with("read ") && phases.contains(", publish ");
    assert!(
        has_phases && phases.lines().count() == 1,
        "no progress bar without a terminal: {phases}"
    );
    let hash = said.trim_end().rsplit(' ').next().unwrap().to_owned();
    assert_eq!(hash.len(), 64);

    let inspect = |more: &[&str]| {
        let twins = dir.path().join("twins");
        stdout(
            &wildcity()
                .args(["twin", "show", "street", "--twins"])
                .arg(twins)
                .args(more)
                .output()
                .unwrap(),
        )
    };
    let said = inspect(&[]);
    for line in [
        &format!("manifest    {hash}\n"),
        "gaussians   3000, SH degree 1\n",
        "profile     near=0.2 far=",
        "rig         car: front\n",
        "trajectory  log: 2 keyframes, 5.0 m\n",
        concat!(
            "builder     wildcity ",
            env!("CARGO_PKG_VERSION"),
            " axes=y-down-z-forward scale=2\n"
        ),
    ] {
        assert!(said.contains(line), "{line}\n{said}");
    }
    let json: serde_json::Value = serde_json::from_str(&inspect(&["--json"])).unwrap();
    assert_eq!(json["hash"], hash);
    assert_eq!(json["gaussians"], 3000);
    let source = format!("blake3:{}", blake3::hash(&scene).to_hex());
    assert_eq!(json["manifest"]["provenance"]["source"], source);
    let chunks = json["manifest"]["chunks"].as_array().unwrap();
    assert_eq!(chunks.iter().map(|c| c["count"].as_u64().unwrap()).sum::<u64>(), 3000);
    for chunk in chunks {
        assert!(
            said.contains(&chunk["object"].as_str().unwrap()[..16]),
            "the table has every chunk"
        );
    }

    let twins = dir.path().join("twins");
    let verify =
        wildcity().args(["twin", "fsck", "street", "--twins"]).arg(twins).output().unwrap();
    let said = stdout(&verify);
    assert!(said.starts_with(&format!("twin street: {} objects, ", chunks.len() + 2)), "{said}");
    assert!(said.ends_with("all sound\n"));
}

#[test]
fn a_truncated_ply_leaves_no_twin_and_says_why() {
    let dir = tempfile::tempdir().unwrap();
    let whole = ply(&gaussians(1_000, 0, 10.0, 1), &inria_columns(0, false));
    let said = refusal(&import(dir.path(), &whole[..30_000], &[]));
    assert!(said.contains("scene.ply: PLY body: the header promises 56000 bytes"), "{said}");
    assert!(said.contains("it is truncated"), "{said}");
    assert!(!dir.path().join("twins").exists());
}

#[test]
fn bad_options_are_named_before_the_file_is_read() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("broken.json"), "{").unwrap();
    let broken = dir.path().join("broken.json").display().to_string();
    for (options, wanted) in [
        (["--axes", "2 0 0 0 1 0 0 0 1"], "--axes \"2 0 0 0 1 0 0 0 1\": the rows of the matrix"),
        (["--axes", "sideways"], "--axes \"sideways\": expected nine numbers"),
        (["--scale", "-2"], "--scale \"-2.0\": a scale is from 1e-6 to 1e6"),
        (["--set", "fog=1"], "there is no field \"fog\""),
        (["--rig", &broken], "broken.json"),
        (["--trajectory", "/nonexistent.json"], "/nonexistent.json: cannot read: No such file"),
    ] {
        let scene = ply(&gaussians(10, 0, 1.0, 1), &inria_columns(0, false));
        let output = import(dir.path(), &scene, &options);
        assert!(!output.status.success());
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(said.contains(wanted), "{options:?}: {said}");
        assert!(!dir.path().join("twins").exists(), "{options:?}");
    }
}

#[test]
fn an_empty_scene_is_imported_with_a_warning() {
    let dir = tempfile::tempdir().unwrap();
    let output = import(dir.path(), &ply(&gaussians(0, 0, 1.0, 1), &inria_columns(0, false)), &[]);
    assert!(stdout(&output).contains(" 0 Gaussians"));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.starts_with("warning: ") && said.contains("holds no Gaussians"), "{said}");
    assert!(said.contains("note: there is no recorded drive"), "{said}");
}

#[test]
fn devices_pipes_and_files_for_directories_are_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file").display().to_string();
    fs::write(&file, b"").unwrap();
    for (arguments, code, wanted) in [
        (vec!["import", "/dev/zero", "--twin", "a"], 1, "not a regular file but a pipe, a socket"),
        (vec!["import", "/", "--twin", "a"], 1, "/ is a folder without lod-meta.json or meta.json"),
        (vec!["serve", "--twins", &file], 1, "is not a directory"),
        (vec!["serve", "--listen", "localhost:0"], 2, "an address and a port, as 127.0.0.1:8080"),
    ] {
        let mut command = wildcity();
        let output = command.env("HOME", dir.path()).args(&arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(wanted), "{arguments:?}: {said}");
    }
}

#[test]
fn a_bad_rig_or_drive_is_named_with_its_file_before_the_scene_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("settings.json").display().to_string();
    let drive = r#"{"name": "log", "keyframes": [
        {"time_us": 0, "world_from_rig": {"xyz": [0, 0, 0], "q": [1, 0, 0, 0]}}]}"#;
    let rig = r#"{"name": "car", "cameras": [{"name": "front", "width": 0, "height": 48, "fx": 50,
        "fy": 50, "cx": 32, "cy": 24,
        "camera_to_rig": {"xyz": [0, 0, 0], "q": [1, 0, 0, 0]}}]}"#;
    for (option, text, wanted) in [
        ("--rig", rig.to_owned(), "settings.json: camera \"front\": width is 0"),
        ("--rig", rig.replace("car", "Car"), "settings.json: \"Car\" is not a name"),
        ("--rig", "[]".into(), "settings.json is a JSON list, but must be one JSON object"),
        ("--trajectory", " []".into(), "settings.json is a JSON list, but must be one JSON object"),
        ("--trajectory", drive.replace("log", "a/b"), "settings.json: \"a/b\" is not a name"),
        ("--trajectory", r#"{"name": "log", "keyframes": []}"#.into(), "has no keyframes"),
        ("--trajectory", drive.to_owned(), "settings.json: two trajectories are named \"log\""),
    ] {
        fs::write(&path, text).unwrap();
        let twice = [option, &path, option, &path];
        let said = refusal(&import(
            dir.path(),
            b"no scene",
            &twice[..if option == "--rig" { 2 } else { 4 }],
        ));
        assert!(said.contains(wanted) && !said.contains("scene.ply"), "{said}");
    }
}

#[test]
fn the_files_that_help_shows_are_accepted() {
    let help = stdout(&wildcity().args(["import", "--help"]).output().unwrap());
    let dir = tempfile::tempdir().unwrap();
    let shown = |start: &str| {
        let from = &help[help.find(start).unwrap()..];
        let path = dir.path().join("shown.json").display().to_string();
        fs::write(&path, &from[..from.find("]}\n").unwrap() + 2]).unwrap();
        path
    };
    let scene = ply(&gaussians(10, 0, 1.0, 1), &inria_columns(0, false));
    stdout(&import(dir.path(), &scene, &["--rig", &shown("{\"name\": \"car\"")]));
    stdout(&import(dir.path(), &scene, &["--trajectory", &shown("{\"name\": \"log\"")]));
}

#[test]
fn an_absurd_number_of_threads_is_a_mistake_on_the_command_line() {
    let render =
        ["render", "street", "--cameras", "none.json", "--out", "x", "--threads", "9999999"];
    let output = wildcity().args(render).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("--threads") && said.contains("expected 0 to 1024"), "{said}");
}

#[test]
fn errors_caused_by_the_options_name_the_options() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = gaussians(10, 0, 1.0, 1);
    scene.means_m[7][1] = 3e6;
    let bytes = ply(&scene, &inria_columns(0, false));
    let said = refusal(&import(dir.path(), &bytes, &["--scale", "1000"]));
    let wanted = "after --axes \"identity\" --scale 1000: Gaussian 7: means_m[1] is 3000000000";
    assert!(said.contains(wanted), "{said}");
    scene.means_m[7][1] = 3e9;
    let said = refusal(&import(dir.path(), &ply(&scene, &inria_columns(0, false)), &[]));
    assert!(said.contains("scene.ply: Gaussian 7: y is 3000000000"), "{said}");
}

#[test]
fn help_has_examples() {
    for (command, wanted) in [
        ("import", "wildcity import skull.ply --twin skull --axes y-down-z-forward"),
        ("import", "Memory: twice the uncompressed scene"),
        ("import", "streamed SOG        a folder, or one .zip"),
        ("twin show", "wildcity twin show street@2"),
        ("twin fsck", "wildcity twin fsck street"),
        ("twin gc", "wildcity twin gc street --keep 20 --dry-run"),
    ] {
        let command = command.split(' ');
        let said = stdout(&wildcity().args(command).arg("--help").output().unwrap());
        assert!(said.contains(wanted) && said.contains("--twins <DIR_OR_URL>"), "{said}");
    }
}

#[test]
fn twins_are_in_the_users_data_directory() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("scene.ply");
    fs::write(&source, ply(&gaussians(10, 0, 1.0, 1), &inria_columns(0, false))).unwrap();
    let import = |variable: &str, value: &Path| {
        let mut command = wildcity();
        command.env_remove("XDG_DATA_HOME").env_remove("HOME").env(variable, value);
        command.arg("import").arg(&source).args(["--twin", "street"]).output().unwrap()
    };
    stdout(&import("XDG_DATA_HOME", &dir.path().join("xdg")));
    assert!(dir.path().join("xdg/wildcity/twins/street/log/0000000001").is_file());
    stdout(&import("HOME", &dir.path().join("home")));
    assert!(dir.path().join("home/.local/share/wildcity/twins/street/log/0000000001").is_file());
    assert!(refusal(&import("NEITHER", dir.path())).contains("give --twins DIR"));
}

#[test]
fn an_image_that_cannot_be_written_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    fs::write(path("scene.ply"), ply(&gaussians(10, 0, 1.0, 1), &inria_columns(0, false))).unwrap();
    let camera = r#"{"name": "front", "width": 32, "height": 16, "fx": 20, "fy": 20, "cx": 16,
        "cy": 8, "position": [0, 0, -5], "R_world_to_cam": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"#;
    fs::write(path("cameras.json"), camera).unwrap();
    fs::create_dir(path("out")).unwrap();
    for (format, extension, start) in [
        ("png", "png", &b"\x89PNG"[..]),
        ("jpeg", "jpg", b"\xff\xd8\xff"),
        ("npy", "npy", b"\x93NUM"),
    ] {
        // No file may grow beyond this number of blocks: 0 is a full disk.
        let render = |blocks: &str| {
            let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$@\"");
            let mut command = std::process::Command::new("sh");
            command.args(["-c", &script, "sh", env!("CARGO_BIN_EXE_wildcity"), "render"]);
            command.arg(path("scene.ply")).arg("--cameras").arg(path("cameras.json"));
            command.args(["--format", format, "--out"]).arg(path("out")).output().unwrap()
        };
        let picture = path("out").join(format!("front.{extension}"));
        stdout(&render("unlimited"));
        let good = fs::read(&picture).unwrap();
        assert!(good.starts_with(start), "{format}");
        // Smaller than any buffer: the only error is that of the last write.
        let said = refusal(&render("0"));
        assert!(said.contains(&format!("cannot write {}", picture.display())), "{said}");
        assert!(said.contains("File too large"), "{said}");
        assert_eq!(fs::read(&picture).unwrap(), good, "the picture of before is whole");
    }
}

#[test]
fn a_twin_is_copied_renamed_and_removed() {
    let twins = crate::support::twins();
    let run = |arguments: &[&str]| {
        wildcity().arg("twin").args(arguments).arg("--twins").arg(twins.path()).output().unwrap()
    };
    let copied = stdout(&run(&["copy", "test", "copy"]));
    assert!(copied.starts_with("twin copy version 1\nblake3 "), "{copied}");
    let taken = refusal(&run(&["copy", "test", "copy"]));
    assert!(taken.contains("copy") && taken.contains("exists"), "{taken}");
    let renamed = stdout(&run(&["rename", "copy", "street"]));
    assert!(renamed.starts_with("twin street version 1\n"), "{renamed}");
    assert_eq!(stdout(&run(&["remove", "test"])), "removed twin test\n");
    let listed = stdout(&run(&["list"]));
    assert!(listed.starts_with("street ") && listed.lines().count() == 1, "{listed}");
    let unknown = refusal(&run(&["remove", "test"]));
    assert!(unknown.contains("test") && unknown.contains("street"), "{unknown}");
}
