//! `wildcity episode run` and `compare` in CI: refused input, comparisons, and exit codes.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::{support, wildcity};

/// A folder with the twin `test` and a suite of one scenario and two seeds.
struct Bench {
    dir: TempDir,
    twins: TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { dir: tempfile::tempdir().unwrap(), twins: support::twins() };
        bench.write("short.json", &scenario(json!({})));
        bench.write("suite.json", &suite(json!({ "cameras": ["front"], "seeds": [0, 1] })));
        bench
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    fn write(&self, name: &str, value: &Value) {
        std::fs::write(self.path().join(name), value.to_string()).unwrap();
    }

    fn episode(&self, arguments: &[&str]) -> Command {
        let mut command = wildcity();
        command.arg("episode").args(arguments).current_dir(self.path());
        command
    }

    /// Runs `suite.json` into the folder `out`.
    fn run(&self, agent: &str, out: &str, more: &[&str]) -> Output {
        self.run_suite("suite.json", agent, out, more).output().unwrap()
    }

    fn run_suite(&self, suite: &str, agent: &str, out: &str, more: &[&str]) -> Command {
        let mut command = self.episode(&["run", suite, "--agent", agent, "--out", out]);
        let twins = self.twins.path().to_str().unwrap();
        command.args(["--twins", twins, "--backend", "cpu", "--threads", "1"]).args(more);
        command
    }

    fn out(&self, name: &str) -> String {
        std::fs::read_to_string(self.path().join(name)).unwrap()
    }
}

/// An object with some fields replaced.
fn with(mut value: Value, fields: Value) -> Value {
    let fields = fields.as_object().unwrap().clone();
    value.as_object_mut().unwrap().extend(fields);
    value
}

fn scenario(fields: Value) -> Value {
    let value = json!({
        "format": "wildcity.scenario/1", "name": "short", "twin": { "name": "test" },
        "ego": { "start": { "trajectory": "log", "station_m": 0.0 } }, "end": { "time_s": 0.4 },
    });
    with(value, fields)
}

fn suite(fields: Value) -> Value {
    let value = json!({
        "format": "wildcity.suite/1", "name": "ci", "scenarios": ["short.json"],
        "accept_unjudged": ["off_road"],
    });
    with(value, fields)
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// Asserts the exit code, and returns standard output and standard error.
#[track_caller]
fn ends(output: &Output, code: i32) -> (&str, &str) {
    let said = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "{}{}", said.0, said.1);
    said
}

#[test]
fn two_runs_are_compared_with_an_exit_code() {
    let bench = Bench::new();
    ends(&bench.run("log", "main", &[]), 0);
    ends(&bench.run("stand", "stand", &[]), 1);
    let compare =
        |arguments: &[&str]| bench.episode(&[&["compare"], arguments].concat()).output().unwrap();
    let same = compare(&["main/result.json", "main"]);
    let (out, _) = ends(&same, 0);
    assert!(out.contains("not worse than before: every episode that passed"), "{out}");

    let files = ["--json", "c.json", "--html", "c.html"];
    let worse = compare(&[&["main", "stand/result.json"], &files[..]].concat());
    let (out, error) = ends(&worse, 1);
    assert!(
        out.contains("worse       short-0 ") && out.contains("passed before, now failed"),
        "{out}"
    );
    assert!(out.contains("wildcity.verdict@3") && out.contains("-1.0000"), "{out}");
    assert!(error.starts_with("worse than before: 2 episodes that passed"), "{error}");
    let comparison: Value = serde_json::from_str(&bench.out("c.json")).unwrap();
    assert_eq!((&comparison["worse"], &comparison["counts"]["worse"]), (&json!(true), &json!(2)));
    let page = bench.out("c.html");
    assert!(page.contains("Worse than before: 2 episodes"));
    // Without the twins, the page says why it has no pictures.
    assert_eq!(page.matches("No picture: there is no twin").count(), 2, "{page}");
    let twins = ["--twins", bench.twins.path().to_str().unwrap()];
    ends(&compare(&[&["main", "stand/result.json"], &files[..], &twins].concat()), 1);
    let page = bench.out("c.html");
    let pictures: Vec<&str> = page.split("data:image/jpeg;base64,").skip(1).collect();
    assert_eq!(pictures.len(), 2, "before and now; the second seed repeats the drive of the first");
    let jpeg = |at: usize| pictures[at].split('"').next().unwrap();
    assert_ne!(jpeg(0), jpeg(1), "one drove on, the other stood");
    // Both at the time of the fault, which is the end of the one that stood.
    assert_eq!(page.matches("<small>front after 0.4 s</small>").count(), 2, "{page}");
    assert_eq!(compare(&["main", "stand"]).stdout, worse.stdout, "deterministic");

    ends(&compare(&["stand", "main"]), 0);
    ends(&compare(&["main", "stand", "--worse-by", "pass_rate=1"]), 0);
    for (arguments, wanted) in [
        (["main", "nowhere"], "cannot read nowhere"),
        (["main", "suite.json"], "suite.json is no result of a run: its format is"),
        (["main", "main/junit.xml"], "junit.xml is no result of a run"),
    ] {
        let refused = compare(&arguments);
        assert!(ends(&refused, 2).1.contains(wanted), "{}", text(&refused.stderr));
    }
    let unknown = compare(&["main", "stand", "--worse-by", "speed=1"]);
    assert!(ends(&unknown, 2).1.contains("--worse-by speed: no such score; there is pass_rate, "));
    ends(&compare(&["main", "stand", "--worse-by", "pass_rate"]), 2);
}

#[test]
fn a_run_against_another_is_one_command() {
    let bench = Bench::new();
    ends(&bench.run("log", "main", &[]), 0);
    ends(&bench.run("stand", "stand", &[]), 1);
    let worse = bench.run("stand", "worse", &["--against", "main/result.json"]);
    let (out, error) = ends(&worse, 1);
    assert!(out.contains("verdicts    2 worse, 0 better"), "{out}");
    assert!(error.contains("worse than before: 2 episodes that passed before do not"), "{error}");
    assert!(bench.path().join("worse/comparison.json").is_file());
    let page = bench.out("worse/comparison.html");
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 2, "pictures of both runs");
    assert!(bench.out("worse/report.html").contains("<b>Not passed</b>: of 2 episodes: 2 failed"));

    // Episodes that failed before may fail again; the content of junit.xml does not change.
    let kept = bench.run("stand", "kept", &["--against", "stand"]);
    let (out, _) = ends(&kept, 0);
    assert!(
        out.contains("ended       of 2 episodes: 2 failed") && out.contains("not worse"),
        "{out}"
    );
    let xml = bench.out("kept/junit.xml");
    assert!(xml.contains("failures=\"2\"") && xml.contains("\"exit_code\" value=\"0\""), "{xml}");

    // Refused before anything is driven.
    for more in [
        &["--against", "nowhere/result.json"][..],
        &["--against", "main", "--worse-by", "speed=1"],
        &["--worse-by", "pass_rate=1"],
    ] {
        ends(&bench.run("log", "refused", more), 2);
        assert!(!bench.path().join("refused").exists(), "{more:?}");
    }
    bench.write("short.json", &scenario(json!({ "end": { "time_s": 0.3 } })));
    let other = bench.run("log", "refused", &["--against", "main"]);
    let (_, error) = ends(&other, 2);
    assert!(error.contains("2 episodes were driven before, all in other versions"), "{error}");
}

#[test]
fn a_run_says_why_it_ended_so() {
    let bench = Bench::new();
    let passed = bench.run("log", "log", &["--at-least", "0.1"]);
    let (out, _) = ends(&passed, 0);
    // Two seeds without jitter are one episode: Wilson of 1 of 1.
    assert!(out.contains("passed      1 of 1 (95 %: 20.7 to 100.0 %)"), "{out}");
    assert!(
        out.contains("note        1 of 2 episodes repeats the drive of an earlier seed"),
        "{out}"
    );
    assert!(
        out.contains("short-1") && out.contains("the same drive as short-0, not counted again"),
        "{out}"
    );
    assert!(out.contains("the pass rate is at least 0.207, as wanted (0.1)"), "{out}");
    assert!(bench.out("log/report.html").contains("as wanted (0.1)"));
    let result: Value = serde_json::from_str(&bench.out("log/result.json")).unwrap();
    assert_eq!(result["counts"]["duplicates"], 1);
    assert_eq!(result["episodes"][1]["duplicate_of"], "short-0");

    let technical = bench.run("echo broken driver >&2; exit 7", "technical", &["--retries", "0"]);
    let (out, error) = ends(&technical, 3);
    assert!(out.contains("passed      no episode was judged"), "{out}");
    assert!(
        out.contains("exit status: 7 and drove nothing") && out.contains("broken driver"),
        "{out}"
    );
    assert!(!out.contains("0 of 0") && error.contains("broken driver"), "{out}{error}");
    assert!(bench.out("technical/junit.xml").contains("broken driver"));
}

#[test]
fn agents_and_suites_that_are_none_are_refused() {
    let bench = Bench::new();
    let unknown = bench.run("idmm", "unknown", &[]);
    let (out, error) = ends(&unknown, 2);
    for wanted in ["\"idmm\" cannot be started", "log, stand or idm", "egodriver:HOST:PORT"] {
        assert!(error.contains(wanted), "{error}");
    }
    assert_eq!(out, "", "no episode was tried");
    for (agent, wanted) in [
        ("egodriver:localhost", "there is no port"),
        ("egodriver:localhost:0", "from 1 to 65535"),
        ("egodriver::7102", "there is no host"),
        ("egodriver:localhost:1; true", "letters, digits"),
        ("egodriver:::1:7102", "stands in brackets"),
        (" ", "the agent is empty"),
    ] {
        let refused = bench.run(agent, "refused", &[]);
        assert!(ends(&refused, 2).1.contains(wanted), "{}", text(&refused.stderr));
    }
    bench.write("roof.json", &suite(json!({ "cameras": ["roof"] })));
    let refused = bench.run_suite("roof.json", "log", "refused", &[]).output().unwrap();
    let (_, error) = ends(&refused, 2);
    assert!(
        error.contains("roof.json: cameras[0]: \"roof\" is no camera of twin \"test\""),
        "{error}"
    );
    assert!(!bench.path().join("refused").exists());
}

#[test]
fn a_driver_that_does_not_listen_is_waited_for_aloud() {
    let bench = Bench::new();
    // A port that was free a moment ago.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let agent = format!("egodriver:127.0.0.1:{port}");
    let mut command = bench.run_suite("suite.json", &agent, "out", &[]);
    let mut running = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(running.stderr.take().unwrap()).read_line(&mut line).unwrap();
    running.kill().unwrap();
    running.wait().unwrap();
    assert!(line.starts_with(&format!("waiting for 127.0.0.1:{port}, up to 120 s: ")), "{line}");
}

#[test]
fn what_cannot_be_read_is_two_and_not_a_difference() {
    let bench = Bench::new();
    std::fs::write(bench.path().join("text.jsonl"), "{}\n").unwrap();
    let frames = ["--out", "frames"];
    let mcap = ["--mcap", "out.mcap"];
    for (command, more) in [
        ("show", &[][..]),
        ("score", &[]),
        ("video", &frames),
        ("export", &mcap),
        ("diff", &["text.jsonl"]),
    ] {
        for file in ["nowhere.jsonl", "text.jsonl"] {
            let refused = bench.episode(&[&[command, file], more].concat()).output().unwrap();
            let (_, error) = ends(&refused, 2);
            assert!(error.contains(file) && error.starts_with("error: "), "{command}: {error}");
        }
    }
    assert!(!bench.path().join("frames").exists());
}

#[test]
fn episodes_differ_in_words() {
    let bench = Bench::new();
    bench.write("suite.json", &suite(json!({ "cameras": ["front"], "seeds": [0, 1] })));
    ends(&bench.run("log", "a", &[]), 0);
    bench.write("short.json", &scenario(json!({ "end": { "time_s": 0.3 } })));
    ends(&bench.run("log", "b", &[]), 0);
    let [first, second, shorter] =
        ["a/episodes/short-0-1", "a/episodes/short-1-1", "b/episodes/short-0-1"]
            .map(|name| format!("{name}.jsonl"));
    let diff = |other: &str| bench.episode(&["diff", &first, other]).output().unwrap();
    let found = diff(&second);
    let (_, error) = ends(&found, 1);
    assert_eq!(error.trim_end(), "the episodes were not set up alike: seed 0 against 1");
    let found = diff(&shorter);
    let (_, error) = ends(&found, 1);
    let wanted = "the episodes were not set up alike: scenario short: end.time_s 0.4 against 0.3";
    assert_eq!(error.trim_end(), wanted);
    let exported = diff("a/episodes/short-0-1.mcap");
    assert!(ends(&exported, 2).1.contains("only the record is read: a/episodes/short-0-1.jsonl"));
}

#[test]
fn records_are_found_in_a_run_and_named() {
    let bench = Bench::new();
    ends(&bench.run("log", "main", &[]), 0);
    let list = |episodes: &str| bench.episode(&["list", "--episodes", episodes]).output().unwrap();
    for folder in ["main", "main/episodes"] {
        let listed = list(folder);
        let (out, _) = ends(&listed, 0);
        let lines: Vec<&str> = out.lines().collect();
        assert_eq!(lines.len(), 3, "{out}");
        assert!(lines[0].starts_with("record") && lines[0].ends_with("scenario, verdict"), "{out}");
        assert!(lines[1..].iter().any(|line| line.starts_with("short-1-1")), "{out}");
    }
    let shown = bench.episode(&["show", "short-0-1", "--episodes", "main"]).output().unwrap();
    ends(&shown, 0);
    let above = list(".");
    let (out, _) = ends(&above, 0);
    assert!(out.starts_with("no episodes in ") && out.contains("./main/episodes"), "{out}");
    let missing = list("nowhere");
    assert!(
        ends(&missing, 2).1.contains("there is no folder nowhere"),
        "{}",
        text(&missing.stderr)
    );
    // A name with a dot is not a file name.
    let episodes = bench.path().join("main/episodes");
    std::fs::rename(episodes.join("short-1-1.jsonl"), episodes.join("short-1.2-1.jsonl")).unwrap();
    ends(&bench.episode(&["show", "short-1.2-1", "--episodes", "main"]).output().unwrap(), 0);
}

#[test]
fn pictures_of_an_odd_size_make_a_video_for_any_player() {
    let bench = Bench::new();
    bench.write("suite.json", &suite(json!({})));
    ends(&bench.run("log", "main", &[]), 0);
    let video = |camera: &str| {
        let twins = bench.twins.path().to_str().unwrap();
        let arguments =
            ["video", "main/episodes/short-0-1.jsonl", "--camera", camera, "--out", camera];
        let more = ["--twins", twins, "--backend", "cpu"];
        let output = bench.episode(&[&arguments[..], &more].concat()).output().unwrap();
        ends(&output, 0).0.to_owned()
    };
    // 8 x 6 px, and 5 x 4 px.
    let even = video("front");
    assert!(even.contains("-i 'front/%06d.png' -pix_fmt yuv420p"), "{even}");
    let odd = video("rear");
    assert!(odd.contains("-vf 'pad=ceil(iw/2)*2:ceil(ih/2)*2' -pix_fmt yuv420p"), "{odd}");
}
