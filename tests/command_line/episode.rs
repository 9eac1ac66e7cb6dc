//! `wildcity episode`.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::json;

use crate::support;

fn wildcity(arguments: &[&str], dir: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    command.arg("episode").args(arguments).current_dir(dir);
    command.output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn a_suite_is_driven_and_its_records_are_read() {
    let (twins, dir) = (support::twins(), tempfile::tempdir().unwrap());
    let scenario = json!({
        "format": "wildcity.scenario/1", "name": "short", "twin": { "name": "test" },
        "ego": { "start": { "trajectory": "log", "station_m": 0.0 } }, "end": { "time_s": 0.8 },
    });
    std::fs::write(dir.path().join("short.json"), scenario.to_string()).unwrap();
    let twins = twins.path().to_str().unwrap();
    let run = |agent: &str, out: &str| {
        let backend =
            ["--backend", "cpu", "--threads", "1", "--verify", "--accept-unjudged", "off_road"];
        let arguments = ["run", "short.json", "--twins", twins, "--agent", agent, "--out", out];
        wildcity(&[&arguments[..], &backend].concat(), dir.path())
    };

    let log = run("log", "log");
    let text = stdout(&log);
    assert_eq!(log.status.code(), Some(0), "{text}{}", String::from_utf8_lossy(&log.stderr));
    assert!(text.contains("passed      1 of 1") && text.contains("all episodes repeat"), "{text}");
    for file in ["result.json", "junit.xml", "report.html", "episodes/short-0-1.jsonl"] {
        assert!(dir.path().join("log").join(file).is_file(), "{file}");
    }
    let stand = run("stand", "stand");
    assert_eq!(stand.status.code(), Some(1), "{}", stdout(&stand));
    assert!(stdout(&stand).contains("progress"), "{}", stdout(&stand));
    // A verdict is not an error of the program.
    let verdict = String::from_utf8(stand.stderr).unwrap();
    let (ended, verdict) = verdict.split_once('\n').unwrap();
    // An episode is told as it ends.
    assert!(ended.starts_with("1/1 after ") && ended.ends_with(" s: failed short-0"), "{ended}");
    assert!(verdict.starts_with("of 1 episode: 1 failed"), "{verdict}");
    let wanted = ["run", "short.json", "--twins", twins, "--at-least", "0.9", "--out", "wanted"];
    let accepted = ["--backend", "cpu", "--accept-unjudged", "off_road"];
    let wanted = wildcity(&[&wanted[..], &accepted].concat(), dir.path());
    assert_eq!(wanted.status.code(), Some(1), "{}", stdout(&wanted));
    let verdict = String::from_utf8(wanted.stderr).unwrap();
    // Wilson: 1 of 1 is 0.207 to 1.
    assert!(verdict.contains("the pass rate is at least 0.207, and 0.9 was wanted"), "{verdict}");
    let again = run("log", "log");
    assert_eq!(again.status.code(), Some(2), "the directory has another run");
    assert!(again.stderr.starts_with(b"error: "), "{}", String::from_utf8_lossy(&again.stderr));
    assert_eq!(wildcity(&["run", "nowhere.json"], dir.path()).status.code(), Some(2));
    // An export that cannot be written is reported on standard error and in the report, not in the
    // result.
    std::fs::create_dir_all(dir.path().join("told/episodes/short-0-1.mcap")).unwrap();
    let told = run("log", "told");
    assert_eq!(told.status.code(), Some(0), "{}", stdout(&told));
    let warning = String::from_utf8(told.stderr).unwrap();
    assert!(warning.contains("warning: no MCAP file of short-0: cannot write"), "{warning}");
    let result = |run: &str| std::fs::read(dir.path().join(run).join("result.json")).unwrap();
    assert_eq!(result("told"), result("log"));

    let records = ["log", "stand"].map(|run| format!("{run}/episodes"));
    let listed = stdout(&wildcity(&["list", "--episodes", &records[0]], dir.path()));
    // The record does not know what the suite accepts.
    assert!(listed.contains("short-0-1") && listed.contains("short not_judged"), "{listed}");
    let shown = stdout(&wildcity(&["show", "short-0-1", "--episodes", &records[0]], dir.path()));
    assert!(shown.contains("scenario    short") && shown.contains("8 steps"), "{shown}");
    // Why an episode failed, with the values.
    let failed = stdout(&wildcity(&["show", "short-0-1", "--episodes", &records[1]], dir.path()));
    assert!(failed.contains("verdict     failed\nfault       progress at "), "{failed}");
    assert!(failed.contains(" of the recorded drive, and 0.8 is the least"), "{failed}");
    let scored = stdout(&wildcity(&["score", "short-0-1", "--episodes", &records[1]], dir.path()));
    assert!(
        scored.contains("short-0-1: failed") && scored.contains("fault   progress"),
        "{scored}"
    );
    let files = records.map(|records| format!("{records}/short-0-1.jsonl"));
    let same = wildcity(&["diff", &files[0], &files[0]], dir.path());
    assert_eq!(same.status.code(), Some(0));
    let other = wildcity(&["diff", &files[0], &files[1]], dir.path());
    assert_eq!(other.status.code(), Some(1));
    let error = String::from_utf8(other.stderr).unwrap();
    assert!(error.starts_with("the episodes differ at step 1: ego"), "{error}");
    let exported = wildcity(&["diff", &files[0], "log/episodes/short-0-1.mcap"], dir.path());
    let error = String::from_utf8(exported.stderr).unwrap();
    assert!(error.contains("short-0-1.mcap is an MCAP export"), "{error}");
    assert!(error.contains("log/episodes/short-0-1.jsonl"), "{error}");
    let mut replay = Command::new(env!("CARGO_BIN_EXE_wildcity"));
    let replayed =
        replay.args(["episode", "verify", "log/episodes/short-0-1.mcap"]).current_dir(dir.path());
    let error = String::from_utf8(replayed.output().unwrap().stderr).unwrap();
    assert!(error.contains("short-0-1.mcap is an MCAP export"), "{error}");

    let video = ["video", &files[0], "--out", "frames", "--twins", twins, "--backend", "cpu"];
    let text = stdout(&wildcity(&video, dir.path()));
    assert!(text.contains("9 pictures") && text.contains("ffmpeg -framerate 10 "), "{text}");
    assert!(!text.contains("differs"), "{text}");
    assert!(dir.path().join("frames/000008.png").is_file());

    let exported = wildcity(&["export", &files[0], "--mcap", "log.mcap"], dir.path());
    assert!(exported.status.success(), "{}", String::from_utf8_lossy(&exported.stderr));
    let bytes = std::fs::read(dir.path().join("log.mcap")).unwrap();
    assert!(bytes.starts_with(b"\x89MCAP0\r\n") && bytes.ends_with(b"\x89MCAP0\r\n"));
    let images = [
        "export",
        &files[0],
        "--mcap",
        "images.mcap",
        "--images",
        "--twins",
        twins,
        "--backend",
        "cpu",
    ];
    let text = stdout(&wildcity(&images, dir.path()));
    assert!(text.contains("images      ") && !text.contains("differs"), "{text}");
    let with_images = std::fs::read(dir.path().join("images.mcap")).unwrap();
    let count = |bytes: &[u8], topic: &str| {
        let messages = mcap::MessageStream::new(bytes).unwrap().map(|message| message.unwrap());
        let of_topic = messages.filter(|message| message.channel.topic == topic);
        of_topic
            .filter(|message| {
                topic.contains("step") || message.data.windows(2).any(|two| two == [0xff, 0xd8])
            })
            .count()
    };
    assert_eq!((count(&with_images, "/camera/0/image"), count(&bytes, "/camera/0/image")), (9, 0));
    assert_eq!(count(&with_images, "/wildcity/step"), count(&bytes, "/wildcity/step"));
    let unknown = wildcity(&[&images[..], &["--camera", "roof"]].concat(), dir.path());
    assert!(String::from_utf8(unknown.stderr).unwrap().contains("--camera roof: the episode has"));
    // The run wrote the same file next to the record; the order of the index differs from file to
    // file.
    let of_run = std::fs::read(dir.path().join("log/episodes/short-0-1.mcap")).unwrap();
    assert_eq!((count(&of_run, "/wildcity/step"), of_run.len()), (9, bytes.len()));
    let none = ["run", "short.json", "--twins", twins, "--mcap", "false", "--out", "none"];
    let accepted = ["--backend", "cpu", "--accept-unjudged", "off_road"];
    let driven = wildcity(&[&none[..], &accepted].concat(), dir.path());
    assert_eq!(driven.status.code(), Some(0));
    assert!(!dir.path().join("none/episodes/short-0-1.mcap").exists());
}

#[test]
fn old_records_are_pruned() {
    let dir = tempfile::tempdir().unwrap();
    let now = std::time::SystemTime::now();
    for (name, days) in [("new", 1), ("old", 40)] {
        let path = dir.path().join(format!("{name}-1.jsonl"));
        std::fs::write(&path, "{\"kind\":\"end\"}\n").unwrap();
        let file = std::fs::OpenOptions::new().append(true).open(path).unwrap();
        file.set_modified(now - std::time::Duration::from_secs(days * 86_400)).unwrap();
    }
    let prune = |arguments: &[&str]| {
        let all = [&["prune", "--episodes", "."], arguments].concat();
        wildcity(&all, dir.path())
    };
    let none = prune(&[]);
    assert_eq!(none.status.code(), Some(2), "a limit is needed: {none:?}");
    let dry = prune(&["--older-than", "30d", "--dry-run"]);
    let said = "would be removed old-1\nwould be removed 1 record, 15 bytes\nkept 1 record\n";
    assert_eq!((dry.status.code(), stdout(&dry).as_str()), (Some(0), said), "{dry:?}");
    let done = prune(&["--older-than", "30d", "--keep", "5"]);
    assert_eq!(stdout(&done), said.replace("would be removed", "removed"), "{done:?}");
    assert!(dir.path().join("new-1.jsonl").exists() && !dir.path().join("old-1.jsonl").exists());
}

#[test]
fn before_the_first_drive_there_is_nothing_to_prune() {
    let dir = tempfile::tempdir().unwrap();
    let prune = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_wildcity"));
        command.args(["episode", "prune", "--keep", "5"]).args(more);
        command.current_dir(dir.path()).env("XDG_STATE_HOME", dir.path()).output().unwrap()
    };
    let default = prune(&[]);
    let said = format!(
        "nothing to remove: there is no folder {}\n",
        dir.path().join("wildcity/episodes").display()
    );
    assert_eq!((default.status.code(), stdout(&default)), (Some(0), said), "{default:?}");
    // A folder that is named may be misspelt.
    let named = prune(&["--episodes", "no-such-folder"]);
    assert_eq!(named.status.code(), Some(2), "{named:?}");
}
