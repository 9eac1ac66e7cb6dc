//! Scenarios that start at a pose, on maps and on twins without a drive; what agents need.

use serde_json::{Value, json};
use wildcity_episode::{EpisodeFile, limits};
use wildcity_scene::Gaussians;
use wildcity_scene::manifest::Provenance;
use wildcity_sim::map::{Map, MapFile, strips_beside};
use wildcity_suite::{
    AgentChoice, BuiltIn, Ending, ExitCode, Status, SuiteError, SuiteResult, junit, page, verify,
};
use wildcity_twin::store::NewVersion;

use crate::street::{Bench, cpu, scenario};

/// The scenario of two seconds, from a pose beside the drive.
fn posed(name: &str, x_m: f64) -> Value {
    let mut value = scenario(name, &json!({ "model": "kinematic", "speed": 10.0 }));
    value["ego"]["start"] = json!({ "pose": { "xyz": [x_m, 0.3, 0.0], "yaw_rad": 0.0 } });
    value["map"] = json!({ "file": "street.map.json" });
    value
}

/// Writes the map of strips along the drive.
fn write_map(bench: &Bench) -> MapFile {
    let drives = bench.catalog().version("street", None).unwrap().manifest.trajectories;
    let map = strips_beside(&drives, 4.0, 4.0);
    std::fs::write(bench.path("street.map.json"), map.to_json()).unwrap();
    map
}

/// Runs a scenario, with the verdict by all criteria but those accepted.
async fn drive(
    bench: &Bench,
    value: &Value,
    agent: BuiltIn,
    out: &str,
    accepted: &[&str],
) -> Result<SuiteResult, SuiteError> {
    let cases = bench.cases(&bench.write(&format!("{out}.json"), value))?;
    let mut settings = bench.settings(AgentChoice::BuiltIn(agent), 1, out);
    settings.accept_unjudged = accepted.iter().map(|name| (*name).to_owned()).collect();
    wildcity_suite::run(settings, cases).await
}

#[tokio::test(flavor = "multi_thread")]
async fn an_episode_from_a_pose_follows_the_drive_that_is_its_route() {
    let bench = Bench::new();
    write_map(&bench);
    let mut timed = posed("timed", 50.0);
    timed["route"] = json!({ "trajectory": "log" });
    // Without a time, the episode ends with the drive: 2 s from 180 m on.
    let mut untimed = posed("untimed", 180.0);
    untimed["route"] = json!({ "trajectory": "log" });
    untimed["end"] = json!({ "route_done": false });
    for (value, agent, out) in [
        (&timed, BuiltIn::Log, "timed-log"),
        (&timed, BuiltIn::Idm, "timed-idm"),
        (&untimed, BuiltIn::Log, "untimed-log"),
    ] {
        let run = drive(&bench, value, agent, out, &[]).await.unwrap();
        assert_eq!(run.episodes[0].status, Status::Passed, "{out}: {}", run.to_json());
        assert_eq!(run.episodes[0].steps, 20, "{out}");
    }
    // An ego that stands lacks the progress of the drive from the pose on.
    let stood = drive(&bench, &timed, BuiltIn::Stand, "stood", &[]).await.unwrap();
    assert_eq!(stood.episodes[0].faults[0].fault, "progress", "{}", stood.to_json());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_route_of_points_is_judged_by_the_map_and_progress_says_what_it_lacks() {
    let bench = Bench::new();
    write_map(&bench);
    let mut value = posed("points", 30.0);
    value["route"] = json!({ "points": [[10.0, 0.0, 0.0], [60.0, 0.0, 0.0]] });
    value["end"] = json!({ "stuck_s": 1.0 });
    let run = drive(&bench, &value, BuiltIn::Idm, "untimed", &[]).await.unwrap();
    let reason = "progress: nothing says when the ego is due on the route: add end.time_s";
    assert_eq!(run.episodes[0].not_judged, [reason], "{}", run.to_json());
    assert_eq!(run.episodes[0].status, Status::NotJudged);

    // With a time, the way from the pose on is due.
    value["end"] = json!({ "time_s": 2.0, "route_done": false });
    let run = drive(&bench, &value, BuiltIn::Idm, "timed", &[]).await.unwrap();
    assert_eq!(run.episodes[0].not_judged, [""; 0], "{}", run.to_json());
    let record = EpisodeFile::read(&bench.path("timed").join(&run.episodes[0].record)).unwrap();
    let begin_m = record.scenario.unwrap().route[0].1[0];
    assert!((begin_m - 30.0).abs() < 1e-6, "{begin_m}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scenario_that_lacks_a_route_is_a_mistake_of_the_setup() {
    let bench = Bench::new();
    write_map(&bench);
    let value = posed("lost", 50.0);
    for (agent, field) in [(BuiltIn::Idm, "route: is"), (BuiltIn::Log, "route.trajectory: is")] {
        let error = drive(&bench, &value, agent, "lost", &[]).await.unwrap_err();
        assert!(matches!(error, SuiteError::Agent { .. }), "{error}");
        let text = error.to_string();
        assert!(text.contains("\"lost\"") && text.contains(field), "{text}");
        assert!(text.contains("wildcity twin drive"), "{text}");
        assert!(!bench.path("lost").exists(), "nothing is driven");
    }
    // An agent that needs neither is judged by what there is, with the true reasons.
    let run = drive(&bench, &value, BuiltIn::Stand, "stand", &[]).await.unwrap();
    let reasons = &run.episodes[0].not_judged;
    assert!(reasons.iter().any(|text| text.contains("lanes of the map are near")), "{reasons:?}");
    assert!(!reasons.iter().any(|text| text.contains("has no map")), "{reasons:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_twin_without_a_drive_is_driven_without_trust() {
    let bench = Bench::new();
    let gaussians = Gaussians {
        sh_degree: 0,
        means_m: vec![[5.0, 5.0, 1.0]],
        quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]],
        ln_scales: vec![[-1.0; 3]],
        logit_opacities: vec![2.0],
        sh: vec![0.0; 3],
        ..Gaussians::default()
    };
    let rig = bench.catalog().version("street", None).unwrap().manifest.rig;
    let provenance = Provenance::new("test".into());
    let new = NewVersion { rig, ..NewVersion::from_gaussians("plain", &gaussians, provenance) };
    bench.catalog().commit(new, &mut |_, _| {}).unwrap();
    let mut value = posed("plain", 0.0);
    value["twin"]["name"] = json!("plain");
    value.as_object_mut().unwrap().remove("map");
    value["route"] = json!({ "points": [[0.0, 0.0, 0.0], [12.0, 0.0, 0.0]] });
    value["end"] = json!({ "time_s": 1.0 });
    value["verdict"] = json!({ "progress": 0.1 });

    let run = drive(&bench, &value, BuiltIn::Idm, "plain", &[]).await.unwrap();
    assert_eq!(run.counts.technical, 0, "{}", run.to_json());
    assert_eq!(run.episodes[0].status, Status::NotJudged, "{}", run.to_json());
    let texts = run.episodes[0].not_judged_texts();
    let wanted = ["off_model: the twin has no recorded drive", "`wildcity twin drive`"];
    assert!(texts.iter().any(|text| wanted.iter().all(|part| text.contains(part))), "{texts:?}");
    let ending = Ending::new(&run, None);
    let fix = "off_road: the scenario has no map (add a map, or --accept-unjudged off_road)";
    let html = page(&run, &ending, &[], &bench.path("plain"));
    assert!(junit(&run, &ending).contains(fix) && html.contains(fix), "{html}");

    let accepted = ["off_model", "off_road"];
    let run = drive(&bench, &value, BuiltIn::Idm, "accepted", &accepted).await.unwrap();
    assert_eq!(Ending::new(&run, None).code, ExitCode::Passed, "{}", run.to_json());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_record_with_a_large_map_is_read_back() {
    let bench = Bench::new();
    let mut map = write_map(&bench);
    // Copies of the lane with all digits, as OpenDRIVE has them.
    let lane = map.lanes[0].clone();
    for copy in 0..40 {
        let shift_m = 10.0 + f64::from(copy) / 3.0;
        let edge = |y_m: f64| -> Vec<[f64; 3]> {
            (0..300).map(|k| [f64::from(k) / 1.7, shift_m + y_m, 1.0 / 3.0]).collect()
        };
        let mut other = lane.clone();
        other.id = format!("copy{copy}");
        other.center = edge(0.0);
        other.left = edge(0.1);
        other.right = edge(-0.1);
        map.lanes.push(other);
    }
    Map::new(map.clone()).unwrap();
    std::fs::write(bench.path("street.map.json"), map.to_json()).unwrap();
    let mut value = scenario("town", &json!({ "model": "kinematic", "speed": 10.0 }));
    value["map"] = json!({ "file": "street.map.json" });
    value["end"] = json!({ "time_s": 0.2 });
    let run = drive(&bench, &value, BuiltIn::Log, "town", &[]).await.unwrap();
    assert_eq!(run.counts.passed, 1, "{}", run.to_json());
    let path = bench.path("town").join(&run.episodes[0].record);
    let text = std::fs::read_to_string(&path).unwrap();
    let line = text.lines().nth(1).unwrap();
    assert!(line.len() > limits::LINE_BYTES && line.contains("\"scenario\""), "{}", line.len());
    let wrong = verify(&run, &bench.path("town"), &bench.catalog(), &cpu());
    assert_eq!(wrong, Vec::<String>::new());
    assert_eq!(EpisodeFile::read(&path).unwrap().cut, None);
}

/// The box of the ego reaches beyond both ends of the drive, and so do the strips.
#[tokio::test(flavor = "multi_thread")]
async fn the_whole_drive_is_on_its_strips() {
    let bench = Bench::new();
    write_map(&bench);
    for (station_m, out) in [(0.0, "first"), (190.0, "last")] {
        let mut value = scenario(out, &json!({ "model": "teleport" }));
        value["ego"]["start"]["station_m"] = json!(station_m);
        value["map"] = json!({ "file": "street.map.json" });
        value["end"] = json!({ "time_s": 1.0, "route_done": false });
        let run = drive(&bench, &value, BuiltIn::Log, out, &[]).await.unwrap();
        assert_eq!(run.counts.passed, 1, "{}", run.to_json());
    }
}
