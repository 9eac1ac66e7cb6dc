//! Contact of a session's ego with the twin: with that version of it which the session shows.

use glam::DVec3;
use serde_json::json;
use tempfile::TempDir;
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_session::{
    Encoding, EventKind, Outputs, RigChoice, ScenarioOptions, ScenarioSource, Session,
    SessionOptions, Start,
};
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
            ..NewVersion::of("walled", &gaussians, Provenance::of("test".to_owned()))
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
    let options = ScenarioOptions {
        source: ScenarioSource::Inline(scenario),
        values: Default::default(),
        dynamics: true,
        warm_up: true,
        actors: false,
    };
    let options = SessionOptions {
        version: Some(version),
        start: Some(Start::Pose(at(0.0))),
        rig: Some(RigChoice::Full(rig())),
        scenario: Some(options),
        ..SessionOptions::twin("walled", Outputs::colour(Encoding::Raw))
    };
    let mut session = Session::open(bench.engine.clone(), name.to_owned(), options).await.unwrap();
    session.reset(0, None).await.unwrap();
    session
}

/// Drives from one metre to another, 1 m per step. Returns the metre at which the ego had contact with the twin.
async fn met(session: &mut Session, from_m: u32, to_m: u32) -> Option<u32> {
    for x_m in from_m + 1..=to_m {
        session.step(at(x_m.into()), false).await.unwrap();
        let events = session.traffic().unwrap().events();
        if events.iter().any(|event| matches!(event.kind, EventKind::StaticContact { .. })) {
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

    // Switch to the version with the wall: the contact is at the same place as in a session that was opened with it.
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
