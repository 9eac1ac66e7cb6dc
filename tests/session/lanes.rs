//! Cars on the lanes of a map, in a twin without a recorded drive.

use std::sync::Arc;

use glam::DVec3;
use serde_json::{Value, json};
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_session::Scenarios;
use wildcity_session::options::{ScenarioChoice, Start};
use wildcity_sim::ego::Action;
use wildcity_sim::{Command, Dynamics, DynamicsModel};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::actor_records::replay;
use crate::actors::{open, options};
use crate::driving::open_bench;
use crate::streaming::PROFILE;

/// Rise of the lane, in m per m.
const CLIMB: f64 = 0.08;

/// A twin of a few Gaussians without a drive.
fn hill() -> (tempfile::TempDir, Catalog) {
    let mut gaussians = Gaussians::with_capacity(0, 50);
    for i in 0..50_u8 {
        let x = f32::from(i);
        gaussians.means_m.push([f64::from(x), 3.0, CLIMB * f64::from(x)]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([-1.0; 3]);
        gaussians.logit_opacities.push(3.0);
        gaussians.sh.extend([x / 50.0; 3]);
    }
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let new = NewVersion {
        profile: PROFILE,
        ..NewVersion::from_gaussians("hill", &gaussians, Provenance::new("test".to_owned()))
    };
    catalog.commit(new, &mut |_, _| {}).unwrap();
    (dir, catalog)
}

/// A lane up the hill, along x.
fn map() -> Value {
    let line = |y_m: f64| json!([[0.0, y_m, 0.0], [200.0, y_m, 200.0 * CLIMB]]);
    let lane = json!({"id": "up", "center": line(0.0), "left": line(1.75), "right": line(-1.75)});
    json!({"format": "wildcity.map/1", "lanes": [lane]})
}

/// The ego climbs with the lane, and the record is enough to drive it again.
#[tokio::test(flavor = "multi_thread")]
async fn the_ego_climbs_with_a_lane_and_its_record_is_driven_again() {
    let (_dir, catalog) = hill();
    let scenarios = tempfile::tempdir().unwrap();
    std::fs::write(scenarios.path().join("hill.map.json"), map().to_string()).unwrap();
    let bench = open_bench(
        Cache::new(catalog.clone()),
        Arc::new(crate::images::cpu()),
        Scenarios::in_dir(scenarios.path()),
    );
    let mut options = options(&json!([]), false);
    options.twin = "hill".to_owned();
    // Above the road: the start is placed on it.
    let position_m = DVec3::new(10.0, 0.5, 3.0);
    options.start = Some(Start::from(Pose { position_m, ..Pose::IDENTITY }));
    let kinematic =
        Dynamics { model: DynamicsModel::Kinematic, speed_m_s: 8.0, ..Dynamics::default() };
    options.dynamics = Some(kinematic.into());
    if let Some(ScenarioChoice::Object(file)) = &mut options.scenario {
        file["twin"]["name"] = "hill".into();
        file.insert("map".to_owned(), json!({"file": "hill.map.json"}));
    }
    let mut session = open(&bench, "hill", options).await;
    session.reset(0, None).await.unwrap();
    let start = session.start();
    assert!((start.position_m.z - 10.0 * CLIMB).abs() < 1e-12, "{start:?}");
    for _ in 0..5 {
        let action = Action { acceleration_m_s2: 0.0, curvature_1_m: 0.002 };
        session.step(Command::Action(action), false).await.unwrap();
        let Pose { position_m, rotation } = session.episode().world_from_rig();
        assert!((position_m.z - CLIMB * position_m.x).abs() < 1e-12, "{position_m}");
        let up = rotation * DVec3::Z;
        assert!((up - DVec3::new(-CLIMB, 0.0, 1.0).normalize()).length() < 1e-12, "{up}");
    }
    session.close(wildcity_session::Outcome::Completed).await;

    let path = bench.episodes.path().join("hill-1.jsonl");
    let report = replay(&path, &catalog);
    assert_eq!((report.diverged, &report.wrong_value, report.difference), (None, &None, None));
    assert!(report.images >= 12, "{}", report.images);
    // The map's file is deleted, and the record has a different road, so that the ego has different
    // poses.
    drop(scenarios);
    assert_eq!(replay(&path, &catalog).diverged, None);
    let text = std::fs::read_to_string(&path).unwrap();
    let steeper = text.replacen("[200.0,0.0,16.0]", "[200.0,0.0,17.0]", 1);
    assert_ne!(text, steeper);
    std::fs::write(&path, steeper).unwrap();
    assert!(replay(&path, &catalog).diverged.is_some());
}
