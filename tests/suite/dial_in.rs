//! External agents. The command is the binary of this test, which drives if an environment variable
//! is set.

use std::env;
use std::time::{Duration, Instant};

use serde_json::Value;
use wildcity_client::{Client, Open, Pose};
use wildcity_suite::{AgentChoice, Ending, ExitCode, RunSettings, Status, SuiteError, junit, page};

use crate::street::Bench;

/// The command line that runs [`the_agent`], with a manner of driving.
fn command(manner: &str) -> AgentChoice {
    let binary = env::current_exe().unwrap();
    let test = "dial_in::the_agent --exact --nocapture";
    let line = format!("AGENT_MANNER={manner} {} {test}", binary.display());
    AgentChoice::Command { name: manner.to_owned(), line }
}

/// Not a test: the agent, if the suite has started this binary.
#[test]
fn the_agent() {
    let Ok(open) = env::var("WILDCITY_OPEN") else { return };
    let manner = env::var("AGENT_MANNER").unwrap();
    if manner == "fails" {
        (1..=30).for_each(|line| eprintln!("line {line}"));
        std::process::exit(3);
    }
    if manner == "idle" {
        return;
    }
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(drive(&open, &manner));
}

async fn drive(open: &str, manner: &str) {
    let url = env::var("WILDCITY_URL").unwrap();
    let steps: u64 = env::var("WILDCITY_STEPS").unwrap().parse().unwrap();
    let mut seed: u64 = env::var("WILDCITY_SEED").unwrap().parse().unwrap();
    if manner == "cheats" {
        seed += 1;
    }
    let mut fields: Value = serde_json::from_str(open).unwrap();
    fields["seq"] = 0.into();
    let open: Open = serde_json::from_value(fields).unwrap();
    let mut client = Client::connect(&url, "test agent").await.unwrap();
    client.open(open).await.unwrap();
    client.reset(seed, None).await.unwrap();
    for step in 1..=steps {
        let xyz = [20.0 + step as f64, 0.0, 0.0];
        client.step(Pose { xyz, q: [1.0, 0.0, 0.0, 0.0] }).await.unwrap();
    }
    client.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_drives_what_it_is_told_to() {
    let bench = Bench::new();
    bench.suite();
    let cases = bench.cases(&bench.path("rails.json")).unwrap();
    let settings = bench.settings(command("follows"), 2, "out");
    let result = wildcity_suite::run(settings, cases).await.unwrap();
    assert!(
        result.episodes.iter().all(|episode| matches!(episode.mcap, Some(Ok(_)))),
        "{}",
        result.to_json()
    );
    assert_eq!(result.counts.passed, 1, "{}", result.to_json());
    assert_eq!(result.episodes[0].steps, 20);
}

#[tokio::test(flavor = "multi_thread")]
async fn technical_failures_are_tried_again_and_both_kept() {
    let bench = Bench::new();
    bench.suite();
    for (manner, kind) in
        [("fails", "agent_error"), ("cheats", "agent_error"), ("idle", "agent_lost")]
    {
        let cases = bench.cases(&bench.path("rails.json")).unwrap();
        let settings = bench.settings(command(manner), 1, manner);
        let result = wildcity_suite::run(settings, cases).await.unwrap();
        let episode = &result.episodes[0];
        assert_eq!(episode.status, Status::Technical, "{manner}");
        let kinds: Vec<&str> = episode.errors.iter().map(|error| &*error.kind).collect();
        assert_eq!(kinds, [kind; 2], "{manner}: {:?}", episode.errors);
        assert_eq!(Ending::new(&result, None).code, ExitCode::Technical);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_drives_nothing_is_quoted() {
    let bench = Bench::new();
    bench.suite();
    for (manner, status) in [("fails", "exit status: 3"), ("idle", "exit status: 0")] {
        let cases = bench.cases(&bench.path("rails.json")).unwrap();
        let settings = bench.settings(command(manner), 1, manner);
        let begin = std::time::Instant::now();
        let result = wildcity_suite::run(settings, cases).await.unwrap();
        let error = &result.episodes[0].errors[0];
        assert!(error.message.contains(status), "{}", error.message);
        assert!(error.message.contains("drove nothing: it must connect"), "{}", error.message);
        // There is no wait for the record of an agent that never reset its session.
        assert!(begin.elapsed() < wildcity_suite::limits::CLOSE_WAIT, "{:?}", begin.elapsed());
        if manner == "fails" {
            assert!(error.stderr.ends_with("line 29\nline 30"), "{}", error.stderr);
            assert!(!error.stderr.contains("line 18\n"), "the last twelve: {}", error.stderr);
            let ending = Ending::new(&result, None);
            assert!(junit(&result, &ending).contains("line 30"));
            assert!(page(&result, &ending, &[], &bench.path(manner)).contains("line 30"));
            assert!(!result.to_json().contains("line 30"), "texts of agents may have times");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_that_is_not_there_ends_the_run_at_once() {
    let bench = Bench::new();
    bench.suite();
    for line in ["idmm", "cd / && idmm", "/"] {
        let agent = AgentChoice::Command { name: line.to_owned(), line: line.to_owned() };
        let cases = bench.cases(&bench.path("suite.json")).unwrap();
        let out = format!("out{}", line.len());
        let error = wildcity_suite::run(bench.settings(agent, 2, &out), cases).await.unwrap_err();
        assert!(matches!(error, SuiteError::NoAgent { .. }), "{error}");
        let error = error.to_string();
        let names = ["log, stand or idm", "egodriver:HOST:PORT", line];
        assert!(names.iter().all(|name| error.contains(name)), "{error}");
    }
    // An agent that drove, and then did not find a command, is a different case.
    let binary = env::current_exe().unwrap();
    let test = "dial_in::the_agent --exact --nocapture";
    let line = format!("AGENT_MANNER=follows {} {test}; no-such-clean-up", binary.display());
    let agent = AgentChoice::Command { name: "late".to_owned(), line };
    let cases = bench.cases(&bench.path("rails.json")).unwrap();
    let result = wildcity_suite::run(bench.settings(agent, 1, "late"), cases).await.unwrap();
    assert_eq!(result.episodes[0].errors[0].kind, "agent_error");
}

/// Whether a process runs: one that was killed may still be waited for.
fn runs(pid: &str) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let state = stat.rsplit_once(") ").and_then(|(_, rest)| rest.chars().next());
    state.is_some_and(|state| state != 'Z')
}

/// Waits until the processes have ended whose ids are the lines of a file.
fn assert_ended(pids: &std::path::Path) {
    let text = std::fs::read_to_string(pids).unwrap();
    assert!(text.lines().count() > 0, "the agent has not started");
    let end = Instant::now() + Duration::from_secs(20);
    while text.lines().any(runs) {
        assert!(Instant::now() < end, "{text} still run");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// An agent that starts a process of its own, and hangs.
fn hanging(pids: &std::path::Path) -> AgentChoice {
    let line = format!("sleep 1000 & echo $! >> {0}; echo $$ >> {0}; wait", pids.display());
    AgentChoice::Command { name: "hangs".to_owned(), line }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_hangs_ends_with_all_that_it_has_started() {
    let bench = Bench::new();
    bench.suite();
    let cases = bench.cases(&bench.path("rails.json")).unwrap();
    let pids = bench.path("pids");
    let settings = RunSettings {
        agent_timeout: Duration::from_secs(1),
        retries: 0,
        ..bench.settings(hanging(&pids), 1, "hangs")
    };
    let result = wildcity_suite::run(settings, cases).await.unwrap();
    assert_eq!(result.counts.technical, 1, "{}", result.to_json());
    assert_ended(&pids);
}

/// Not a test: a suite whose agent hangs, if the test below has started this binary.
#[tokio::test(flavor = "multi_thread")]
async fn the_suite_that_is_killed() {
    let Ok(pids) = env::var("SUITE_PIDS") else { return };
    let bench = Bench::new();
    bench.suite();
    let cases = bench.cases(&bench.path("rails.json")).unwrap();
    let settings = bench.settings(hanging(std::path::Path::new(&pids)), 1, "hangs");
    let _ = wildcity_suite::run(settings, cases).await;
}

#[test]
fn an_agent_ends_when_its_suite_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let pids = dir.path().join("pids");
    let mut suite = std::process::Command::new(env::current_exe().unwrap())
        .args(["dial_in::the_suite_that_is_killed", "--exact", "--nocapture"])
        .env("SUITE_PIDS", &pids)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let end = Instant::now() + Duration::from_secs(60);
    let started = || std::fs::read_to_string(&pids).is_ok_and(|text| text.lines().count() == 2);
    while !started() {
        assert!(Instant::now() < end, "the agent does not start");
        std::thread::sleep(Duration::from_millis(50));
    }
    suite.kill().unwrap();
    suite.wait().unwrap();
    assert_ended(&pids);
}
