//! Sessions with actors: each frame shows them at their poses at its time, and nothing else
//! changes.

use std::sync::{Arc, OnceLock};

use glam::{DVec3, EulerRot};
use serde_json::{Value, json};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::actor::{
    ActorAsset, ActorViewpoint, AssetDescription, ContactShadow, PlacedChunk,
};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::{Shutter, ShutterDirection};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::rig::{Rig, RigCamera};
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat, SemanticClass};
use wildcity_session::options::{
    CameraSensor, Encoding, LateFrames, Open, Outputs, RigChoice, Sensors, Start,
};
use wildcity_session::{
    DType, Engine, Observation, Outcome, ScenarioError, Session, SessionError, StepOptions,
    TensorKind,
};
use wildcity_sim::ego::Action;
use wildcity_sim::{Command, Dynamics, DynamicsModel};
use wildcity_twin::residency::{Cache, FrameBytes};
use wildcity_twin::store::StoredActor;

use crate::actor_records::replay;
use crate::driving::{Bench, bench, bench_with};
use crate::streaming::{PROFILE, demo, eyes, unlimited, views};

/// Where the ego stands, along the street.
const EGO_M: f64 = 100.0;
/// Longest exposure of the rig with rolling shutters, in microseconds.
const EXPOSURES_US: [i64; 2] = [60_000, 30_000];

/// A coloured box of 400 Gaussians, 4 m long.
pub(crate) fn car_asset() -> ActorAsset {
    let mut gaussians = Gaussians::with_capacity(0, 400);
    for i in 0..400 {
        let at = |k: usize| (i * k % 397) as f64 / 397.0;
        gaussians.means_m.push([4.0 * at(31) - 2.0, 1.8 * at(57) - 0.9, 1.5 * at(71)]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([0.15_f32.ln(); 3]);
        gaussians.logit_opacities.push(4.0);
        gaussians.sh.extend([1.5, -1.2 + (i % 5) as f32 * 0.3, -1.5]);
    }
    let description = AssetDescription {
        name: "red-box".to_owned(),
        class: ActorClass::Vehicle,
        box_: ActorBox { length_m: 4.0, width_m: 1.8, height_m: 1.5 },
        provenance: Provenance::new("test".to_owned()),
    };
    ActorAsset::new(&gaussians, description).unwrap()
}

/// The car in the store of the demo street.
pub(crate) fn car() -> &'static StoredActor {
    static CAR: OnceLock<StoredActor> = OnceLock::new();
    CAR.get_or_init(|| demo().catalog().put_actor(&car_asset(), RecordFormat::F32).unwrap())
}

/// The cameras of the other tests.
fn rig(shutters: bool) -> Vec<RigCamera> {
    let named = ["front", "left"].into_iter().zip(EXPOSURES_US);
    let cameras = views(Pose::IDENTITY).into_iter().zip(named);
    let camera = |(view, (name, duration_us)): (View, (&str, i64))| RigCamera {
        shutter: shutters
            .then_some(Shutter { direction: ShutterDirection::TopToBottom, duration_us }),
        ..RigCamera::new(name, view.camera, view.world_from_camera)
    };
    cameras.map(camera).collect()
}

/// A point of the road at a distance ahead and to the left of the ego, in metres.
fn ahead(ahead_m: f64, left_m: f64) -> [f64; 3] {
    demo().at(EGO_M).transform_point(DVec3::new(ahead_m, left_m, 0.0)).to_array()
}

/// A car that drives away from the ego, and a car that stands next to it.
pub(crate) fn actors(asset: &Value) -> Value {
    json!([
        {"name": "away", "asset": asset, "path": {"points": [ahead(12.0, 0.5), ahead(80.0, 0.5)], "speed": 9}},
        {"name": "parked", "asset": asset, "stand": {"xyz": ahead(3.0, 6.0), "yaw_rad": 0.7}}
    ])
}

pub(crate) fn options(actors: &Value, shutters: bool) -> Open {
    let scenario = json!({
        "format": "wildcity.scenario/1", "name": "test", "twin": {"name": "demo"}, "actors": actors,
    });
    let options = serde_json::from_value(scenario).unwrap();
    Open {
        start: Some(Start::from(demo().at(EGO_M))),
        rig: Some(RigChoice::Full(Rig::new("pair", rig(shutters)).into())),
        scenario: Some(options),
        outputs: Outputs::colour(Encoding::Raw),
        ..Open::twin("demo")
    }
}

pub(crate) async fn open(bench: &Bench, name: &str, options: Open) -> Session {
    Session::open(bench.engine.clone(), name.to_owned(), options).await.unwrap()
}

fn hashes(frame: &Observation) -> Vec<blake3::Hash> {
    frame.images.iter().map(|image| image.hash).collect()
}

/// The hashes of an episode in which the ego stands: of the start and of some steps.
async fn standing(session: &mut Session, steps: u32) -> Vec<Vec<blake3::Hash>> {
    let mut seen = vec![hashes(&session.reset(0, None).await.unwrap())];
    for _ in 0..steps {
        seen.push(hashes(&session.step(demo().at(EGO_M), false).await.unwrap()));
    }
    seen
}

/// Expected images of an ego at rest, each rendered by itself, with actors at their poses now and
/// at the start of each camera's exposure.
fn expected(placed: &[(u16, Pose, [Pose; 2])], shutters: bool) -> Vec<blake3::Hash> {
    let views = View::from_rig(&rig(shutters), demo().at(EGO_M));
    let resident = unlimited().open("demo", None).unwrap();
    let asset = demo().catalog().actor(&car().hash).unwrap();
    let image = |(index, view): (usize, &View)| {
        let eye = eyes(&[*view])[0];
        let seen = ActorViewpoint { position_m: eye.position_m, focal_px: eye.focal_px };
        let place = |&(actor, now, at_start): &(u16, Pose, [Pose; 2])| {
            let chunk = asset.level(&now, &seen, PROFILE.tau_px, PROFILE.reach_m).unwrap();
            PlacedChunk {
                world_from_actor_at_start: at_start[index],
                shadow: Some(ContactShadow { length_m: 4.0, width_m: 1.8 }),
                ..PlacedChunk::at_rest(chunk.clone(), now, actor)
            }
        };
        let mut scene = resident.scene(&[eye], &PROFILE).unwrap();
        scene.place(placed.iter().map(place).collect());
        let mut rgb8 = vec![0; 3 * view.camera.pixels()];
        let target = Target { rgb8: Some(&mut rgb8), ..Target::default() };
        let frame = Frame { scene: &scene, profile: &PROFILE, views: &[*view] };
        crate::images::cpu().render(&frame, &mut [target], &|_, _| {}).unwrap();
        blake3::hash(&rgb8)
    };
    views.iter().enumerate().map(image).collect()
}

fn poses(session: &Session) -> Vec<Pose> {
    let states = session.traffic().unwrap().states();
    states.iter().filter(|state| state.present).map(|state| state.world_from_actor).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn every_frame_draws_the_actors_of_its_time() {
    let bench = bench(unlimited());
    let asset = Value::from(&*car().hash);
    for shutters in [false, true] {
        let mut session = open(&bench, "a", options(&actors(&asset), shutters)).await;
        let first = hashes(&session.reset(0, None).await.unwrap());
        let mut before = poses(&session);
        assert_eq!(
            first,
            expected(&[(0, before[0], [before[0]; 2]), (1, before[1], [before[1]; 2])], shutters)
        );
        for step in 1..=3 {
            let seen = hashes(&session.step(demo().at(EGO_M), false).await.unwrap());
            let now = poses(&session);
            assert!((now[0].position_m.distance(before[0].position_m) - 0.9).abs() < 1e-6);
            // 60 and 30 of the step's 100 ms before its end.
            let at_start = EXPOSURES_US.map(|exposure_us| {
                let since = (100_000 - exposure_us) as f64 / 100_000.0;
                if shutters { before[0].interpolate(&now[0], since) } else { now[0] }
            });
            let drawn = [(0, now[0], at_start), (1, now[1], [now[1]; 2])];
            assert_eq!(seen, expected(&drawn, shutters), "step {step}, shutters {shutters}");
            if shutters {
                let at_rest = [(0, now[0], [now[0]; 2]), (1, now[1], [now[1]; 2])];
                assert_ne!(seen, expected(&at_rest, shutters), "the shutter must be seen");
            }
            before = now;
        }
    }
}

/// A camera whose frames all arrive 0.3 s late shows the image of that time, including the actors.
#[tokio::test(flavor = "multi_thread")]
async fn a_late_frame_shows_the_actors_of_when_it_was_taken() {
    let bench = bench(unlimited());
    let asset = Value::from(&*car().hash);
    for shutters in [false, true] {
        let mut punctual = open(&bench, "a", options(&actors(&asset), shutters)).await;
        let truth = standing(&mut punctual, 6).await;
        let late = CameraSensor {
            late: Some(LateFrames { chance: 1.0, by_us: 300_000 }),
            ..CameraSensor::default()
        };
        let cameras = [("front".to_owned(), late)].into();
        let sensors = Some(Sensors { cameras, ..Sensors::default() });
        let opening = Open { sensors, ..options(&actors(&asset), shutters) };
        let name = format!("late-{shutters}");
        let mut session = open(&bench, &name, opening).await;
        let mut seen = standing(&mut session, 2).await;
        session.take_snapshot("two".to_owned()).unwrap();
        for _ in 0..4 {
            seen.push(hashes(&session.step(demo().at(EGO_M), false).await.unwrap()));
        }
        for (step, images) in seen.iter().enumerate() {
            assert_eq!(images[0], truth[step.saturating_sub(3)][0], "step {step}");
            assert_eq!(images[1], truth[step][1], "step {step}");
        }
        assert_ne!(truth[2][0], truth[5][0], "the car must be seen to move");

        // The images are the same from a snapshot, and in a replay of both records.
        assert_eq!(hashes(&session.restore("two").await.unwrap()), seen[2]);
        for (step, before) in seen.iter().enumerate().skip(3) {
            let again = hashes(&session.step(demo().at(EGO_M), false).await.unwrap());
            assert_eq!(&again, before, "step {step}");
        }
        session.close(Outcome::Completed).await;
        for number in [1, 2] {
            let path = bench.episodes.path().join(format!("{name}-{number}.jsonl"));
            let report = replay(&path, &demo().catalog());
            assert_eq!((report.difference, report.wrong_value), (None, None), "{}", path.display());
            assert_eq!(report.images, if number == 1 { 14 } else { 10 });
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_asset_may_be_named_and_one_that_is_missing_is_refused() {
    let bench = bench(unlimited());
    car();
    let mut named = open(&bench, "a", options(&actors(&"red-box".into()), false)).await;
    let mut hashed = open(&bench, "b", options(&actors(&Value::from(&*car().hash)), false)).await;
    let hash = |session: &Session| session.traffic().unwrap().loaded().hash.clone();
    assert_eq!(hash(&named), hash(&hashed));
    assert_eq!(standing(&mut named, 1).await, standing(&mut hashed, 1).await);
    for missing in ["blue-box", &"0".repeat(64)] {
        let opened = Session::open(
            bench.engine.clone(),
            "c".to_owned(),
            options(&actors(&Value::from(missing)), false),
        );
        let Err(SessionError::Scenario(error)) = opened.await else {
            panic!("{missing} was opened")
        };
        assert!(matches!(error, ScenarioError::File { .. }), "{error}");
        assert_eq!(error.field(), "scenario.actors[0].asset");
        assert!(error.to_string().contains("wildcity actor list"), "{error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn without_actors_nothing_changes() {
    let bench = bench(unlimited());
    let bare = Open { scenario: None, ..options(&json!([]), true) };
    let wanted = standing(&mut open(&bench, "bare", bare).await, 2).await;
    let none = options(&json!([]), true);
    assert_eq!(standing(&mut open(&bench, "none", none).await, 2).await, wanted);
    // Actors without an image move and are reported, but are not drawn.
    let boxes = options(&actors(&"none".into()), true);
    assert_eq!(standing(&mut open(&bench, "boxes", boxes).await, 2).await, wanted);
    // An actor that names no asset gets the generated one of its class whose size is the nearest.
    let unnamed = options(&actors(&Value::Null), true);
    let mut unnamed = open(&bench, "unnamed", unnamed).await;
    assert_ne!(standing(&mut unnamed, 2).await, wanted);
    let named = |name: &str| demo().catalog().find_actor(name).unwrap().hash;
    let specs = unnamed.traffic().unwrap().specs();
    assert!(specs.iter().all(|actor| actor.asset == Some(named("sedan"))), "{specs:?}");
    let drawn = options(&actors(&Value::from(&*car().hash)), true);
    assert_ne!(standing(&mut open(&bench, "drawn", drawn).await, 2).await, wanted);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_default_asset_has_the_class_and_about_the_size_of_its_actor() {
    let bench = bench(unlimited());
    let actor = |name: &str, class: &str, size: [f64; 3], y_m: f64| json!({"name": name, "class": class, "size": size, "stand": {"xyz": [20, y_m, 0], "yaw_rad": 0}});
    let all = json!([
        actor("bus", "vehicle", [11.0, 2.5, 3.0], 10.0),
        actor("truck", "vehicle", [8.0, 2.4, 3.3], 20.0),
        actor("small", "vehicle", [3.9, 1.7, 1.5], 30.0),
        actor("pedestrian", "pedestrian", [0.6, 0.6, 1.6], 40.0),
        actor("bicycle", "bicycle", [1.7, 0.6, 1.7], 50.0),
        actor("crate", "object", [0.5, 0.5, 0.8], 60.0),
        json!({"name": "sedan", "stand": {"xyz": [20, 70, 0], "yaw_rad": 0}}),
    ]);
    let mut session = open(&bench, "all", options(&all, true)).await;
    // A reset takes the assets of the first episode. Boxes stay as they are, also that of an actor
    // without a size.
    let before = session.traffic().unwrap().specs().to_vec();
    session.reset(1, None).await.unwrap();
    assert_eq!(session.traffic().unwrap().specs(), before);
    for actor in session.traffic().unwrap().specs() {
        let asset = demo().catalog().find_actor(actor.asset.as_ref().unwrap()).unwrap();
        let wanted = if actor.name == "small" { "hatchback" } else { &actor.name };
        assert_eq!(asset.description.name, wanted);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_removed_actor_leaves_no_trace() {
    let bench = bench(unlimited());
    let asset = Value::from(&*car().hash);
    let mut removed = actors(&asset);
    removed[0]["script"] = json!([{"when": {"time_s": 0.15}, "do": [{"remove": {}}]}]);
    let mut never = actors(&asset);
    never.as_array_mut().unwrap().remove(0);
    // With bundles, the frames from before the removal still show it.
    let bundled = |actors: &Value| {
        let mut options = options(actors, true);
        options.outputs.frames = Some(3);
        options
    };
    let mut with = open(&bench, "with", bundled(&removed)).await;
    let mut without = open(&bench, "without", bundled(&never)).await;
    with.reset(0, None).await.unwrap();
    without.reset(0, None).await.unwrap();
    let mut shown: Vec<Vec<blake3::Hash>> = Vec::new();
    for step in 1..=5_usize {
        let pose = demo().at(EGO_M);
        let [seen, bare] =
            [with.step(pose, false).await.unwrap(), without.step(pose, false).await.unwrap()];
        // Of whole observations only pixels differ.
        assert_eq!(hashes(&seen) == hashes(&bare), step >= 2, "step {step}");
        let is_gone = step >= 4;
        assert_eq!(seen.buffer.bytes() == bare.buffer.bytes(), is_gone, "step {step}");
        // The earlier frames of the front camera are those that were shown then.
        for past in seen.history.iter().filter(|past| past.camera == 0 && step > past.back) {
            assert_eq!(past.hash, shown[step - 1 - past.back][0], "step {step}, {}", past.back);
        }
        shown.push(hashes(&seen));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn actors_are_the_same_on_any_number_of_threads_and_beside_others() {
    let asset = Value::from(&*car().hash);
    let mut all = Vec::new();
    for threads in [1, 2] {
        let cpu = Cpu::new(threads, Simd::Best).unwrap();
        let bench = bench_with(unlimited(), Arc::new(cpu));
        let mut session = open(&bench, "a", options(&actors(&asset), true)).await;
        let mut other = open(&bench, "b", options(&actors(&asset), true)).await;
        if threads == 2 {
            let busy = tokio::spawn(async move { standing(&mut other, 4).await });
            all.push(standing(&mut session, 4).await);
            all.push(busy.await.unwrap());
        } else {
            all.push(standing(&mut session, 4).await);
        }
    }
    assert_eq!(all[0], all[1]);
    assert_eq!(all[0], all[2]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restored_snapshot_draws_the_actors_of_its_time() {
    let bench = bench(unlimited());
    let mut session = open(&bench, "a", options(&actors(&Value::from(&*car().hash)), true)).await;
    let pose = demo().at(EGO_M);
    session.reset(0, None).await.unwrap();
    session.step(pose, false).await.unwrap();
    let there = hashes(&session.step(pose, false).await.unwrap());
    session.take_snapshot("there".to_owned()).unwrap();
    let next = hashes(&session.step(pose, false).await.unwrap());
    session.step(pose, false).await.unwrap();
    assert_eq!(hashes(&session.restore("there").await.unwrap()), there);
    assert_eq!(hashes(&session.observe(vec![pose]).await.unwrap()), there);
    assert_eq!(hashes(&session.step(pose, false).await.unwrap()), next);
    let snapshot = session.snapshots().find("name", "there").unwrap();
    let mut branch =
        Session::branch(bench.engine.clone(), "b".to_owned(), &snapshot).await.unwrap();
    assert_eq!(hashes(&branch.step(pose, false).await.unwrap()), next);
}

/// A plan of several steps shows frames of times within it, a warm-up those of before the start.
#[tokio::test(flavor = "multi_thread")]
async fn plans_and_warm_ups_draw_the_actors_of_each_frame() {
    let bench = bench(unlimited());
    let asset = Value::from(&*car().hash);
    let mut bundled = options(&actors(&asset), true);
    bundled.outputs.frames = Some(4);
    let kinematic = Dynamics { model: DynamicsModel::Kinematic, ..Dynamics::default() };
    bundled.dynamics = Some(kinematic.into());
    let mut slow = open(&bench, "slow", bundled.clone()).await;
    let mut fast = open(&bench, "fast", bundled).await;
    slow.reset(0, None).await.unwrap();
    fast.reset(0, None).await.unwrap();
    let still = Command::Action(Action { acceleration_m_s2: 0.0, curvature_1_m: 0.0 });
    let mut last = None;
    for _ in 0..4 {
        last = Some(slow.step(still.clone(), false).await.unwrap());
    }
    let until = StepOptions { until_us: Some(400_000), ..StepOptions::default() };
    let planned = fast.follow(still, until).await.unwrap();
    let last = last.unwrap();
    assert_eq!(hashes(&planned), hashes(&last));
    let history = |seen: &Observation| -> Vec<_> {
        seen.history.iter().map(|past| (past.camera, past.time_us, past.hash)).collect()
    };
    assert_eq!(history(&planned), history(&last));
    assert_eq!(history(&last).len(), 6);
}

/// The ids of pixels are those of the scenario's actors, whichever actors are present.
#[tokio::test(flavor = "multi_thread")]
async fn instances_tell_whose_pixels_they_are() {
    let bench = bench(unlimited());
    let mut asked = options(&actors(&Value::from(&*car().hash)), false);
    asked.outputs.instances = Some(true);
    let mut session = open(&bench, "a", asked.clone()).await;
    let seen = session.reset(0, None).await.unwrap();
    let ids = |seen: &Observation| -> Vec<u16> {
        let tensor = seen
            .tensors
            .iter()
            .find(|tensor| tensor.kind == TensorKind::Instances(0))
            .expect("the tensor of the front camera");
        assert_eq!((tensor.dtype, &*tensor.shape), (DType::U16, &[64, 96][..]));
        let header = seen.buffer.bytes().len() - seen.tensors.last().unwrap().bytes.end;
        let bytes = &seen.buffer.bytes()[header..][tensor.bytes.clone()];
        bytes.chunks_exact(2).map(|two| u16::from_le_bytes([two[0], two[1]])).collect()
    };
    let count = |seen: &[u16], id: u16| seen.iter().filter(|one| **one == id).count();
    let first = ids(&seen);
    assert!(count(&first, 2) > 20, "the car ahead: {}", count(&first, 2));
    assert!(count(&first, 1) > 1000 && first.iter().all(|id| *id <= 3));
    // The colours do not depend on it.
    asked.outputs.instances = None;
    let mut plain = open(&bench, "b", asked).await;
    assert_eq!(hashes(&plain.reset(0, None).await.unwrap()), hashes(&seen));
}

/// Classes have the boundaries of instances on the actors, pixel by pixel, and the twin has its
/// own.
#[tokio::test(flavor = "multi_thread")]
async fn classes_are_those_of_the_actors_and_of_the_twin() {
    let bench = bench(unlimited());
    let mut asked = options(&actors(&Value::from(&*car().hash)), false);
    asked.outputs.instances = Some(true);
    asked.outputs.semantics = Some(true);
    let mut session = open(&bench, "a", asked.clone()).await;
    let seen = session.reset(0, None).await.unwrap();
    let bytes = |kind: TensorKind| {
        let tensor = seen.tensors.iter().find(|tensor| tensor.kind == kind).unwrap();
        assert_eq!(tensor.shape, [64, 96]);
        let header = seen.buffer.bytes().len() - seen.tensors.last().unwrap().bytes.end;
        (tensor.dtype, &seen.buffer.bytes()[header..][tensor.bytes.clone()])
    };
    let (dtype, classes) = bytes(TensorKind::Semantics(0));
    assert_eq!(dtype, DType::U8);
    let ids = bytes(TensorKind::Instances(0)).1.chunks_exact(2);
    let ids: Vec<u16> = ids.map(|two| u16::from_le_bytes([two[0], two[1]])).collect();
    let vehicle = SemanticClass::Vehicle.value();
    for (id, class) in ids.iter().zip(classes) {
        // The street has cars, and vehicles of unknown kind are only among the actors.
        assert_eq!(*id >= 2, *class == vehicle, "{id}, {class}");
        assert_eq!(*id == 0, *class == SemanticClass::None.value(), "{id}, {class}");
    }
    assert!(classes.iter().filter(|class| **class == vehicle).count() > 20);
    for class in [SemanticClass::Road, SemanticClass::Building, SemanticClass::Car] {
        assert!(classes.iter().filter(|one| **one == class.value()).count() > 20, "{class}");
    }
    assert!(!classes.contains(&SemanticClass::Unlabelled.value()));
    // Neither the colours nor the instances depend on it.
    asked.outputs.semantics = None;
    let mut plain = open(&bench, "b", asked).await;
    let plain = plain.reset(0, None).await.unwrap();
    assert_eq!(hashes(&plain), hashes(&seen));
    assert!(plain.tensors.iter().all(|tensor| tensor.kind != TensorKind::Semantics(0)));
}

/// Assets take their room from the twins, once for all sessions, and give it back.
#[tokio::test(flavor = "multi_thread")]
async fn assets_count_against_the_memory_of_twins() {
    let bytes = demo().catalog().actor(&car().hash).unwrap().bytes();
    let bench_ = bench(unlimited());
    let stats = |engine: &Arc<Engine>| engine.residency();
    let options = options(&actors(&Value::from(&*car().hash)), false);
    let bare = Open { scenario: None, ..options.clone() };
    let first = open(&bench_, "bare", bare).await;
    let reserved_bytes = stats(&bench_.engine).reserved_bytes;
    let second = open(&bench_, "a", options.clone()).await;
    let third = open(&bench_, "b", options.clone()).await;
    let with = stats(&bench_.engine).reserved_bytes;
    let scene_bytes = first.reservation().scene_bytes();
    let FrameBytes { stages, images, .. } = first.reservation().frame();
    let whole = first.resident().total_bytes();
    assert_eq!(reserved_bytes, scene_bytes.min(whole) + stages + images);
    let sessions = (3 * scene_bytes).min(whole) + stages + 3 * images;
    assert_eq!(with, sessions + bytes, "one copy for two sessions of two actors");
    drop((second, third));
    assert_eq!(stats(&bench_.engine).reserved_bytes, reserved_bytes);

    // Without room for it, the scenario does not open.
    let limit_bytes = first.reserved_bytes() + bytes - 1;
    let small = bench(Cache::limited(demo().catalog(), Some(limit_bytes)));
    let _held = open(&small, "held", Open { scenario: None, ..options.clone() }).await;
    let opened = Session::open(small.engine.clone(), "a".to_owned(), options).await;
    let error = opened.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(error.contains("red-box") && error.contains("--memory-gib"), "{error}");
}

/// The reference of these tests places the given actors.
#[test]
fn the_tests_see_the_car() {
    let at = |yaw_rad: f64, x_m: f64| Pose {
        position_m: DVec3::from_array(ahead(x_m, 0.5)),
        rotation: glam::DQuat::from_euler(EulerRot::ZYX, yaw_rad, 0.0, 0.0),
    };
    let seen = |pose: Pose| expected(&[(0, pose, [pose; 2])], false);
    assert_ne!(seen(at(0.0, 12.0)), expected(&[], false));
    assert_ne!(seen(at(0.0, 12.0)), seen(at(0.0, 12.1)));
    assert_ne!(seen(at(0.0, 12.0)), seen(at(0.1, 12.0)));
}
