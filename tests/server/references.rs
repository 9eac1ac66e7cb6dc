//! References of a session's views, end to end: a wall whose image is known, a model that returns
//! the references in the view, and the pure warp.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use glam::{DQuat, DVec2, DVec3};
use serde_json::{Value, json};
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};
use wildcity_repair::reference::{Projection, Rays, Reference, WarpTarget, warp};
use wildcity_repair::{Image, LoadOptions, Models};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::views::RecordedView;
use wildcity_session::{RecordedEpisode, ReplayUntil};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, CommitKind, StorageOptions, VersionChange};

use crate::onnx_doubles as doubles;
use crate::onnx_models::{Folder, library};
use crate::repair::{beside, opening, pixels, statuses, step};
use crate::support::{Agent, TestServer, refused};

/// Draws a wall that crosses the road, 16 m ahead of the world's origin. Its image is correct on
/// the drive, and redder off the trajectory, like that of a twin that was not trained there.
#[derive(Debug, Default)]
pub(crate) struct Wall {
    views: AtomicU64,
}

const WALL_M: f64 = 16.0;

impl Wall {
    fn colour(point_m: DVec3) -> [u8; 3] {
        let level = |value: f64| (100.0 + value).round().clamp(0.0, 255.0) as u8;
        [level(8.0 * point_m.y), level(11.0 * point_m.z), 60]
    }

    fn picture(view: &View) -> (Image, Vec<f32>) {
        let width = view.camera.width_px as usize;
        let height = view.camera.height_px as usize;
        let mut rgb8 = Vec::new();
        let mut depth_m = Vec::new();
        let pose = view.world_from_camera;
        for at in 0..width * height {
            let at_px = DVec2::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5);
            let ray = pose.rotation * view.camera.unproject(at_px).unwrap();
            let point_m = pose.position_m + ray * ((WALL_M - pose.position_m.x) / ray.x);
            if ray.x < 0.1 {
                rgb8.extend([0; 3]);
                depth_m.push(0.0);
                continue;
            }
            let [red, green, blue] = Self::colour(point_m);
            let error = if pose.position_m.y.abs() > 0.5 { 40 } else { 0 };
            rgb8.extend([red.saturating_add(error), green, blue]);
            let point = pose.inverse().transform_point(point_m);
            depth_m.push(view.camera.depth_m(point) as f32);
        }
        (Image { width, height, rgb8 }, depth_m)
    }
}

impl Backend for Wall {
    fn name(&self) -> &'static str {
        "wall"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        for (k, (view, target)) in frame.views.iter().zip(targets).enumerate() {
            self.views.fetch_add(1, Ordering::SeqCst);
            let (image, depth_m) = Self::picture(view);
            if let Some(rgb8) = target.rgb8.as_deref_mut() {
                rgb8.copy_from_slice(&image.rgb8);
            }
            if let Some(opacity) = target.opacity.as_deref_mut() {
                let seen = opacity.iter_mut().zip(&depth_m);
                seen.for_each(|(opacity, depth_m)| *opacity = f32::from(u8::from(*depth_m > 0.0)));
            }
            if let Some(target) = target.depth_m.as_deref_mut() {
                target.copy_from_slice(&depth_m);
            }
            finished(k, target);
        }
        Ok(FrameStats::default())
    }
}

/// A model that returns the references where they are valid, and else the image.
fn warped_model() -> Folder {
    let input = |name: &str, role: &str| json!({"name": name, "role": role});
    let inputs = json!([
        input("image", "rgb"),
        input("warped", "reference_warped"),
        input("valid", "reference_valid")
    ]);
    let changes = json!({"name": "warped", "timeout_ms": 10_000, "inputs": inputs});
    Folder::new(&doubles::warped_where_valid(), changes)
}

async fn server(folders: &[&Folder]) -> (TestServer, Arc<Wall>) {
    let paths: Vec<_> = folders.iter().map(|folder| folder.path()).collect();
    let models = Arc::new(Models::read(&paths, LoadOptions::new(library())).unwrap());
    let wall = Arc::new(Wall::default());
    let backend = wall.clone();
    let server = TestServer::configured(|config| {
        config.backend = backend;
        config.repairs = models;
    });
    (server.await, wall)
}

/// A camera of `opening`, and its pose on the rig.
fn camera(width_px: u32) -> (Camera, Pose) {
    let pinhole = Pinhole { fx: 20.0, fy: 20.0, cx: 12.0, cy: 12.0 };
    let rotation = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
    let rig_from_camera = Pose { position_m: DVec3::new(0.5, 0.0, 1.5), rotation };
    (Camera::from_pinhole(width_px, 16, pinhole), rig_from_camera)
}

fn view_at(width_px: u32, x_m: f64, y_m: f64) -> View {
    let (camera, rig_from_camera) = camera(width_px);
    let world_from_rig = Pose { position_m: DVec3::new(x_m, y_m, 0.0), ..Pose::IDENTITY };
    View::new(camera, world_from_rig * rig_from_camera)
}

/// Expected output of the model for a camera off the drive: references at 0, 2 and 4 m, of both
/// cameras.
fn expected(width_px: u32, y_m: f64, paint: Option<[u8; 3]>, stations: &[f64]) -> Vec<u8> {
    expected_images(width_px, y_m, paint, stations, false)
}

/// As [`expected`]; if `masked`, without the left halves of the references.
fn expected_images(
    width_px: u32,
    y_m: f64,
    paint: Option<[u8; 3]>,
    stations: &[f64],
    masked: bool,
) -> Vec<u8> {
    let view = view_at(width_px, 3.0, y_m);
    let (rendered, depth_m) = Wall::picture(&view);
    let mut references = Vec::new();
    for station_m in stations {
        for width_px in [24, 20] {
            let view = view_at(width_px, *station_m, 0.0);
            let (mut image, mut depth_m) = Wall::picture(&view);
            let is_left = |pixel: usize| pixel % (width_px as usize) < width_px as usize / 2;
            depth_m
                .iter_mut()
                .enumerate()
                .filter(|(pixel, _)| masked && is_left(*pixel))
                .for_each(|(_, depth_m)| *depth_m = 0.0);
            if let Some(paint) = paint {
                image.rgb8 = paint.repeat(depth_m.len());
            }
            let projection = Arc::new(Projection::from_camera(&view.camera));
            let world_from_camera = view.world_from_camera;
            references.push(Arc::new(Reference { image, depth_m, projection, world_from_camera }));
        }
    }
    let target = WarpTarget {
        camera: &view.camera,
        rays: &Rays::from_camera(&view.camera),
        world_from_camera: view.world_from_camera,
        shutter: None,
        depth_m: &depth_m,
    };
    let warped = warp(&target, &references);
    let valid = warped.valid.iter().flat_map(|valid| [*valid > 0.0; 3]);
    let seen = warped.image.rgb8.iter().zip(&rendered.rgb8).zip(valid);
    seen.map(|((warped, rendered), valid)| if valid { *warped } else { *rendered }).collect()
}

async fn open(agent: &mut Agent, name: &str, model: &str) -> Value {
    agent.open(opening(name, json!({"model": model, "at_least": 0.05}))).await
}

#[tokio::test]
async fn a_twin_without_recorded_images_is_drawn_on_its_drive() {
    let folder = warped_model();
    let (server, wall) = server(&[&folder]).await;
    let mut agent = server.agent().await;
    let opened = open(&mut agent, "a", "warped").await;
    assert_eq!(opened["repair"]["references"], "rendered");

    // On the drive only the two images are rendered.
    let before = wall.views.load(Ordering::SeqCst);
    assert_eq!(statuses(&step(&mut agent, 0.0).await), ["kept"; 2]);
    assert_eq!(wall.views.load(Ordering::SeqCst) - before, 2);

    let seen = step(&mut agent, 2.0).await;
    assert_eq!(statuses(&seen), ["repaired"; 2]);
    for (index, (camera, width_px)) in [("left", 24), ("right", 20)].into_iter().enumerate() {
        let wanted = expected(width_px, 2.0, None, &[0.0, 2.0, 4.0]);
        assert_eq!(pixels(&seen, camera), wanted, "{camera}");
        // Most pixels have the real colour of the wall, and not the rendered one.
        let (rendered, _) = Wall::picture(&view_at(width_px, 3.0, 2.0));
        let changed = wanted.chunks(3).zip(rendered.rgb8.chunks(3)).filter(|(a, b)| a != b).count();
        assert!(changed > wanted.len() / 3 / 2, "{changed}");
        let names = seen.meta["images"][index]["repair"]["references"].as_array().unwrap();
        assert!(!names.is_empty() && names.len() <= 6, "{names:?}");
        let stations = ["log@0.00/", "log@2.00/", "log@4.00/"];
        let is_known =
            |name: &&Value| stations.iter().any(|s| name.as_str().unwrap().starts_with(s));
        assert!(names.iter().all(|name| is_known(&name)), "{names:?}");
    }
    // Two images and six references; at the same place again they are in memory.
    let drawn = wall.views.load(Ordering::SeqCst) - before;
    assert_eq!(drawn, 2 + 2 + 6);
    let again = step(&mut agent, 2.0).await;
    assert_eq!(pixels(&again, "left"), pixels(&seen, "left"));
    assert_eq!(wall.views.load(Ordering::SeqCst) - before, drawn + 2);

    agent.ask(json!({"type": "close"})).await;
    replayed(&server, &folder, "a-1", 4);
}

/// Replays an episode and repairs again; `repaired` images are compared.
fn replayed(server: &TestServer, folder: &Folder, episode: &str, repaired: u64) {
    let path = server.episodes.path().join(format!("{episode}.jsonl"));
    let recording = RecordedEpisode::read(&path).unwrap();
    let cache = Cache::new(Catalog::open(server.twins.path()).unwrap());
    let models = Models::read(&[folder.path()], LoadOptions::new(library())).unwrap();
    let report = recording
        .replay_repaired(&cache, &Wall::default(), &models, ReplayUntil::End, &mut |_| Ok(()))
        .unwrap();
    assert_eq!((&report.difference, &report.wrong_value), (&None, &None), "{episode}");
    assert_eq!((report.repaired.compared, report.repaired.not_compared), (repaired, 0));
}

/// Commits a version of the twin with uniformly painted images of both cameras at some stations.
fn add_views(server: &TestServer, paint: [u8; 3], stations: &[f64], names: [&str; 2]) {
    add_exposed_views(server, paint, stations, names, None);
}

/// The same; with an exposure in stops, and a mask of their left halves, if there is one.
fn add_exposed_views(
    server: &TestServer,
    paint: [u8; 3],
    stations: &[f64],
    names: [&str; 2],
    exposure_stops: Option<f64>,
) {
    let catalog = Catalog::open(server.twins.path()).unwrap();
    let base = catalog.version("test", None).unwrap();
    let storage = StorageOptions { record: base.manifest.record, ..StorageOptions::default() };
    let mut commit = catalog.begin("test", CommitKind::Import, storage).unwrap();
    let mut views = Vec::new();
    for station_m in stations {
        for (name, width_px) in names.into_iter().zip([24, 20]) {
            let view = view_at(width_px, *station_m, 0.0);
            let rgb8 = paint.repeat(view.camera.pixels());
            let png = wildcity_session::png(&rgb8, width_px, 16).unwrap();
            views.push(RecordedView {
                trajectory: "log".to_owned(),
                station_m: *station_m,
                camera_name: name.to_owned(),
                camera: view.camera,
                world_from_camera: view.world_from_camera,
                exposure_stops,
                image: commit.put_image(&png).unwrap(),
                mask: exposure_stops.map(|_| {
                    let white =
                        |at: u32| if at % width_px < width_px / 2 { [0; 3] } else { [255; 3] };
                    let mask: Vec<u8> = (0..16 * width_px).flat_map(white).collect();
                    commit.put_image(&wildcity_session::png(&mask, width_px, 16).unwrap()).unwrap()
                }),
            });
        }
    }
    let views = commit.put_views(&views).unwrap();
    commit.set_views(Some(views));
    let change = VersionChange::edit();
    commit.change(base.number, change).unwrap();
}

#[tokio::test]
async fn recorded_images_are_warped_and_replayed() {
    let folder = warped_model();
    let (server, wall) = server(&[&folder]).await;
    add_views(&server, [200, 10, 90], &[2.5], ["left", "right"]);
    let mut agent = server.agent().await;
    let opened = open(&mut agent, "a", "warped").await;
    assert_eq!(opened["repair"]["references"], "recorded");
    let before = wall.views.load(Ordering::SeqCst);
    let seen = step(&mut agent, 2.0).await;
    // 2.5 m is within 1.5 m of the place 0.5 m behind the rig, and of no other.
    let wanted = expected(24, 2.0, Some([200, 10, 90]), &[2.5]);
    assert_eq!(pixels(&seen, "left"), wanted);
    assert!(wanted.chunks(3).filter(|pixel| *pixel == [200, 10, 90]).count() > 150);
    let names = &seen.meta["images"][0]["repair"]["references"];
    assert_eq!(names[0].as_str().unwrap().split('/').next(), Some("log@2.50"), "{names}");
    // Two images, and the depth of two references.
    assert_eq!(wall.views.load(Ordering::SeqCst) - before, 4);
    agent.ask(json!({"type": "close"})).await;
    replayed(&server, &folder, "a-1", 2);
}

#[tokio::test]
async fn masked_pixels_are_not_brought_and_exposures_are_taken_back() {
    let folder = warped_model();
    let (server, _) = server(&[&folder]).await;
    add_exposed_views(&server, [200, 10, 90], &[2.5], ["left", "right"], Some(1.0));
    let mut agent = server.agent().await;
    open(&mut agent, "a", "warped").await;
    let seen = step(&mut agent, 2.0).await;
    // Half as bright in linear light: 0.2888, 0.0015 and 0.0511 of 1.
    let dark = [146, 5, 64];
    let wanted = expected_images(24, 2.0, Some(dark), &[2.5], true);
    assert_eq!(pixels(&seen, "left"), wanted);
    let count = |image: &[u8]| image.chunks(3).filter(|pixel| *pixel == dark).count();
    let whole = expected(24, 2.0, Some(dark), &[2.5]);
    assert!((50..count(&whole)).contains(&count(&wanted)), "{}", count(&wanted));
    agent.ask(json!({"type": "close"})).await;
    replayed(&server, &folder, "a-1", 2);
}

#[tokio::test]
async fn the_reference_of_a_camera_stays_until_another_is_half_a_metre_nearer() {
    // Half-way to the mean of the reference.
    let changes = json!({
        "name": "difix", "timeout_ms": 10_000, "merge": "replace",
        "size": {"multiple_of": 1, "fit": "pad"},
        "inputs": [
            {"name": "image", "role": "rgb", "dtype": "f16", "range": [-1, 1]},
            {"name": "reference", "role": "reference", "dtype": "f16", "range": [-1, 1]},
            {"name": "strength", "role": "constant", "dtype": "f16", "value": 0.5},
        ],
        "outputs": [{"name": "repaired", "role": "rgb", "range": [-1, 1]}],
    });
    let folder = Folder::new(&doubles::difix(), changes);
    let (server, _) = server(&[&folder]).await;
    let mut agent = server.agent().await;
    let opened = open(&mut agent, "a", "difix").await;
    assert_eq!(opened["repair"]["references"], "rendered");
    let at = |x_m: f64| {
        let mut step = beside(2.0);
        step["pose"]["xyz"][0] = x_m.into();
        step
    };
    let mut used = Vec::new();
    // From 4 m to 6 m, half-way is 5 m: at 5.2 m the other is 0.4 m nearer, at 5.3 m 0.6 m.
    for x_m in [4.0, 5.2, 5.3, 4.8, 4.7] {
        let seen = agent.look(at(x_m)).await;
        assert_eq!(statuses(&seen), ["repaired"; 2]);
        used.push(seen.meta["images"][0]["repair"]["references"][0].as_str().unwrap().to_owned());
    }
    let names = ["4.00", "4.00", "6.00", "6.00", "4.00"].map(|m| format!("log@{m}/left"));
    assert_eq!(used, names);
    agent.ask(json!({"type": "close"})).await;
    replayed(&server, &folder, "a-1", 10);

    // Images of other cameras are no reference.
    add_views(&server, [1, 2, 3], &[4.0], ["front", "rear"]);
    let mut other = server.agent().await;
    let asked = opening("b", json!({"model": "difix"}));
    let mut message = json!({"type": "open", "twin": "test"});
    message.as_object_mut().unwrap().extend(asked.as_object().unwrap().clone());
    let answer = other.ask(message).await;
    refused(&answer, "repair_unavailable");
    assert!(answer["message"].as_str().unwrap().contains("none of \"left\""), "{answer}");
}
