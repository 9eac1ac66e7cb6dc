//! Suites with actors: contacts, the verdict, and the record.

use serde_json::{Value, json};
use wildcity_episode::{EpisodeFile, Event, result};
use wildcity_suite::{
    AgentChoice, BuiltIn, CaseOptions, Ending, SuiteFile, SuiteResult, cases, page, pictures, run,
};

use crate::street::{Bench, cpu, scenario};

/// A pedestrian that walks into the way of the recorded drive, 1.4 s after the start.
fn pedestrian() -> Value {
    let mut value = scenario("walk", &json!({ "model": "kinematic", "speed": 10.0 }));
    value["actors"] = json!([{ "name": "walker", "class": "pedestrian", "collide": {
        "along": "log", "station_m": 36.0, "time_s": 1.4, "angle_rad": 1.57, "speed": 1.34 } }]);
    value
}

async fn drive(bench: &Bench, agent: BuiltIn, bare: bool, out: &str) -> SuiteResult {
    let path = bench.write("walk.json", &pedestrian());
    let (suite, scenarios) = SuiteFile::read(&path).unwrap();
    let options = CaseOptions { latest: false, bare };
    let cases = cases(&suite, &scenarios, &bench.catalog(), options).unwrap();
    run(bench.settings(AgentChoice::BuiltIn(agent), 1, out), cases).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_that_ignores_the_pedestrian_fails_for_contact() {
    let bench = Bench::new();
    let failed = drive(&bench, BuiltIn::Log, false, "log").await;
    let episode = &failed.episodes[0];
    assert_eq!(failed.counts.failed, 1, "{}", failed.to_json());
    assert_eq!(episode.faults[0].fault, "contact.pedestrian");
    assert_eq!(episode.faults[0].actor.as_deref(), Some("walker"));
    let shown = pictures(&failed, &bench.path("log"), &bench.catalog(), &cpu());
    assert_eq!(shown.len(), 1);
    let html = page(&failed, &Ending::new(&failed, None), &shown, &bench.path("log"));
    assert!(html.contains("contact.pedestrian with walker") && html.contains("image/jpeg"));

    // The same scenario without its actors must pass, which checks the scenario itself.
    let bare = drive(&bench, BuiltIn::Log, true, "bare").await;
    assert_eq!(bare.counts.passed, 1, "{}", bare.to_json());
}

/// The ego brakes evenly, so that it moves alike whatever the length of a step.
#[tokio::test(flavor = "multi_thread")]
async fn every_step_length_finds_the_same_contacts() {
    let bench = Bench::new();
    let mut value = scenario("cross", &json!({ "model": "kinematic", "speed": 10.0 }));
    value["actors"] = json!([
        { "name": "walker", "class": "pedestrian", "collide": {
            "along": "log", "station_m": 34.0, "time_s": 1.5, "angle_rad": 1.57, "speed": 1.34 } },
        { "name": "behind", "path": { "along": "log", "station_m": 2.0, "speed": 17.0 } },
    ]);
    bench.write("cross.json", &value);
    let mut seen = Vec::new();
    for dt_us in [50_000, 100_000, 500_000] {
        let suite = json!({ "format": "wildcity.suite/1", "name": "steps", "scenarios": ["cross.json"],
            "cameras": ["front"], "dt_us": dt_us });
        let cases = bench.cases(&bench.write("steps.json", &suite)).unwrap();
        let out = format!("dt{dt_us}");
        let settings = bench.settings(AgentChoice::BuiltIn(BuiltIn::Stand), 1, &out);
        let result = run(settings, cases).await.unwrap();
        let episode =
            EpisodeFile::read(&bench.path(&out).join(&result.episodes[0].record)).unwrap();
        let contacts: Vec<_> = episode
            .events
            .iter()
            .filter_map(|line| match &line.event {
                Event::Contact(contact) => {
                    Some((line.time_us, contact.actor, contact.collision, contact.ego_at_fault))
                }
                _ => None,
            })
            .collect();
        seen.push(contacts);
    }
    let met: std::collections::BTreeSet<u16> = seen[0].iter().map(|contact| contact.1).collect();
    assert_eq!(met.len(), 2, "{seen:?}");
    assert!(seen[0][0].0 % 100_000 != 0, "within a step: {seen:?}");
    assert_eq!(seen[0], seen[1]);
    assert_eq!(seen[0], seen[2]);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_session_records_actors_events_and_result() {
    let bench = Bench::new();
    let failed = drive(&bench, BuiltIn::Log, false, "log").await;
    let path = bench.path("log").join(&failed.episodes[0].record);
    let episode = EpisodeFile::read(&path).unwrap();
    assert_eq!(episode.cut, None);
    let scenario = episode.scenario.as_ref().unwrap();
    assert_eq!(scenario.hash, failed.episodes[0].scenario_hash);
    assert_eq!(scenario.actors[0].name, "walker");
    assert_eq!(episode.actors.len(), episode.driven().len());
    let contacts = episode.events.iter().filter(|line| matches!(line.event, Event::Contact(_)));
    assert_eq!(contacts.count(), 1, "{:?}", episode.events);
    assert_eq!(episode.result, result(&episode), "live and from the record");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_that_leaves_the_road_meets_the_twin() {
    let bench = Bench::new();
    let mut value = scenario("posts", &json!({ "model": "kinematic", "speed": 10.0 }));
    value["end"] = json!({ "time_s": 4.0, "contact": "static" });
    // Onto the posts, which have a lateral offset of 5 m from the drive.
    let points = [[20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [45.0, 5.0, 0.0], [90.0, 5.0, 0.0]];
    value["route"] = json!({ "points": points });
    let path = bench.write("posts.json", &value);
    let drive = async |agent: BuiltIn, out: &str| {
        let cases = bench.cases(&path).unwrap();
        run(bench.settings(AgentChoice::BuiltIn(agent), 1, out), cases).await.unwrap()
    };
    // `idm` follows the route, `log` the drive, on which no contact counts.
    let off_road = drive(BuiltIn::Idm, "idm").await;
    let episode = &off_road.episodes[0];
    assert_eq!(episode.faults[0].fault, "contact.static", "{}", off_road.to_json());
    assert!((1_000_000..3_500_000).contains(&episode.faults[0].time_us), "{:?}", episode.faults);
    assert!(episode.steps < 40, "the contact ends the episode");
    let record = EpisodeFile::read(&bench.path("idm").join(&episode.record)).unwrap();
    let met = record.events.iter().find_map(|line| match line.event {
        Event::StaticContact { area_m2, impact_mps } => Some((area_m2, impact_mps)),
        _ => None,
    });
    let (area_m2, impact_mps) = met.unwrap();
    // A post has 0.374 m².
    // The page says as much as the record, and marks the step.
    let html = page(&off_road, &Ending::new(&off_road, None), &[], &bench.path("idm"));
    assert!(html.contains(&format!(" s, at {impact_mps:.2} m/s, {area_m2:.3} m²")), "{html}");
    assert!(area_m2 > 0.3 && (5.0..11.0).contains(&impact_mps), "{area_m2} m², {impact_mps} m/s");
    let log = drive(BuiltIn::Log, "log").await;
    assert_eq!(log.counts.passed, 1, "{}", log.to_json());
    assert!(!log.episodes[0].not_judged.iter().any(|reason| reason.contains("twin")));
}
