//! Two runs, compared: the pairs, the rule, the figures.

use serde_json::{Value, json};
use wildcity_suite::{
    BuiltIn, Change, CompareError, ComparedEpisode, ComparedPictures, Comparison, Direction,
    DrivenRun, Ending, ExitCode, Rule, SuiteResult, Tolerance,
};

use crate::street::{Bench, cpu};

const DRIVING: &str = "bench2drive.driving@7ec25d1";
const ADE: &str = "alpasim.min_ade_5s@3032e0c";
const VERDICT: &str = "wildcity.verdict@3";

/// A result by hand: episodes of the scenario `s` with the seeds 0, 1, .. and these statuses.
struct Made {
    statuses: Vec<&'static str>,
    /// Values of [`DRIVING`]; none beyond the end.
    driving: Vec<f64>,
    /// Values of [`ADE`].
    ade: Vec<f64>,
}

impl Made {
    fn passing(count: usize) -> Self {
        Self { statuses: vec!["passed"; count], driving: Vec::new(), ade: Vec::new() }
    }

    fn value(&self) -> Value {
        let episodes = self.statuses.iter().enumerate().map(|(seed, status)| {
            let line = |value: Option<&f64>| json!({ "value": value, "reason": "none" });
            let verdict = ["failed", "passed"].iter().position(|name| name == status);
            let faults = match *status {
                "failed" => json!([{ "fault": "progress", "time_us": 2_000_000 }]),
                _ => json!([]),
            };
            json!({
                "name": format!("s-{seed}"), "scenario": "s", "seed": seed, "status": status,
                "scenario_hash": format!("{seed:064x}"), "version_hash": "a".repeat(64),
                "faults": faults, "steps": 20, "distance_m": 20.0,
                "frames_hash": "", "record": "",
                "scores": {
                    VERDICT: { "value": verdict.map(|value| value as f64) },
                    DRIVING: line(self.driving.get(seed)),
                    ADE: line(self.ade.get(seed)),
                },
            })
        });
        let rate = json!({ "passed": 0, "runs": 0, "rate": null, "interval": [0.0, 1.0] });
        json!({
            "format": "wildcity.suite-result/1", "suite": "made", "agent": "a", "latest": false,
            "counts": { "episodes": 0, "passed": 0, "failed": 0, "off_model": 0, "not_judged": 0,
                        "technical": 0 },
            "pass_rate": rate, "means": {}, "scenarios": {},
            "episodes": episodes.collect::<Vec<Value>>(),
        })
    }

    fn result(&self) -> SuiteResult {
        result(self.value())
    }
}

/// A result as it is read from a file.
fn result(value: Value) -> SuiteResult {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("result.json");
    std::fs::write(&path, value.to_string()).unwrap();
    SuiteResult::read(&path).unwrap()
}

fn statuses(statuses: &[&'static str]) -> SuiteResult {
    Made { statuses: statuses.to_vec(), ..Made::passing(0) }.result()
}

fn rule(tolerances: &[&str]) -> Rule {
    tolerances.iter().map(|text| text.parse::<Tolerance>().unwrap()).collect()
}

fn compare(before: &SuiteResult, after: &SuiteResult, tolerances: &[&str]) -> Comparison {
    Comparison::new(before, after, &rule(tolerances)).unwrap()
}

fn changes(comparison: &Comparison) -> Vec<Change> {
    comparison.episodes.iter().map(|episode: &ComparedEpisode| episode.change).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_of_a_worse_driver_is_worse_and_the_other_way_round_better() {
    let bench = Bench::new();
    let log = bench.run_built_in(BuiltIn::Log, "log").await;
    let stand = bench.run_built_in(BuiltIn::Stand, "stand").await;
    std::fs::write(bench.path("log.json"), log.to_json()).unwrap();
    let before = SuiteResult::read(&bench.path("log.json")).unwrap();

    let worse = compare(&before, &stand, &[]);
    assert!(worse.worse);
    assert_eq!(changes(&worse), [Change::Worse; 4]);
    // Two seeds of a scenario without jitter are one pair.
    assert_eq!((worse.counts.duplicates, worse.pass_rate.pairs), (2, 2));
    assert_eq!((worse.pass_rate.before, worse.pass_rate.after), (2, 0));
    assert_eq!(worse.scores[VERDICT].difference, Some(-1.0));
    let conclusion = worse.conclusion();
    assert!(conclusion.starts_with("worse than before: 4 episodes that passed"), "{conclusion}");
    assert!(conclusion.contains("(car-3, car-4, rails-3, rails-4)"), "{conclusion}");
    let text = worse.to_text();
    assert!(text.contains("passed before, now failed: progress at 2.000 s"), "{text}");
    assert!(
        text.contains("small driven by log") && text.contains("small driven by stand"),
        "{text}"
    );
    let run = |result, out| DrivenRun { result, episodes: bench.path(out) };
    let runs = [run(&before, "log"), run(&stand, "stand")];
    let page = worse.to_page(&runs, &ComparedPictures::new());
    assert_eq!(page.matches("class=\"worse\">worse<").count(), 4, "{page}");
    assert!(page.contains("class=\"verdict worse\">Worse than before: 4 episodes"), "{page}");
    // Each pair from above and its speed, before and now; a second seed of the same drive is in
    // the table alone.
    assert_eq!(page.matches("<svg").count(), 2 * 2 * 2, "{page}");
    assert_eq!((page.matches("<b>before</b>").count(), page.matches("<b>now</b>").count()), (2, 2));
    let gone = runs.map(|run| DrivenRun { episodes: bench.path("nowhere"), ..run });
    let page = worse.to_page(&gone, &ComparedPictures::new());
    assert!(!page.contains("<svg") && page.matches("No record in ").count() == 4, "{page}");

    let better = compare(&stand, &log, &[]);
    assert_eq!((better.worse, changes(&better)), (false, vec![Change::Better; 4]));
    assert!(better.conclusion().starts_with("not worse"), "{}", better.conclusion());

    // Values that are read from a file equal the driven ones to the last digit.
    let same = compare(&before, &log, &[]);
    assert_eq!((same.worse, changes(&same)), (false, vec![Change::Same; 4]));
    let mut compared = same.scores.values().filter(|score| score.pairs > 0).peekable();
    assert!(compared.peek().is_some());
    assert!(compared.all(|score| score.direction == Direction::Same), "{same:?}");
    assert_eq!(compare(&before, &stand, &[]).to_json(), worse.to_json());

    let ending =
        |result: &SuiteResult, compared: Comparison| Ending::new(result, Some(&Ok(compared)));
    assert_eq!(ending(&stand, worse).code, ExitCode::Driving);
    // It fails as it did before: not worse, so 0.
    let failing = ending(&stand, compare(&stand, &stand, &[]));
    assert_eq!(failing.code, ExitCode::Passed, "{}", failing.why);
    let mut wanted = stand.clone();
    wanted.at_least = Some(0.5);
    assert_eq!(ending(&wanted, compare(&stand, &stand, &[])).code, ExitCode::Driving);
    let error = CompareError::NoValue { name: "a".to_owned() };
    assert_eq!(Ending::new(&log, Some(&Err(error))).code, ExitCode::Usage);

    // Comparisons that can be checked before anything is driven.
    let cases = bench.cases(&bench.path("suite.json")).unwrap();
    let check = |before: &SuiteResult, tolerances: &[&str], cases: &[wildcity_suite::Case]| {
        let checked = Comparison::check(before, cases, &rule(tolerances));
        checked.map_err(|error| error.to_string())
    };
    assert_eq!(check(&before, &["bench2drive.driving=1"], &cases), Ok(()));
    let error = check(&before, &["bench2drive.drive=1"], &cases).unwrap_err();
    assert!(
        error.contains("bench2drive.drive: no such score") && error.contains(DRIVING),
        "{error}"
    );
    let mut other = before.clone();
    other.episodes.iter_mut().for_each(|episode| episode.version_hash = "b".repeat(64));
    let error = check(&other, &[], &cases).unwrap_err();
    assert!(error.contains("4 episodes were driven before, all in other versions"), "{error}");
    let error = check(&statuses(&["passed"]), &[], &cases).unwrap_err();
    assert!(error.contains("no episode of the suite was driven before"), "{error}");
}

#[test]
fn a_pass_that_is_lost_is_worse_whatever_it_became() {
    let before = statuses(&["passed"; 5]);
    let after = statuses(&["passed", "failed", "off_model", "not_judged", "technical"]);
    let found = compare(&before, &after, &[]);
    assert_eq!(changes(&found)[0], Change::Same);
    assert_eq!(changes(&found)[1..], [Change::Worse; 4]);
    let before = statuses(&["failed", "failed", "technical", "off_model", "technical"]);
    let after = statuses(&["passed", "off_model", "passed", "failed", "technical"]);
    let found = compare(&before, &after, &[]);
    assert_eq!(changes(&found)[0], Change::Better);
    assert_eq!(changes(&found)[1..], [Change::Unknown; 4]);
    assert!(!found.worse);
}

#[test]
fn the_pass_rate_alone_allows_one_episode_for_another() {
    let before = statuses(&["passed", "passed", "failed", "passed"]);
    let after = statuses(&["failed", "passed", "passed", "passed"]);
    assert!(compare(&before, &after, &[]).worse, "one that passed fails");
    let rate = compare(&before, &after, &["pass_rate=0"]);
    assert!(!rate.worse, "three of four before and now");
    assert!(rate.conclusion().contains("3 of 4 episodes passed before, and 3 now"), "{rate:?}");
    // 0.1 of ten is one episode; 0.8 less 0.7 is more than that in binary digits.
    let passing =
        |count: usize| statuses(&[vec!["passed"; count], vec!["failed"; 10 - count]].concat());
    assert!(compare(&passing(8), &passing(7), &["pass_rate=0.09"]).worse);
    assert!(!compare(&passing(8), &passing(7), &["pass_rate=0.1"]).worse);
    // An episode that is not driven any more does not pass.
    let lost = statuses(&["technical", "passed", "failed", "passed"]);
    assert!(compare(&before, &lost, &["pass_rate=0"]).worse);
}

#[test]
fn scores_are_held_against_their_tolerance_in_their_direction() {
    let made = |driving: &[f64], ade: &[f64]| {
        let made = Made::passing(4);
        Made { driving: driving.to_vec(), ade: ade.to_vec(), ..made }.result()
    };
    let before = made(&[80.0, 90.0, 100.0, 70.0], &[1.0, 1.0, 2.0]);
    let after = made(&[79.0, 88.0, 97.0, 68.0], &[1.1, 1.2, 2.3]);
    let found = compare(&before, &after, &[]);
    assert!(!found.worse, "no score counts that is not named");
    let driving = &found.scores[DRIVING];
    assert_eq!((driving.pairs, driving.before, driving.after), (4, Some(85.0), Some(83.0)));
    // By hand: -1, -2, -3, -2: mean -2, deviation sqrt(2/3), t(3) 3.182446.
    let [low, high] = driving.interval.unwrap();
    let half = 3.182_446_305 * (2.0_f64 / 3.0).sqrt() / 2.0;
    assert!(
        (low - (-2.0 - half)).abs() < 1e-6 && (high - (-2.0 + half)).abs() < 1e-6,
        "{low} {high}"
    );
    assert_eq!((driving.difference, driving.direction), (Some(-2.0), Direction::Worse));
    // Metres from the recorded drive: more is worse. The fourth pair has none.
    let ade = &found.scores[ADE];
    assert_eq!((ade.pairs, ade.lower_is_better), (3, true));
    assert!((ade.difference.unwrap() - 0.2).abs() < 1e-12);
    assert_eq!(compare(&after, &before, &[]).scores[DRIVING].direction, Direction::Better);

    assert!(compare(&before, &after, &["bench2drive.driving=1.9"]).worse);
    assert!(!compare(&before, &after, &["bench2drive.driving=2"]).worse);
    assert!(compare(&before, &after, &[&format!("{ADE}=0.1")]).worse);
    assert!(!compare(&before, &after, &["alpasim.min_ade_5s=0.2"]).worse);
    assert!(!compare(&after, &before, &["alpasim.min_ade_5s=0"]).worse, "it got better");
    let reason = compare(&before, &after, &["bench2drive.driving=1.5"]).conclusion();
    assert!(reason.contains("worse by 2.0000 on average, more than 1.5"), "{reason}");

    // Two pairs have a mean, and no interval.
    let few = compare(&made(&[1.0, 2.0], &[]), &made(&[2.0, 4.0], &[]), &[]);
    let few = &few.scores[DRIVING];
    assert_eq!(
        (few.difference, few.interval, few.direction),
        (Some(1.5), None, Direction::Unclear)
    );
    let lost = compare(&before, &made(&[80.0], &[]), &[]);
    assert_eq!((lost.scores[DRIVING].pairs, lost.scores[DRIVING].only_before), (1, 3));
    assert!(lost.to_text().contains("pairs that have it before alone: 3"), "{}", lost.to_text());
    // Missing values in both runs do not count as equal.
    let gone = compare(&before, &made(&[], &[]), &[]);
    assert_eq!((gone.scores[DRIVING].difference, gone.scores[DRIVING].pairs), (None, 0));
    assert_eq!(gone.scores[DRIVING].direction, Direction::Unclear);
    let never = compare(&made(&[], &[]), &made(&[], &[]), &[]).to_text();
    assert!(!never.contains(DRIVING), "no run has a value: {never}");
}

#[test]
fn what_is_not_the_same_episode_is_not_compared() {
    let before = Made::passing(4);
    let mut after = Made { statuses: vec!["failed"; 5], ..Made::passing(0) }.value();
    after["episodes"][0]["version_hash"] = json!("b".repeat(64));
    after["episodes"][1]["scenario_hash"] = json!("c".repeat(64));
    after["episodes"][2]["values"] = json!({ "v": 8.0 });
    let found = compare(&before.result(), &result(after.clone()), &[]);
    let by_name = |change: Change| -> Vec<&str> {
        let there = found.episodes.iter().filter(|episode| episode.change == change);
        there.map(|episode| &*episode.name).collect()
    };
    assert_eq!(by_name(Change::Changed), ["s-0", "s-1"]);
    assert_eq!(by_name(Change::OnlyBefore), ["s-2"]);
    assert_eq!(by_name(Change::OnlyAfter), ["s-2", "s-4"], "a value of a sweep makes another one");
    assert_eq!(by_name(Change::Worse), ["s-3"]);
    assert_eq!(found.pass_rate.pairs, 1);
    let text = found.to_text();
    assert!(text.contains("the twin's version was aaaaaaaa before and is bbbbbbbb now"), "{text}");
    assert!(text.contains("the scenario was 00000000 before and is cccccccc now"), "{text}");
    assert!(
        text.contains("pairs that are not compared, because their twin or scenario differs: 2"),
        "{text}"
    );

    let error = |before: &SuiteResult, after: Value, tolerances: &[&str]| {
        let found = Comparison::new(before, &result(after), &rule(tolerances));
        found.unwrap_err().to_string()
    };
    let one = statuses(&["passed"]);
    let mut other = Made::passing(1).value();
    other["episodes"][0]["version_hash"] = json!("b".repeat(64));
    let refused = error(&one, other, &[]);
    assert!(
        refused.contains("every pair differs in its twin or scenario; of s-0, the twin's"),
        "{refused}"
    );
    let mut other = Made::passing(1).value();
    other["episodes"][0]["scenario"] = json!("t");
    assert!(error(&one, other, &[]).contains("no episode is in both runs"));
    let mut twice = Made::passing(2).value();
    twice["episodes"][1]["seed"] = json!(0);
    assert!(
        error(&one, twice, &[]).contains("two episodes of scenario \"s\" with seed 0: s-0, s-1")
    );
    let mut slower = Made::passing(1).value();
    slower["dt_us"] = json!(50_000);
    let mut timed = one.clone();
    timed.dt_us = Some(100_000);
    assert!(error(&timed, slower, &[]).contains("steps took 100000 µs before and take 50000 µs"));
    assert!(error(&one, Made::passing(1).value(), &["driving=1"]).contains("no such score"));
    // A run without driven episodes has no scores to compare.
    let mut empty = Made::passing(1).value();
    empty["episodes"][0]["scores"] = json!({});
    empty["episodes"][0]["status"] = json!("technical");
    let found = compare(&one, &result(empty.clone()), &[]);
    assert_eq!((found.worse, found.scores_not_compared.len()), (true, 0));
    assert!(error(&one, empty, &["driving=1"]).ends_with("no such score; there is pass_rate"));
    let missing = error(&one, Made::passing(1).value(), &["bench2drive.driving=1"]);
    assert!(missing.contains("no pair of episodes has a value"), "{missing}");
}

#[test]
fn scores_of_two_versions_are_not_compared() {
    let before = Made { driving: vec![80.0], ..Made::passing(1) };
    let renamed = |from: &str, to: &str| {
        let text = before.value().to_string().replace(from, to);
        result(serde_json::from_str(&text).unwrap())
    };
    let found = compare(&before.result(), &renamed(DRIVING, "bench2drive.driving@0000000"), &[]);
    assert_eq!(
        found.scores_not_compared,
        ["bench2drive.driving@7ec25d1 before, bench2drive.driving@0000000 now"]
    );
    assert!(!found.scores.contains_key(DRIVING));
    let gone = compare(&before.result(), &renamed(DRIVING, "bench2drive.new@1"), &[]);
    let wanted = [format!("{DRIVING} before alone"), "bench2drive.new@1 now alone".to_owned()];
    assert_eq!(gone.scores_not_compared, wanted);
    // A changed verdict could be caused by its rules.
    let later = renamed(VERDICT, "wildcity.verdict@4");
    let error = Comparison::new(&before.result(), &later, &Rule::default()).unwrap_err();
    assert!(matches!(error, CompareError::VerdictVersion { .. }), "{error}");
}

#[test]
fn pairs_that_repeat_another_are_in_no_mean() {
    let duplicates = |driving: &[f64], of: &[(usize, &str)]| {
        let mut value = Made { driving: driving.to_vec(), ..Made::passing(4) }.value();
        for (index, name) in of {
            value["episodes"][*index]["duplicate_of"] = json!(name);
        }
        result(value)
    };
    let before = duplicates(&[10.0, 10.0, 10.0, 40.0], &[(1, "s-0"), (2, "s-0")]);
    // The third was driven otherwise this time.
    let after = duplicates(&[12.0, 12.0, 16.0, 44.0], &[(1, "s-0")]);
    let found = compare(&before, &after, &[]);
    assert_eq!((found.counts.duplicates, found.scores[DRIVING].pairs), (1, 3));
    assert_eq!(found.scores[DRIVING].difference, Some(4.0), "2, 6 and 4");
    assert!(found.episodes[1].duplicate);
}

#[test]
fn failures_for_another_reason_are_shown_and_not_counted() {
    let before = Made { statuses: vec!["failed"; 2], ..Made::passing(0) };
    let mut after = before.value();
    after["episodes"][1]["faults"][0]["fault"] = json!("contact.pedestrian");
    let (before, after) = (before.result(), result(after));
    let found = compare(&before, &after, &[]);
    assert_eq!((found.worse, found.counts.same), (false, 2));
    let text = found.to_text();
    let lines: Vec<&str> = text.lines().filter(|line| line.starts_with("other fault")).collect();
    assert_eq!(lines.len(), 1, "{text}");
    assert!(lines[0].contains("s-1") && lines[0].contains("contact.pedestrian"), "{text}");
    let runs = [&before, &after].map(|result| DrivenRun { result, episodes: "nowhere".into() });
    let page = found.to_page(&runs, &ComparedPictures::new());
    assert!(page.contains("class=\"same\">other fault<") && !page.contains(">same<"), "{page}");
}

#[test]
fn pairs_of_one_name_have_their_own_pictures() {
    let bench = Bench::new();
    let before = statuses(&["failed"; 2]);
    // Another value of the sweep at the same index, which alone is in the name.
    let mut swept = Made { statuses: vec!["failed"; 2], ..Made::passing(0) }.value();
    swept["episodes"][0]["values"] = json!({ "v": 8.0 });
    let after = result(swept);
    let found = compare(&before, &after, &[]);
    let run = |result, out| DrivenRun { result, episodes: bench.path(out) };
    let runs = [run(&before, "before"), run(&after, "after")];
    let pictures = found.pictures(&runs, &bench.catalog(), &cpu());
    assert_eq!(pictures.len(), 2, "{pictures:?}");
    // Each pair says why its own record has no picture, not that the other run has none.
    let page = found.to_page(&runs, &pictures);
    assert_eq!(page.matches("<h3>s-0</h3>").count(), 2, "{page}");
    assert_eq!(page.matches("No picture: ").count(), 2, "{page}");
    assert!(!page.contains("it was not driven"), "{page}");
}

#[test]
fn a_tolerance_is_a_name_and_an_amount() {
    for wrong in ["pass_rate", "=1", "pass_rate=", "pass_rate=-0.1", "pass_rate=nan", "a=inf"] {
        let error = wrong.parse::<Tolerance>().unwrap_err();
        assert!(error.contains("NAME=AMOUNT"), "{wrong}: {error}");
    }
    let good: Tolerance = "bench2drive.driving@7ec25d1=2".parse().unwrap();
    assert_eq!((good.name.as_str(), good.amount), (DRIVING, 2.0));
}
