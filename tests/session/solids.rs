//! Contact of a session's ego with the twin: with that version of it which the session shows.

use glam::DVec3;
use serde_json::json;
use tempfile::TempDir;
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_session::options::{ContactMode, Encoding, Open, Outputs, RigChoice, Start};
use wildcity_session::{EpisodeSummary, Event, EventKind, Outcome, Session, StepOptions};
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::scenario::EndReason;
use wildcity_sim::{Command, Dynamics, DynamicsModel};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::driving::{Bench, bench, rig};
use crate::streaming::PROFILE;

/// A twin whose second version has a wall 5 m to the left of the recorded drive, from 20 m on.
fn walled() -> (TempDir, Catalog) {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    for has_wall in [false, true] {
        let mut gaussians = Gaussians::with_capacity(0, 300);
        for i in 0..300 {
            let at = f64::from(i % 100);
            let (mean_m, sigma_m) = match i / 100 {
                0 => ([0.6 * at, 0.0, 0.0], 1.0_f32),
                _ if has_wall => ([20.0 + 0.2 * at, 5.0, 0.5 + f64::from(i / 200)], 0.2),
                _ => ([0.6 * at, -8.0, 1.0], 0.2),
            };
            gaussians.means_m.push(mean_m);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([sigma_m.ln(), sigma_m.ln(), -3.0]);
            gaussians.logit_opacities.push(3.0);
            gaussians.sh.extend([0.5; 3]);
        }
        let keyframe = |k: i64| Keyframe {
            time_us: 100_000 * k,
            world_from_rig: Pose { position_m: DVec3::X * k as f64, ..Pose::IDENTITY },
        };
        let log =
            Trajectory { name: "log".to_owned(), keyframes: (0..=60).map(keyframe).collect() };
        let new = NewVersion {
            profile: PROFILE,
            trajectories: vec![log],
            ..NewVersion::from_gaussians("walled", &gaussians, Provenance::new("test".to_owned()))
        };
        catalog.commit(new, &mut |_, _| {}).unwrap();
    }
    (dir, catalog)
}

fn at(x_m: f64) -> Pose {
    Pose { position_m: DVec3::new(x_m, 5.0, 0.0), ..Pose::IDENTITY }
}

async fn open(bench: &Bench, name: &str, version: u64) -> Session {
    let scenario = json!({
        "format": "wildcity.scenario/1", "name": "beside", "twin": { "name": "walled" },
        "route": { "points": [[0, 5, 0], [60, 5, 0]] }, "end": { "time_s": 9, "contact": "static" },
    });
    let options = serde_json::from_value(scenario).unwrap();
    let options = Open {
        version: Some(version),
        start: Some(Start::from(at(0.0))),
        rig: Some(RigChoice::Full(rig().into())),
        scenario: Some(options),
        outputs: Outputs::colour(Encoding::Raw),
        ..Open::twin("walled")
    };
    let mut session = Session::open(bench.engine.clone(), name.to_owned(), options).await.unwrap();
    session.reset(0, None).await.unwrap();
    session
}

/// Drives from one metre to another, 1 m per step. Returns the metre at which the ego had contact
/// with the twin.
async fn met(session: &mut Session, from_m: u32, to_m: u32) -> Option<u32> {
    for x_m in from_m + 1..=to_m {
        session.step(at(x_m.into()), false).await.unwrap();
        if session
            .events()
            .iter()
            .any(|event| matches!(event.kind, EventKind::StaticContact { .. }))
        {
            return Some(x_m);
        }
    }
    None
}

#[tokio::test(flavor = "multi_thread")]
async fn a_switch_of_version_changes_what_the_ego_meets() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    let mut free = open(&bench, "free", 1).await;
    assert_eq!(met(&mut free, 0, 30).await, None);
    let mut wall = open(&bench, "wall", 2).await;
    let met_m = met(&mut wall, 0, 30).await.unwrap();
    assert!((14..=20).contains(&met_m), "{met_m}");

    // Switch to the version with the wall: the contact is at the same place as in a session that
    // was opened with it.
    let mut session = open(&bench, "into", 1).await;
    assert_eq!(met(&mut session, 0, 5).await, None);
    session.take_snapshot("before".to_owned()).unwrap();
    session.switch_version(Some(2)).await.unwrap();
    assert_eq!(met(&mut session, 5, 30).await, Some(met_m));
    // A new episode stays in that version, and a snapshot has its own.
    session.reset(0, None).await.unwrap();
    assert_eq!(met(&mut session, 0, 30).await, Some(met_m));
    session.restore("before").await.unwrap();
    assert_eq!(met(&mut session, 5, 30).await, None);

    // And out of it.
    let mut session = open(&bench, "out", 2).await;
    assert_eq!(met(&mut session, 0, 5).await, None);
    session.switch_version(Some(1)).await.unwrap();
    assert_eq!(met(&mut session, 5, 30).await, None);
    // A wall that the ego overlaps already when the version changes is not a contact.
    session.switch_version(Some(2)).await.unwrap();
    assert_eq!(met(&mut session, 30, 32).await, None);
}

/// A session without a scenario, which starts 5 m to the left of the drive, on the way to the wall.
async fn plain(
    bench: &Bench,
    name: &str,
    dynamics: Dynamics,
    contact: Option<ContactMode>,
) -> Session {
    let options = Open {
        start: Some(Start::from(at(0.0))),
        rig: Some(RigChoice::Full(rig().into())),
        dynamics: Some(dynamics.into()),
        contact,
        outputs: Outputs::colour(Encoding::Raw),
        ..Open::twin("walled")
    };
    let mut session = Session::open(bench.engine.clone(), name.to_owned(), options).await.unwrap();
    session.reset(0, None).await.unwrap();
    session
}

/// Drives straight on at 10 m/s until the episode ends, for at most 40 steps. Returns all events,
/// and how the episode went.
async fn straight(mut session: Session) -> (Vec<Event>, EpisodeSummary) {
    let mut events = Vec::new();
    for step in 1..=40 {
        let command = match session.dynamics().model {
            DynamicsModel::Teleport => Command::Pose(at(f64::from(step))),
            _ => Command::Action(Action { acceleration_m_s2: 0.0, curvature_1_m: 0.0 }),
        };
        session.step(command, false).await.unwrap();
        events.extend_from_slice(session.events());
        if session.episode().terminated() {
            break;
        }
    }
    (events, session.close(Outcome::Completed).await)
}

#[tokio::test(flavor = "multi_thread")]
async fn every_session_looks_for_contact_with_the_twin() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    let driven = |model: DynamicsModel| {
        Dynamics { model, ..Dynamics::default() }.with_speed("speed", 10.0).unwrap()
    };
    let is_contact = |event: &Event| matches!(event.kind, EventKind::StaticContact { .. });
    let ends = |event: &Event| matches!(event.kind, EventKind::End(EndReason::Contact));
    let mut times_us = Vec::new();
    for model in [DynamicsModel::Kinematic, DynamicsModel::Dynamic] {
        let name = format!("end-{}", model.name());
        let (events, summary) = straight(plain(&bench, &name, driven(model), None).await).await;
        assert_eq!(summary.outcome, Outcome::DrivingFailure);
        assert_eq!(
            (events.len(), is_contact(&events[0]), ends(&events[1])),
            (2, true, true),
            "{events:?}"
        );
        // The record has them, too, and its replay is right.
        let path = bench.episodes.path().join(format!("{name}-1.jsonl"));
        let record = std::fs::read_to_string(&path).unwrap();
        assert_eq!(record.matches("static_contact").count(), 1);
        times_us.push(events[0].time_us);
        let report = Some(ContactMode::Report);
        let name = format!("report-{}", model.name());
        let (events, summary) = straight(plain(&bench, &name, driven(model), report).await).await;
        assert_eq!((summary.outcome, summary.steps), (Outcome::Completed, 40));
        assert_eq!((events.len(), is_contact(&events[0])), (1, true), "{events:?}");
        let off = Some(ContactMode::Off);
        let name = format!("off-{}", model.name());
        let (events, summary) = straight(plain(&bench, &name, driven(model), off).await).await;
        assert_eq!((events.as_slice(), summary.steps), ([].as_slice(), 40));
    }
    assert!((times_us[0] - times_us[1]).abs() < 100_000, "{times_us:?}");
    // Teleport reports contacts and goes on, unless it is asked to end.
    let teleport = Dynamics::default();
    let (events, summary) = straight(plain(&bench, "jumps", teleport, None).await).await;
    assert_eq!((events.len(), summary.outcome, summary.steps), (1, Outcome::Completed, 40));
    let end = Some(ContactMode::End);
    let (events, summary) = straight(plain(&bench, "ends", teleport, end).await).await;
    assert_eq!((events.len(), summary.outcome), (2, Outcome::DrivingFailure));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_recorded_drive_has_no_contact_and_a_bush_elsewhere_hides_none() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    let mut session = plain(&bench, "drive", Dynamics::default(), None).await;
    for x_m in 0..=60 {
        let pose = Pose { position_m: DVec3::X * f64::from(x_m), ..Pose::IDENTITY };
        session.step(pose, false).await.unwrap();
        assert_eq!(session.events(), [], "at {x_m} m");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_ego_that_leaves_the_trained_area_ends_off_model_without_trust() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    let mut outcomes = Vec::new();
    for aside_m in [11.0, 12.0] {
        let name = format!("aside-{aside_m}");
        let mut session = plain(&bench, &name, Dynamics::default(), Some(ContactMode::Off)).await;
        let aside = Pose { position_m: DVec3::new(10.0, -aside_m, 0.0), ..Pose::IDENTITY };
        session.step(aside, false).await.unwrap();
        let left: Vec<i64> = session.events().iter().map(|event| event.time_us).collect();
        // Once, however long it stays there.
        session.step(aside, false).await.unwrap();
        assert_eq!(session.events(), []);
        session.step(at(0.0), false).await.unwrap();
        outcomes.push((left, session.close(Outcome::Completed).await.outcome));
    }
    let wanted = [(vec![], Outcome::Completed), (vec![100_000], Outcome::OffModel)];
    assert_eq!(outcomes, wanted);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scenario_decides_what_a_contact_does() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    let options = |contact: Option<&str>, mode: Option<ContactMode>| {
        let mut end = json!({ "time_s": 3 });
        if let Some(contact) = contact {
            end["contact"] = contact.into();
        }
        let scenario = json!({
            "format": "wildcity.scenario/1", "name": "beside", "twin": { "name": "walled" }, "end": end,
        });
        let scenario = serde_json::from_value(scenario).unwrap();
        Open {
            start: Some(Start::from(at(0.0))),
            rig: Some(RigChoice::Full(rig().into())),
            scenario: Some(scenario),
            contact: mode,
            outputs: Outputs::colour(Encoding::Raw),
            ..Open::twin("walled")
        }
    };
    // The rule, what the session asks for, whether there is a contact, and whether it ends the
    // episode.
    let cases = [
        (None, None, true, false),
        (Some("any"), None, true, true),
        (Some("at_fault"), None, true, true),
        (Some("static"), None, true, true),
        (Some("pedestrian"), None, true, false),
        (Some("any"), Some(ContactMode::Off), false, false),
    ];
    for (index, (rule, mode, is_seen, ends)) in cases.into_iter().enumerate() {
        let name = format!("case-{index}");
        let opened = Session::open(bench.engine.clone(), name, options(rule, mode)).await;
        let mut session = opened.unwrap();
        session.reset(0, None).await.unwrap();
        let mut events = Vec::new();
        for x_m in 1..=25 {
            session.step(at(f64::from(x_m)), false).await.unwrap();
            events.extend_from_slice(session.events());
            if session.episode().terminated() {
                break;
            }
        }
        let seen = events.iter().any(|event| matches!(event.kind, EventKind::StaticContact { .. }));
        assert_eq!((seen, session.episode().terminated()), (is_seen, ends), "{rule:?} {mode:?}");
    }
    let both = options(Some("any"), Some(ContactMode::Report));
    let Err(refused) = Session::open(bench.engine.clone(), "both".to_owned(), both).await else {
        panic!("two rules")
    };
    assert!(refused.to_string().contains("end.contact"), "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn events_of_a_plan_are_in_order_and_a_contact_comes_before_what_follows_it() {
    let (_dir, catalog) = walled();
    let bench = bench(Cache::new(catalog));
    // Into the wall and on, far from the drive: a contact, and then off the trained area, in one
    // request.
    let path = |name: &'static str, aside_m: [f64; 2]| {
        let bench = &bench;
        async move {
            let end = Some(ContactMode::End);
            let mut session = plain(bench, name, Dynamics::default(), end).await;
            session.step(at(10.0), false).await.unwrap();
            let pose = |time_us: i64, y_m: f64| TimedPose {
                time_us,
                start_from_rig: Pose { position_m: DVec3::new(15.0, y_m, 0.0), ..Pose::IDENTITY },
            };
            let poses = vec![pose(500_000, aside_m[0]), pose(1_000_000, aside_m[1])];
            let command = Command::Path(Path::checked(poses).unwrap());
            let options = StepOptions { until_us: Some(1_000_000), ..StepOptions::default() };
            session.follow(command, options).await.unwrap();
            let events: Vec<Event> = session.events().to_vec();
            (events, session.close(Outcome::Completed).await.outcome)
        }
    };
    let (events, outcome) = path("on", [0.0, 30.0]).await;
    assert_eq!(outcome, Outcome::DrivingFailure, "{events:?}");
    assert!(events.is_sorted_by_key(|event| event.time_us), "{events:?}");
    let left = events.iter().filter(|event| matches!(event.kind, EventKind::OffModel { .. }));
    assert_eq!(left.count(), 0, "it had failed before");
}
