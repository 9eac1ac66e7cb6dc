//! Each camera of a frame has levels of detail of its own, so that its image is the same alone and
//! among others: in a frame, in a batch of sessions, in a replay, and instead of a lost frame.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::Gaussians;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_session::{RecordedEpisode, ReplayUntil};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, NewVersion};

use crate::branches::assert_all_same;
use crate::replay::replay;
use crate::support::{Agent, Seen, TestServer, pose};

/// A server with the twin `wall`: small Gaussians of many colours, 20 to 60 m ahead of a drive of 9
/// m.
async fn server() -> TestServer {
    let backend = Cpu::new(1, Simd::Best).expect("a backend");
    let server = TestServer::configured(|config| config.backend = Arc::new(backend)).await;
    let count = 8000;
    let mut state = 1_u64;
    let mut unit = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 31)
    };
    let mut means_m = Vec::new();
    let mut sh = Vec::new();
    for _ in 0..count {
        means_m.push([20.0 + 40.0 * unit(), 20.0 * unit() - 10.0, 6.0 * unit()]);
        sh.extend([0; 3].map(|_| (3.0 * unit() - 1.5) as f32));
    }
    let gaussians = Gaussians {
        sh_degree: 0,
        means_m,
        quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; count],
        ln_scales: vec![[-1.8; 3]; count],
        logit_opacities: vec![1.0; count],
        sh,
        ..Gaussians::default()
    };
    let keyframe = |k: i64| Keyframe {
        time_us: 100_000 * k,
        world_from_rig: Pose { position_m: DVec3::X * k as f64, rotation: DQuat::IDENTITY },
    };
    let log = Trajectory { name: "log".to_owned(), keyframes: (0..10).map(keyframe).collect() };
    let new = NewVersion {
        trajectories: vec![log],
        ..NewVersion::from_gaussians("wall", &gaussians, Provenance::new("test".to_owned()))
    };
    let catalog = Catalog::open(server.twins.path()).expect("a directory");
    catalog.commit(new, &mut |_, _| {}).expect("a twin");
    server
}

/// A wide camera and one of twenty times its focal length, for which the levels are much finer.
fn rig(names: &[&str]) -> Value {
    let camera = |name: &&str| {
        let focal = if *name == "tele" { 400.0 } else { 20.0 };
        json!({
            "name": name, "width": 32, "height": 24, "fx": focal, "fy": focal, "cx": 16.0, "cy": 12.0,
            "camera_to_rig": { "xyz": [0.5, 0.0, 1.5], "q": [0.5, -0.5, 0.5, -0.5] },
        })
    };
    json!({ "name": "r", "cameras": names.iter().map(camera).collect::<Vec<_>>() })
}

async fn open(server: &TestServer, name: &str, cameras: &[&str], more: Value) -> Agent {
    let mut agent = server.agent().await;
    let mut fields = json!({
        "twin": "wall", "session": name, "rig": rig(cameras),
        "outputs": { "encoding": "raw", "frames": 3 },
    });
    fields.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    agent.open(fields).await;
    agent
}

async fn drive(agent: &mut Agent, from: u64, until: u64) -> Vec<Seen> {
    let mut seen = Vec::new();
    for step in from..=until {
        seen.push(agent.step(0.25 * step as f64).await);
    }
    seen
}

/// Hash of a camera's present image.
fn hash<'a>(seen: &'a Seen, camera: &str) -> &'a Value {
    let images = seen.meta["images"].as_array().unwrap();
    &images.iter().find(|image| image["camera"] == camera).unwrap()["hash"]
}

#[tokio::test]
async fn a_camera_has_the_same_image_alone_and_among_others() {
    let server = server().await;
    let mut both = open(&server, "both", &["wide", "tele"], json!({})).await;
    both.look(json!({ "type": "reset" })).await;
    let truth = drive(&mut both, 1, 6).await;
    let poses: Vec<Value> = (1..=6).map(|step| pose(0.25 * f64::from(step))).collect();
    for camera in ["wide", "tele"] {
        let mut alone = open(&server, camera, &[camera], json!({})).await;
        alone.look(json!({ "type": "reset" })).await;
        let seen = drive(&mut alone, 1, 6).await;
        for (alone, truth) in seen.iter().zip(&truth) {
            assert_eq!(hash(alone, camera), hash(truth, camera), "{camera}");
        }
        // Several frames of one answer, each with one camera.
        let observed = alone.look(json!({ "type": "observe", "poses": poses })).await;
        let images = observed.meta["images"].as_array().unwrap();
        let hashes: Vec<&Value> = images.iter().map(|image| &image["hash"]).collect();
        let wanted: Vec<&Value> = truth.iter().map(|seen| hash(seen, camera)).collect();
        assert_eq!(hashes, wanted, "{camera}");
    }

    // The levels differ, or this shows nothing: the wide camera does not draw what the other needs.
    let full = json!({ "profile": { "tau_px": 0 } });
    let mut full = open(&server, "full", &["wide"], full).await;
    full.look(json!({ "type": "reset" })).await;
    assert_ne!(hash(&full.step(0.25).await, "wide"), hash(&truth[0], "wide"));

    // Its record, rendered again without the other camera.
    both.ask(json!({ "type": "close" })).await;
    let path = server.episodes.path().join("both-1.jsonl");
    let backend = Cpu::new(1, Simd::Best).unwrap();
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    for camera in 0..2 {
        let mut recording = RecordedEpisode::read(&path).unwrap();
        for frame in &mut recording.frames {
            frame.images = frame.images.iter().skip(camera).step_by(2).cloned().collect();
            frame.cameras = vec![vec![camera]; frame.poses.len()];
        }
        let report = recording.replay(&cache, &backend, ReplayUntil::End, &mut |_| Ok(())).unwrap();
        assert_eq!((report.images, report.difference), (7, None), "camera {camera}");
    }
}

/// Sessions whose frames are rendered one after the other, or at once.
#[tokio::test]
async fn sessions_of_a_batch_do_not_change_each_others_images() {
    let server = server().await;
    let mut truth = open(&server, "truth", &["wide", "tele"], json!({})).await;
    truth.look(json!({ "type": "reset" })).await;
    let truth = drive(&mut truth, 1, 4).await;
    let mut agent = server.agent().await;
    for (name, cameras) in [("a", &["wide"][..]), ("b", &["tele"]), ("c", &["tele", "wide"])] {
        let outputs = json!({ "encoding": "raw" });
        let opened = json!({
            "twin": "wall", "session": name, "rig": rig(cameras), "outputs": outputs,
        });
        agent.open(opened).await;
    }
    for (step, truth) in (1..).zip(&truth) {
        let x_m = 0.25 * f64::from(step);
        let to = |session: &str| json!({ "session": session, "pose": pose(x_m) });
        let many = agent.step_many(json!([to("a"), to("b"), to("c")])).await;
        for ((_, seen), cameras) in
            many.seen.iter().zip([&["wide"][..], &["tele"], &["tele", "wide"]])
        {
            for camera in cameras {
                assert_eq!(hash(seen, camera), hash(truth, camera), "{camera} at step {step}");
            }
        }
    }
}

/// A branch of a record renders the frames of its bundles again, camera by camera.
#[tokio::test]
async fn a_record_is_continued_with_the_images_of_its_frames() {
    let server = server().await;
    let mut agent = open(&server, "original", &["wide", "tele"], json!({})).await;
    agent.look(json!({ "type": "reset" })).await;
    let original = drive(&mut agent, 1, 8).await;
    agent.ask(json!({ "type": "close" })).await;
    for done in [1, 4, 7] {
        let mut branch = server.agent().await;
        let from = json!({ "episode": "original-1", "step": done });
        let opened = branch.ask(json!({ "type": "branch", "from": from })).await;
        assert_eq!(opened["type"], "opened", "{opened}");
        assert_all_same(&drive(&mut branch, done + 1, 8).await, &original[done as usize..]);
    }
}

/// Where an earlier picture stands in for a lost frame, the other camera's images stay as they are
/// without the loss.
#[tokio::test]
async fn a_lost_frame_does_not_change_the_other_images() {
    let server = server().await;
    let mut plain = open(&server, "plain", &["wide", "tele"], json!({})).await;
    let mut truth = vec![plain.look(json!({ "type": "reset" })).await];
    truth.extend(drive(&mut plain, 1, 20).await);
    let tele = json!({ "drop": 0.5, "freeze": { "chance": 0.3, "for_us": 300_000 } });
    let sensors = json!({ "sensors": { "cameras": { "tele": tele } } });
    let mut sensed = open(&server, "sensed", &["wide", "tele"], sensors).await;
    let mut seen = vec![sensed.look(json!({ "type": "reset" })).await];
    seen.extend(drive(&mut sensed, 1, 20).await);
    let mut replaced = 0;
    for (one, true_one) in seen.iter().zip(&truth) {
        assert_eq!(hash(one, "wide"), hash(true_one, "wide"), "step {}", one.meta["step"]);
        let images = one.meta["images"].as_array().unwrap();
        let sensor = &images.iter().find(|image| image["camera"] == "tele").unwrap()["sensor"];
        let taken = sensor["taken_us"].as_u64().unwrap() as usize / 100_000;
        assert_eq!(hash(one, "tele"), hash(&truth[taken], "tele"), "the picture of its time");
        replaced += usize::from(sensor["taken_us"] != sensor["due_us"]);
    }
    assert!((5..16).contains(&replaced), "{replaced} of 21");

    // The scene itself, without sensors, is that of a session without them.
    let observe = json!({ "type": "observe", "poses": [pose(1.0)] });
    let looks = [sensed.look(observe.clone()).await, plain.look(observe).await];
    assert_eq!(looks[0].meta["images"], looks[1].meta["images"]);

    // Continued from its record, and replayed.
    sensed.ask(json!({ "type": "close" })).await;
    let path = server.episodes.path().join("sensed-1.jsonl");
    let report = replay(&server, &path, &Cpu::new(1, Simd::Best).unwrap()).unwrap();
    assert_eq!((report.difference, report.wrong_value, report.diverged), (None, None, None));
    let mut branch = server.agent().await;
    let from = json!({ "episode": "sensed-1", "step": 10 });
    let opened = branch.ask(json!({ "type": "branch", "from": from })).await;
    assert_eq!(opened["type"], "opened", "{opened}");
    assert_all_same(&drive(&mut branch, 11, 20).await, &seen[11..]);
}
