//! Actors in records: replayed with their assets, refused if the scenario does not have them; and
//! an object that was cut out of a twin and put back as an actor.

use std::sync::OnceLock;

use glam::DVec3;
use serde_json::{Value, json};
use wildcity_scene::actor::{ActorAsset, AssetDescription, PlacedChunk};
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat, RenderProfile};
use wildcity_session::options::{ScenarioChoice, Start};
use wildcity_session::{RecordedEpisode, ReplayError, ReplayUntil, StepOptions};
use wildcity_sim::ego::Action;
use wildcity_sim::{Command, Dynamics, DynamicsModel};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions};

use crate::actors::{car, car_asset, open, options};
use crate::driving::bench;
use crate::images::{psnr, render, view_along};
use crate::streaming::{PROFILE, eyes};

/// A twin with a recorded drive of 60 m along x, and the asset of the car.
fn straight() -> &'static (tempfile::TempDir, Catalog) {
    static STRAIGHT: OnceLock<(tempfile::TempDir, Catalog)> = OnceLock::new();
    STRAIGHT.get_or_init(|| {
        let mut gaussians = Gaussians::with_capacity(0, 400);
        for i in 0..400 {
            let at = |k: usize| (i * k % 397) as f64 / 397.0;
            gaussians.means_m.push([80.0 * at(31), 20.0 * at(57) - 10.0, 0.1 * at(71)]);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([1.0, 1.0, -3.0]);
            gaussians.logit_opacities.push(3.0);
            gaussians.sh.extend([at(13) as f32; 3]);
        }
        let keyframe = |k: i64| Keyframe {
            time_us: 100_000 * k,
            world_from_rig: Pose { position_m: DVec3::X * (0.6 * k as f64), ..Pose::IDENTITY },
        };
        let log =
            Trajectory { name: "log".to_owned(), keyframes: (0..=100).map(keyframe).collect() };
        let dir = tempfile::tempdir().unwrap();
        let catalog = Catalog::open(dir.path()).unwrap();
        let new = NewVersion {
            profile: PROFILE,
            trajectories: vec![log],
            ..NewVersion::from_gaussians("straight", &gaussians, Provenance::new("test".to_owned()))
        };
        catalog.commit(new, &mut |_, _| {}).unwrap();
        catalog.put_actor(&car_asset(), RecordFormat::F32).unwrap();
        (dir, catalog)
    })
}

/// A record has the poses of the actors: in the warm-up, within plans, and when they appear and
/// disappear.
#[tokio::test(flavor = "multi_thread")]
async fn a_recorded_episode_is_rendered_again_with_its_actors() {
    let (_, catalog) = straight();
    let asset = Value::from(&*car().hash);
    let actors = json!([
        {"name": "ahead", "asset": asset, "path": {"along": "log", "station_m": 20, "speed": 7},
         "script": [{"when": {"time_s": 0.75}, "do": [{"remove": {}}]}]},
        {"name": "crossing", "asset": asset, "present": false,
         "collide": {"positions": [{"time_s": 0, "xyz": [24, -6, 0]}, {"time_s": 2, "xyz": [24, 6, 0]}]},
         "script": [{"when": {"time_s": 0.25}, "do": [{"spawn": {}}]}]},
        {"name": "passing", "asset": asset,
         "collide": {"positions": [{"time_s": -1, "xyz": [8, 4, 0]}, {"time_s": 2, "xyz": [40, 4, 0]}]}}
    ]);
    let mut bundled = options(&actors, true);
    bundled.outputs.frames = Some(3);
    let kinematic =
        Dynamics { model: DynamicsModel::Kinematic, speed_m_s: 6.0, ..Dynamics::default() };
    bundled.dynamics = Some(kinematic.into());
    bundled.twin = "straight".to_owned();
    bundled.start = Some(Start::Station { trajectory: "log".to_owned(), station_m: 6.0 });
    bundled.warm_up_us = Some(400_000);
    if let Some(ScenarioChoice::Object(file)) = &mut bundled.scenario {
        file["twin"]["name"] = "straight".into();
    }
    let bench = bench(Cache::new(catalog.clone()));
    let still = || Command::Action(Action { acceleration_m_s2: 0.0, curvature_1_m: 0.01 });
    let plan = |until_us| StepOptions { until_us: Some(until_us), ..StepOptions::default() };
    // One episode from its reset, one from its first step.
    for (name, resets) in [("reset", true), ("bare", false)] {
        let mut session = open(&bench, name, bundled.clone()).await;
        if resets {
            session.reset(0, None).await.unwrap();
        }
        session.step(still(), false).await.unwrap();
        session.follow(still(), plan(300_000)).await.unwrap();
        session.observe(vec![session.start()]).await.unwrap();
        session.take_snapshot("here".to_owned()).unwrap();
        session.follow(still(), plan(500_000)).await.unwrap();
        session.step(still(), false).await.unwrap();
        session.restore("here").await.unwrap();
        session.step(still(), false).await.unwrap();
        session.close(wildcity_session::Outcome::Completed).await;
        for number in [1, 2] {
            let path = bench.episodes.path().join(format!("{name}-{number}.jsonl"));
            let report = replay(&path, catalog);
            assert_eq!((report.diverged, &report.wrong_value), (None, &None), "{name}-{number}");
            assert_eq!(report.difference, None, "{name}-{number}");
            // The second file has the restored state and a step.
            let images = if number == 1 { 7 } else { 4 };
            assert!(report.images >= images, "{name}-{number}: {}", report.images);

            // Actors that were recorded elsewhere are seen.
            let text = std::fs::read_to_string(&path).unwrap();
            let mut lines: Vec<Value> =
                text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
            let placed = lines.iter_mut().filter(|line| line["kind"] == "actors");
            for actor in placed.flat_map(|line| line["actors"].as_array_mut().unwrap()) {
                actor[1][1] = json!(actor[1][1].as_f64().unwrap() + 0.5);
            }
            let moved: Vec<String> = lines.iter().map(Value::to_string).collect();
            std::fs::write(&path, moved.join("\n") + "\n").unwrap();
            assert!(replay(&path, catalog).difference.is_some(), "{name}-{number}");
        }
    }
}

pub(crate) fn replay(path: &std::path::Path, catalog: &Catalog) -> wildcity_session::ReplayReport {
    let recording = RecordedEpisode::read(path).unwrap();
    let cache = Cache::new(catalog.clone());
    let cpu = crate::images::cpu();
    recording.replay(&cache, &cpu, ReplayUntil::End, &mut |_| Ok(())).unwrap()
}

/// A record that names actors which its scenario does not have is refused, with the line.
#[tokio::test(flavor = "multi_thread")]
async fn a_record_with_actors_of_another_scenario_is_refused() {
    let (_, catalog) = straight();
    let actors = json!([{"name": "ahead", "path": {"along": "log", "station_m": 20, "speed": 7}}]);
    let mut options = options(&actors, false);
    options.twin = "straight".to_owned();
    options.start = Some(Start::Station { trajectory: "log".to_owned(), station_m: 6.0 });
    if let Some(ScenarioChoice::Object(file)) = &mut options.scenario {
        file["twin"]["name"] = "straight".into();
    }
    let bench = bench(Cache::new(catalog.clone()));
    let mut session = open(&bench, "a", options).await;
    session.reset(0, None).await.unwrap();
    session.close(wildcity_session::Outcome::Completed).await;
    let path = bench.episodes.path().join("a-1.jsonl");
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(RecordedEpisode::read(&path).is_ok());
    let lines: Vec<&str> = text.lines().collect();
    let at = lines.iter().position(|line| line.contains("\"kind\":\"actors\"")).unwrap();
    for (other, reason) in [
        (
            lines[at].replace("\"actors\":[[0,", "\"actors\":[[1,"),
            "actor 1, but the scenario has 1 actors",
        ),
        (
            json!({"kind": "event", "step": 0, "time_us": 0, "event": "appeared", "actor": 7})
                .to_string(),
            "actor 7, but",
        ),
    ] {
        assert_ne!(other, lines[at]);
        let mut changed = lines.clone();
        changed[at] = &other;
        std::fs::write(&path, changed.join("\n") + "\n").unwrap();
        match RecordedEpisode::read(&path) {
            Err(ReplayError::Line { line, reason: found, .. }) => {
                assert_eq!(line, at + 1);
                assert!(found.contains(reason), "{found}");
            }
            other => panic!("{other:?}"),
        }
    }
}

/// A cut-out car at its old place looks as it did within the twin.
#[test]
fn what_was_cut_out_and_put_back_looks_as_before() {
    let mut gaussians = Gaussians::with_capacity(1, 3_000);
    for i in 0..3_000 {
        let at = |k: usize| (i * k % 2_999) as f64 / 2_999.0;
        gaussians.means_m.push([40.0 * at(3109), 12.0 * at(571) - 6.0, 2.5 * at(7127)]);
        gaussians.quats_wxyz.push([1.0, at(13) as f32, at(17) as f32 - 0.5, at(19) as f32]);
        gaussians.ln_scales.push([-2.0, -2.4, -3.0]);
        gaussians.logit_opacities.push(1.0 + 2.0 * at(23) as f32);
        gaussians.sh.extend((0..12).map(|k| at(29 + k) as f32 - 0.5));
    }
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let new = NewVersion {
        storage: StorageOptions { record: RecordFormat::F32, levels: false },
        ..NewVersion::from_gaussians("street", &gaussians, Provenance::new("test".to_owned()))
    };
    let base = catalog.commit(new, &mut |_, _| {}).unwrap();
    let pose = Pose {
        position_m: DVec3::new(14.0, 1.0, 0.0),
        rotation: glam::DQuat::from_rotation_z(0.4),
    };
    let box_ = ActorBox { length_m: 5.0, width_m: 2.5, height_m: 2.0 };
    let cut = catalog.cut(&base, &pose, &box_).unwrap();
    assert!(cut.gaussians.len() >= 20, "{}", cut.gaussians.len());
    let description = AssetDescription {
        name: "cut".to_owned(),
        class: ActorClass::Vehicle,
        box_,
        provenance: Provenance::new("test".to_owned()),
    };
    let asset = ActorAsset::new(&cut.gaussians, description).unwrap();
    let stored = catalog.put_actor(&asset, RecordFormat::F32).unwrap();
    let asset = catalog.actor(&stored.hash).unwrap();

    let cache = Cache::new(catalog);
    let views = [(2.0, -3.0), (24.0, 4.0)].map(|(x, y)| {
        let from_m = DVec3::new(x, y, 1.5);
        let toward = (pose.position_m + DVec3::Z - from_m).normalize();
        view_along([320, 200], 240.0, from_m, toward, -DVec3::Z)
    });
    let profile = RenderProfile { tau_px: 0.0, ..RenderProfile::default() };
    let draw = |version: u64, placed: Vec<PlacedChunk>| {
        let resident = cache.open("street", Some(version)).unwrap();
        let mut scene = resident.scene(&eyes(&views), &profile).unwrap();
        scene.place(placed);
        render(&crate::images::cpu(), &scene, &profile, &views)
    };
    let put_back = PlacedChunk::at_rest(asset.levels[0].chunk.clone(), pose, 0);
    let before = draw(1, Vec::new());
    let after = draw(2, vec![put_back]);
    let without = draw(2, Vec::new());
    for ((before, after), without) in before.iter().zip(&after).zip(&without) {
        let db = psnr(&before.rgba, &after.rgba);
        assert!(db >= 70.0, "{db:.1} dB");
        assert!(psnr(&before.rgba, &without.rgba) < 40.0, "the cut must be seen");
    }
}
