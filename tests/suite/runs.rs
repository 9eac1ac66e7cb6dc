//! Runs with the built-in agents, and their output files.

use serde_json::json;
use wildcity_episode::{EpisodeFile, diff, export_file, result};
use wildcity_suite::{
    AgentChoice, BuiltIn, Ending, ExitCode, Status, SuiteResult, junit, page, pictures, verify,
};

use crate::street::{Bench, cpu, scenario};

const VERDICT: &str = "wildcity.verdict@3";

fn code(result: &SuiteResult) -> ExitCode {
    Ending::new(result, None).code
}

#[tokio::test(flavor = "multi_thread")]
async fn the_log_passes_and_a_stand_fails_for_progress() {
    let bench = Bench::new();
    let log = bench.run_built_in(BuiltIn::Log, "log").await;
    assert_eq!((log.counts.passed, log.counts.episodes), (4, 4), "{}", log.to_json());
    assert_eq!(code(&log), ExitCode::Passed);
    assert_eq!(log.pass_rate.rate, Some(1.0));
    // Without jitter, two seeds are one episode: Wilson of 2 of 2, and not 0.510 of 4 of 4.
    assert_eq!((log.pass_rate.runs, log.counts.duplicates), (2, 2));
    assert!((log.pass_rate.interval[0] - 0.342).abs() < 1e-3, "{:?}", log.pass_rate);
    for episode in &log.episodes {
        assert_eq!(episode.steps, 20);
        assert!((episode.distance_m - 20.0).abs() < 0.5, "{}", episode.distance_m);
    }

    let stand = bench.run_built_in(BuiltIn::Stand, "stand").await;
    assert_eq!((stand.counts.failed, code(&stand)), (4, ExitCode::Driving));
    for episode in &stand.episodes {
        assert_eq!(episode.faults[0].fault, "progress", "{}", episode.name);
    }
    // `idm` sets off from a stand on rails: from 10 m/s it drives on.
    let idm = bench.run_built_in(BuiltIn::Idm, "idm").await;
    let car: Vec<Status> =
        idm.episodes.iter().filter(|e| e.scenario == "car").map(|e| e.status).collect();
    assert_eq!(car, [Status::Passed; 2], "{}", idm.to_json());
}

#[tokio::test(flavor = "multi_thread")]
async fn any_number_of_jobs_gives_the_same_bytes() {
    let bench = Bench::new();
    let mut results = Vec::new();
    for jobs in [1, 2, 8] {
        let out = format!("jobs{jobs}");
        let result = bench.run(AgentChoice::BuiltIn(BuiltIn::Log), jobs, &out).await;
        let timed = junit(&result, &Ending::new(&result, None));
        // Only the times differ: one of the suite, and one of each episode.
        let pieces: Vec<&str> = timed.split(" time=\"").collect();
        assert_eq!(pieces.len(), result.episodes.len() + 2, "{timed}");
        let mut untimed = pieces[0].to_owned();
        for piece in &pieces[1..] {
            let (seconds, rest) = piece.split_once('"').unwrap();
            assert!(seconds.parse::<f64>().unwrap() > 0.0, "{timed}");
            untimed.push_str(rest);
        }
        results.push((result.to_json(), untimed));
    }
    assert_eq!(results[0], results[1]);
    assert_eq!(results[0], results[2]);
    assert!(results[0].0.contains("\"frames_hash\": \""), "{}", results[0].0);
}

#[tokio::test(flavor = "multi_thread")]
async fn records_are_whole_and_score_to_the_same_result() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Log, "log").await;
    for entry in &run.episodes {
        let episode = EpisodeFile::read(&bench.path("log").join(&entry.record)).unwrap();
        assert_eq!(episode.cut, None);
        assert_eq!(episode.scenario.as_ref().unwrap().hash, entry.scenario_hash);
        let again = result(&episode).unwrap();
        assert_eq!(episode.result.as_ref(), Some(&again), "the line and a second scoring");
        // The verdict of the record has no value without a map, which the suite accepts.
        let mut scores = again.scores;
        assert_eq!(scores[VERDICT].value, None);
        scores.insert(VERDICT.to_owned(), entry.scores[VERDICT].clone());
        assert_eq!((entry.scores[VERDICT].value, &scores), (Some(1.0), &entry.scores));
    }
    let read = |name: &str| EpisodeFile::read(&bench.path("log").join(name)).unwrap();
    let [car_3, car_4] = ["car-3-1.jsonl", "car-4-1.jsonl"].map(read);
    assert_eq!(diff(&car_3, &car_3), None);
    assert_eq!(diff(&car_3, &car_4).unwrap().how, "seed 3 against 4");
}

#[tokio::test(flavor = "multi_thread")]
async fn each_record_becomes_an_mcap_file_beside_it() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Log, "log").await;
    for entry in &run.episodes {
        let record = bench.path("log").join(&entry.record);
        let mcap = entry.mcap.as_ref().unwrap().as_ref().unwrap();
        assert_eq!(*mcap, entry.record.replace(".jsonl", ".mcap"));
        let by_hand = bench.path("by-hand.mcap");
        export_file(&record, &by_hand).unwrap();
        // With its end and result. The order of the index differs from file to file, its size does
        // not.
        let bytes = [by_hand, bench.path("log").join(mcap)]
            .map(|path| std::fs::metadata(path).unwrap().len());
        assert_eq!(bytes[0], bytes[1], "{}", entry.name);
    }
    let mut settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Log), 2, "without");
    settings.mcap = false;
    let cases = bench.cases(&bench.suite()).unwrap();
    let without = wildcity_suite::run(settings, cases).await.unwrap();
    assert!(without.episodes.iter().all(|episode| episode.mcap.is_none()));
    assert!(!bench.path("without").join("car-3-1.mcap").exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_export_that_fails_is_in_the_report_and_changes_no_byte_of_the_result() {
    let bench = Bench::new();
    std::fs::create_dir_all(bench.path("log").join("car-3-1.mcap")).unwrap();
    let run = bench.run_built_in(BuiltIn::Log, "log").await;
    assert_eq!((run.counts.passed, code(&run)), (4, ExitCode::Passed), "{}", run.to_json());
    let told: Vec<bool> = run.episodes.iter().map(|e| e.mcap_error().is_some()).collect();
    assert_eq!(told, [true, false, false, false]);
    assert!(run.episodes[0].mcap_error().unwrap().contains("cannot write"), "{run:?}");
    let html = page(&run, &Ending::new(&run, None), &[], &bench.path("log"));
    assert_eq!(html.matches("no MCAP file: cannot write").count(), 1, "{html}");
    assert_eq!(html.matches("episodes/car-4-1.mcap").count(), 1, "{html}");

    let whole = bench.run_built_in(BuiltIn::Log, "whole").await;
    assert_eq!(whole.to_json(), run.to_json());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_verifies_and_an_altered_record_does_not() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Log, "log").await;
    let check = || verify(&run, &bench.path("log"), &bench.catalog(), &cpu());
    assert_eq!(check(), Vec::<String>::new());
    let path = bench.path("log").join(&run.episodes[1].record);
    let text = std::fs::read_to_string(&path).unwrap();
    // A digit of the distance in the summary at the end.
    let at = text.rfind("\"distance_m\":").unwrap() + "\"distance_m\":".len();
    let mut altered = text.clone();
    altered.replace_range(at..=at, "7");
    assert_ne!(altered, text);
    std::fs::write(&path, altered).unwrap();
    let wrong = check();
    assert_eq!(wrong.len(), 1, "{wrong:?}");
    assert!(wrong[0].starts_with("car-4") && wrong[0].contains("distance_m"), "{wrong:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_report_shows_the_worst_episodes_with_pictures() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Stand, "stand").await;
    let shown = pictures(&run, &bench.path("stand"), &bench.catalog(), &cpu());
    // One of each scenario: the second seed shows the same.
    assert_eq!(shown.len(), 2);
    assert!(shown.iter().all(|picture| picture.jpeg.starts_with(&[0xff, 0xd8])));
    assert_eq!((shown[0].step, shown[0].camera.as_str()), (20, "front"));
    let ending = Ending::new(&run, None);
    let html = page(&run, &ending, &shown, &bench.path("stand"));
    assert_eq!(html.matches("data:image/jpeg;base64,").count(), 2);
    assert_eq!(html.matches("<svg").count(), 4);
    assert!(html.contains("progress at 2.000 s: 0.") && !html.contains("http://cdn"), "{html}");
    assert!(html.contains("<b>Not passed</b>: of 4 episodes: 4 failed"), "{html}");
    // The verdict, then the pictures with the way to see more, then tables.
    let at = |text: &str| html.find(text).unwrap_or_else(|| panic!("no {text} in {html}"));
    let first = [at("class=\"verdict failed\""), at("data:image/jpeg"), at("<h2>Scenarios")];
    assert!(first.is_sorted(), "{first:?}");
    assert!(html.contains("href=\"http://127.0.0.1:8080/#/episode/car-3-1\""), "{html}");
    assert!(html.contains("wildcity serve --episodes /"), "{html}");
    assert!(html.contains("name=\"viewport\""), "{html}");
    assert!(html.contains("Note: 2 of 4 episodes repeat the drive of an earlier seed"), "{html}");
    assert!(html.contains("off_road: the scenario has no map"), "what was not judged: {html}");
    assert_eq!(html.matches("the same drive as car-3, not counted again").count(), 1, "{html}");

    let xml = junit(&run, &ending);
    assert_eq!(xml.matches("<testcase").count(), 4);
    assert_eq!(xml.matches("<failure type=\"progress\"").count(), 4);
    assert!(xml.contains("failures=\"4\" errors=\"0\" skipped=\"0\""), "{xml}");
    assert!(xml.contains("<property name=\"exit_code\" value=\"1\"/>"), "{xml}");
    assert_eq!(xml.matches("not judged: off_road: the scenario has no map").count(), 4, "{xml}");
    assert_eq!(xml.matches("the same drive as car-3, not counted again").count(), 1, "{xml}");
}

/// A title that is wider than its plot is cut: 420 px, at 7 px for a character.
#[tokio::test(flavor = "multi_thread")]
async fn titles_fit_into_their_plots() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Stand, "stand").await;
    let html = page(&run, &Ending::new(&run, None), &[], &bench.path("stand"));
    let titles: Vec<String> = html
        .split("<text x=\"6\"")
        .skip(1)
        .map(|rest| rest.split_once("</text>").unwrap().0)
        .map(|svg| svg.split('<').map(|tag| tag.split_once('>').unwrap().1).collect())
        .collect();
    assert_eq!(titles.len(), 4);
    for title in titles {
        assert!(title.contains("faults") || title.starts_with("speed"), "{title}");
        assert!(title.chars().count() * 7 < 420, "{title}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_without_a_verdict_has_no_rate() {
    let bench = Bench::new();
    // The agent fails, and not the driving.
    let value = scenario("lost", &json!({ "model": "kinematic", "speed": 10.0 }));
    let cases = bench.cases(&bench.write("lost.json", &value)).unwrap();
    let agent = AgentChoice::Command { name: "lost".to_owned(), line: "exit 3".to_owned() };
    let settings = bench.settings(agent, 1, "out");
    let run = wildcity_suite::run(settings, cases).await.unwrap();
    assert_eq!(run.counts.technical, 1, "{}", run.to_json());
    assert_eq!(run.pass_rate.text(), "no episode was judged");
    let ending = Ending::new(&run, None);
    assert_eq!(ending.code, ExitCode::Technical);
    let html = page(&run, &ending, &[], &bench.path("out"));
    assert!(html.contains("Pass rate: no episode was judged"), "{html}");
    assert!(!html.contains("0 of 0"), "{html}");
}

#[tokio::test(flavor = "multi_thread")]
async fn seeds_with_jitter_are_no_duplicates_even_out_of_sight() {
    let bench = Bench::new();
    let mut value = scenario("behind", &json!({ "model": "kinematic", "speed": 10.0 }));
    // No image shows it.
    value["actors"] = json!([{ "name": "car", "asset": "none", "path": { "along": "log", "station_m": 5.0, "speed": 5.0 },
        "jitter": { "longitudinal_m": 1.0, "lateral_m": 0.0, "yaw_rad": 0.0 } }]);
    bench.write("behind.json", &value);
    let suite = json!({ "format": "wildcity.suite/1", "name": "jitter", "scenarios": ["behind.json"],
        "cameras": ["front"], "seeds": [0, 2] });
    let cases = bench.cases(&bench.write("jitter.json", &suite)).unwrap();
    let settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Log), 1, "out");
    let run = wildcity_suite::run(settings, cases).await.unwrap();
    let images: std::collections::BTreeSet<&str> =
        run.episodes.iter().map(|episode| &*episode.frames_hash).collect();
    assert_eq!((images.len(), run.counts.duplicates), (1, 0), "{}", run.to_json());
    assert_eq!(run.pass_rate.runs, 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_not_looked_for_is_no_pass() {
    let bench = Bench::new();
    // Without a map, without contact with the twin, and both.
    let twin_contact = |looks: bool| json!({ "progress": 0.5, "twin_contact": looks });
    for (name, looks) in [("seen", true), ("unseen", false)] {
        let mut value = scenario(name, &json!({ "model": "kinematic", "speed": 10.0 }));
        value["verdict"] = twin_contact(looks);
        bench.write(&format!("{name}.json"), &value);
    }
    let suite = json!({ "format": "wildcity.suite/1", "name": "both", "scenarios": ["seen.json", "unseen.json"],
        "cameras": ["front"] });
    let path = bench.write("both.json", &suite);
    let wanted = [
        (vec![], [Status::NotJudged, Status::NotJudged], ExitCode::NotJudged),
        (vec!["off_road"], [Status::Passed, Status::NotJudged], ExitCode::NotJudged),
        (vec!["off_road", "contact.static"], [Status::Passed, Status::Passed], ExitCode::Passed),
    ];
    for (index, (accepted, statuses, exit)) in wanted.into_iter().enumerate() {
        let out = format!("out{index}");
        let mut settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Log), 1, &out);
        settings.accept_unjudged = accepted.into_iter().map(str::to_owned).collect();
        let run = wildcity_suite::run(settings, bench.cases(&path).unwrap()).await.unwrap();
        let found = [0, 1].map(|index| run.episodes[index].status);
        assert_eq!((found, code(&run)), (statuses, exit), "{}", run.to_json());
        let unseen = "contact.static: contact with the twin was not looked for";
        assert!(run.episodes[1].not_judged.iter().any(|text| text == unseen));
        let html = page(&run, &Ending::new(&run, None), &[], &bench.path(&out));
        let first = html.find("Without a verdict");
        assert_eq!(first.is_some(), exit == ExitCode::NotJudged);
        assert!(first.is_none_or(|at| at < html.find("Scenarios").unwrap()), "it comes first");
    }
    let unknown = json!({ "format": "wildcity.suite/1", "name": "both", "scenarios": ["seen.json"],
        "accept_unjudged": ["offroad"] });
    let error = bench.cases(&bench.write("unknown.json", &unknown)).unwrap_err().to_string();
    assert!(error.contains("accept_unjudged") && error.contains("off_road"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_not_tested_is_said() {
    let bench = Bench::new();
    let mut value = scenario("hidden", &json!({ "model": "kinematic", "speed": 10.0 }));
    // It stands where the ego starts, and would appear elsewhere only after the end.
    value["actors"] = json!([{ "name": "ghost", "path": { "along": "log", "station_m": 21.0, "speed": 10.0 },
        "script": [{ "name": "late", "when": { "time_s": 9.0 }, "do": [{ "speed": { "to": 0.0, "rate": 1.0 } }] }] }]);
    bench.write("hidden.json", &value);
    let suite = json!({ "format": "wildcity.suite/1", "name": "hidden", "scenarios": ["hidden.json"],
        "cameras": ["front"] });
    let cases = bench.cases(&bench.write("suite.json", &suite)).unwrap();
    let settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Log), 1, "out");
    let run = wildcity_suite::run(settings, cases).await.unwrap();
    let untested =
        ["ghost overlaps the ego when it appears, at 0.0 s", "trigger late of ghost did not fire"];
    assert_eq!(run.episodes[0].untested, untested, "{}", run.to_json());
    let ending = Ending::new(&run, None);
    for text in [junit(&run, &ending), page(&run, &ending, &[], &bench.path("out")).to_string()] {
        assert!(untested.iter().all(|one| text.contains(&format!("not tested: {one}"))), "{text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_directory_with_records_is_refused() {
    let bench = Bench::new();
    bench.run_built_in(BuiltIn::Log, "log").await;
    let cases = bench.cases(&bench.suite()).unwrap();
    let settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Log), 1, "log");
    let error = wildcity_suite::run(settings, cases).await.unwrap_err().to_string();
    assert!(error.contains("another run"), "{error}");
}

#[test]
fn exit_codes_are_technical_before_driving() {
    let bench = Bench::new();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let passed = runtime.block_on(bench.run_built_in(BuiltIn::Log, "log"));
    assert_eq!(Ending::new(&passed, None).why, "all 4 episodes passed");
    let mut changed = passed.clone();
    changed.counts.failed = 1;
    assert_eq!(code(&changed), ExitCode::Driving);
    changed.counts.technical = 1;
    assert_eq!(code(&changed), ExitCode::Technical);
    let mut off = passed.clone();
    off.counts.off_model = 1;
    assert_eq!(code(&off), ExitCode::NotJudged);
    off.at_least = Some(0.3);
    assert_eq!(code(&off), ExitCode::NotJudged, "a rate does not count what has no verdict");
    off.accept_unjudged.push("off_model".to_owned());
    assert_eq!(code(&off), ExitCode::Passed);
    off.counts.not_judged = 1;
    assert_eq!(code(&off), ExitCode::NotJudged);
    off.at_least = None;
    off.counts.failed = 1;
    assert_eq!(code(&off), ExitCode::Driving, "a failure says more");
    let mut rated = passed.clone();
    // 2 of 2 have a lower end of 0.342.
    rated.at_least = Some(0.3);
    rated.counts.failed = 1;
    rated.counts.passed = 3;
    let ending = Ending::new(&rated, None);
    assert_eq!(ending.code, ExitCode::Passed);
    assert!(ending.why.contains("of 4 episodes: 1 failed, 3 passed"), "{}", ending.why);
    assert!(ending.why.ends_with("at least 0.342, as wanted (0.3)"), "{}", ending.why);
    // The failure is still reported, and the report says why the exit code is 0.
    let xml = junit(&rated, &ending);
    assert!(xml.contains("failures=\"1\"") && xml.contains("\"exit_code\" value=\"0\""), "{xml}");
    let html = page(&rated, &ending, &[], &bench.path("log"));
    assert!(html.contains("<b>Passed</b>: of 4 episodes: 1 failed, 3 passed"), "{html}");
    rated.at_least = Some(0.9);
    assert_eq!(code(&rated), ExitCode::Driving);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_result_is_read_as_it_was_written() {
    let bench = Bench::new();
    let run = bench.run_built_in(BuiltIn::Stand, "stand").await;
    std::fs::write(bench.path("result.json"), run.to_json()).unwrap();
    for path in [bench.path("result.json"), bench.dir.path().to_owned()] {
        assert_eq!(SuiteResult::read(&path).unwrap().to_json(), run.to_json());
    }
    let record = bench.path("stand/car-3-1.jsonl");
    for (path, wanted) in [
        (bench.path("nowhere.json"), "nowhere.json"),
        (record, "car-3-1.jsonl is no result of a run"),
        (bench.path("suite.json"), "its format is \"wildcity.suite/1\""),
    ] {
        let error = SuiteResult::read(&path).unwrap_err().to_string();
        assert!(error.contains(wanted), "{error}");
    }
    let broken = run.to_json().replacen("\"seed\": 3", "\"seed\": -3", 1);
    std::fs::write(bench.path("broken.json"), broken).unwrap();
    let error = SuiteResult::read(&bench.path("broken.json")).unwrap_err().to_string();
    assert!(error.contains("episodes[0].seed"), "{error}");
}
