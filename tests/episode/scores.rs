//! Scores from records alone.

use glam::DVec2;
use serde_json::json;
use wildcity_episode::{EpisodeFile, result};
use wildcity_sim::contact::{CollisionType, Contact};

use crate::thread_time::thread_time;
use crate::written::{self, Made};

/// The verdict of a drive on a road, in which contact with the twin was looked for.
fn verdict(made: &Made) -> String {
    let mut lines = made.lines();
    lines[1]["lanes"] =
        json!([{ "outline": [[-9, -4], [120, -4], [120, 4], [-9, 4]], "route": true }]);
    lines[1]["checks_static"] = true.into();
    result(&written::read(&lines)).unwrap().verdict
}

fn contact(ego_at_fault: bool) -> Contact {
    Contact {
        actor: 1,
        time_us: 2_001_000,
        at_start: false,
        kind: CollisionType::ActiveFront,
        ego_at_fault,
        normal: DVec2::X,
        impact_mps: 6.3,
        ego_velocity_mps: DVec2::new(10.0, 0.0),
        actor_velocity_mps: DVec2::new(3.7, 0.0),
    }
}

#[test]
fn a_drive_at_the_recorded_speed_passes_and_a_stand_fails_for_progress() {
    assert_eq!(verdict(&Made::default()), "passed");
    // Without a map, and without a look at the twin, it is no pass.
    let unseen = result(&Made::default().read()).unwrap();
    assert_eq!(unseen.verdict, "not_judged");
    let names: Vec<&str> =
        unseen.not_judged.iter().filter_map(|text| Some(text.split_once(": ")?.0)).collect();
    assert_eq!(names, ["contact.static", "off_road"]);
    let stand = result(&Made { speed_mps: 0.0, ..Made::default() }.read()).unwrap();
    assert_eq!(stand.verdict, "failed");
    assert_eq!(stand.faults[0].fault, "progress");
    assert_eq!(verdict(&Made { outcome: Some("off_model"), ..Made::default() }), "off_model");
}

#[test]
fn a_contact_of_the_record_is_judged_and_named() {
    let made = |at_fault| Made { contacts: vec![(21, contact(at_fault))], ..Made::default() };
    let failed = result(&made(true).read()).unwrap();
    assert_eq!(failed.verdict, "failed");
    assert_eq!(failed.faults[0].actor.as_deref(), Some("car1"));
    assert_eq!(failed.faults[0].time_us, 2_001_000);
    let stars = &failed.scores["neuroncap.score@ecdcf28"];
    // The recorded drive goes 10 m/s: 4 (1 - 6.3/10).
    assert!((stars.value.unwrap() - 1.48).abs() < 1e-9, "{stars:?}");
    assert_eq!(verdict(&made(false)), "passed");
    let back = made(true).read().events[0].clone();
    let wildcity_episode::Event::Contact(event) = &back.event else { panic!("{back:?}") };
    assert_eq!(event.contact(back.time_us), contact(true));
}

#[test]
fn an_episode_without_a_scenario_is_not_judged() {
    let mut lines = Made::default().lines();
    lines.retain(|line| line["kind"] != "scenario" && line["kind"] != "actors");
    let found = result(&written::read(&lines)).unwrap();
    assert_eq!(found.verdict, "not_judged");
    assert!(found.not_judged.iter().any(|reason| reason.contains("no scenario")), "{found:?}");
    assert!(found.scores["alpasim.scene@3032e0c"].value.is_none());
}

#[test]
fn speeds_and_turns_come_from_the_poses() {
    let record = wildcity_episode::drive_record(&Made::default().read()).unwrap();
    assert_eq!(record.ego.len(), 51);
    let sample = record.ego[25];
    assert!((sample.velocity_mps.length() - 10.0).abs() < 1e-9, "{sample:?}");
    // The heading turns by 1e-3 rad a metre.
    assert!((sample.yaw_rate_radps - 0.01).abs() < 1e-9, "{sample:?}");
    assert!(record.tracks.unwrap()[1].samples.iter().all(Option::is_some));
}

#[test]
fn plans_of_the_record_are_scored() {
    let without = result(&Made::default().read()).unwrap();
    let reason = without.scores["alpasim.plan_deviation@3032e0c"].reason.clone().unwrap();
    assert!(reason.contains("needs a plan"), "{reason}");

    let made = Made { plan_poses: 64, ..Made::default() };
    let record = wildcity_episode::drive_record(&made.read()).unwrap();
    assert_eq!(record.plans.len(), 50);
    let plan = &record.plans[20];
    assert_eq!((plan.decided_us(), plan.end_us()), (2_000_000, 8_400_000));
    // The plan is along the rig of the decision, at 20 m, which heads 0.02 rad to the left.
    let start_m = plan.at(2_000_000).unwrap().origin_m;
    let along = plan.at(2_100_000).unwrap().origin_m - start_m;
    assert_eq!(start_m, DVec2::new(20.0, 0.0));
    assert!(
        (along.length() - 1.0).abs() < 1e-3 && (along.to_angle() - 0.02).abs() < 1e-3,
        "{along}"
    );
    let scored = result(&made.read()).unwrap();
    let value = |name: &str| scored.scores[name].value.unwrap();
    assert!((0.01..1.0).contains(&value("alpasim.plan_deviation@3032e0c")), "{scored:?}");
    assert!((0.01..1.0).contains(&value("alpasim.min_ade_1s@3032e0c")), "{scored:?}");
    assert_eq!(value("alpasim.open_loop_collision@3032e0c"), 0.0);
}

#[test]
fn a_record_of_thirty_seconds_is_read_and_scored_in_50_ms() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("long-1.jsonl");
    written::write(
        &path,
        &Made { steps: 300, actors: 30, speed_mps: 0.3, ..Made::default() }.lines(),
    );
    let scored = || {
        let scored = result(&EpisodeFile::read(&path).unwrap()).unwrap();
        assert_eq!(scored.scores.len(), 17);
    };
    let took = (0..5).map(|_| thread_time(scored)).min().unwrap();
    assert!(took.as_millis() < 50, "{took:?}");
}

#[test]
fn a_record_that_skips_steps_is_not_scored() {
    let mut lines = Made::default().lines();
    let skipped = lines.iter().position(|line| line["kind"] == "frame" && line["step"] == 7);
    lines.remove(skipped.unwrap());
    assert_eq!(result(&written::read(&lines)), None);
}
