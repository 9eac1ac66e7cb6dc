//! The frame of a push: a scene that was trained in the axes of the capture gets the same place as
//! if it had been in the twin when the twin was aligned.

use serde_json::{Value, json};
use wildcity_client::{AllCells, CellSelection, NewPush, Push, PushFrame, PushState};
use wildcity_scene::align::Alignment;
use wildcity_scene::{Gaussians, RecordFormat};
use wildcity_twin::store::{Catalog, Version};

use crate::http::{client, get, in_cell, new_push, post, write};
use crate::scene_files::gaussians;
use crate::support::TestServer;

/// Two alignments, one after the other: tilted ground and a different unit, and then rotated
/// ground.
fn edits() -> [Value; 2] {
    let ground = json!({"points": [[0, 0, 2], [4, 0, 3], [0, 4, 1]], "above": [0, 0, 50]});
    let scale = json!({"points": [[0, 0, 0], [0, 1, 0]], "distance_m": 1.75});
    let again = json!({"points": [[0, 0, -1], [9, 1, -1], [0, 8, 2]], "above": [0, 0, 50]});
    [json!({"ground": ground, "scale": scale}), json!({"ground": again})]
}

async fn edit(server: &TestServer, twin: &str, edit: &Value) {
    let reply = post(server, &format!("/v1/twins/{twin}/edits"), edit).await;
    assert_eq!(reply.status, 200, "{reply:?}");
}

/// Uploads a scene, pushes it as a whole twin with exact values, and waits for the end.
async fn push(
    server: &TestServer,
    twin: &str,
    scene: &Gaussians,
    change: impl FnOnce(&mut NewPush),
) -> Push {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "scene.ply", scene);
    let client = client(server);
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let mut asked = new_push(&[&upload.id]);
    asked.record = Some("f32".to_owned());
    asked.cells = Some(CellSelection::All(AllCells::All));
    change(&mut asked);
    let begun = client.push(twin, &asked).await.unwrap();
    client.wait_for_push(begun, &mut |_| {}).await.unwrap()
}

fn in_capture(push: &mut NewPush) {
    push.frame = Some(PushFrame::Capture);
}

/// 2,000 Gaussians of SH degree 2; the opacity of each is its number, so that they can be found
/// again.
fn scene(seed: u64) -> Gaussians {
    let mut scene = gaussians(2_000, 2, 60.0, seed);
    for (index, logit) in scene.logit_opacities.iter_mut().enumerate() {
        *logit = index as f32 / 500.0 - 2.0;
    }
    scene
}

fn latest(server: &TestServer, twin: &str) -> Version {
    Catalog::open(server.twins.path()).unwrap().version(twin, None).unwrap()
}

/// The Gaussians of a twin's latest version, in the order of their numbers.
fn stored(server: &TestServer, twin: &str) -> Gaussians {
    let catalog = Catalog::open(server.twins.path()).unwrap();
    let version = catalog.version(twin, None).unwrap();
    assert_eq!(version.manifest.record, RecordFormat::F32);
    let sh_degree = version.manifest.sh_degree;
    let mut all = Gaussians { sh_degree, ..Gaussians::default() };
    catalog.visit_full_detail(&version, &|_| true, &mut |part| all.append(&part)).unwrap();
    let mut order: Vec<usize> = (0..all.len()).collect();
    order.sort_by(|&a, &b| all.logit_opacities[a].total_cmp(&all.logit_opacities[b]));
    all.select(order)
}

/// The largest difference of two scenes in each of their fields: means, rotations, scales, colours.
fn differences(one: &Gaussians, two: &Gaussians) -> [f64; 4] {
    assert_eq!(one.len(), two.len());
    let most = |pairs: &mut dyn Iterator<Item = (f64, f64)>| {
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let flat = |values: &[[f32; 3]]| -> Vec<f64> {
        values.as_flattened().iter().copied().map(f64::from).collect()
    };
    let wide = |values: &[f32]| -> Vec<f64> { values.iter().copied().map(f64::from).collect() };
    // q and -q are one rotation, and records store unit quaternions.
    let quats = |scene: &Gaussians| -> Vec<f64> {
        let unit = scene.quats_wxyz.iter().flat_map(|q| {
            let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
            let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
            q.map(|q| f64::from(sign * q / length))
        });
        unit.collect()
    };
    let pairs = |a: Vec<f64>, b: Vec<f64>| most(&mut a.into_iter().zip(b));
    let logits = pairs(wide(&one.logit_opacities), wide(&two.logit_opacities));
    assert!(logits < 1e-5, "the same Gaussians: {logits}");
    [
        pairs(one.means_m.as_flattened().to_vec(), two.means_m.as_flattened().to_vec()),
        pairs(quats(one), quats(two)),
        pairs(flat(&one.ln_scales), flat(&two.ln_scales)),
        pairs(wide(&one.sh), wide(&two.sh)),
    ]
}

#[tokio::test]
async fn a_push_in_the_frame_of_the_capture_lies_as_if_it_had_been_aligned_with_the_twin() {
    let server = TestServer::start().await;
    let (first, second) = (scene(1), scene(2));
    // Pushed before the twin is aligned, and after.
    for twin in ["before", "after"] {
        assert_eq!(push(&server, twin, &first, |_| {}).await.version, Some(1));
    }
    assert_eq!(push(&server, "before", &second, |_| {}).await.version, Some(2));
    for change in edits() {
        edit(&server, "before", &change).await;
        edit(&server, "after", &change).await;
    }
    let pushed = push(&server, "after", &second, in_capture).await;
    assert_eq!((pushed.state, pushed.version), (PushState::Ready, Some(4)), "{pushed:?}");
    let report = pushed.report.unwrap();
    assert_eq!((report.frame, report.aligned), (Some(PushFrame::Capture), true));

    // One twin was stored as f32 before the alignment, the other one after it: equal up to the
    // rounding of f32.
    let [before, after] = ["before", "after"].map(|twin| stored(&server, twin));
    let off = differences(&before, &after);
    assert!(off.iter().all(|&off| off < 3e-5), "{off:?}");
    // All of it was transformed.
    let off = differences(&after, &second);
    assert!(off.iter().all(|&off| off > 0.1), "{off:?}");
    let z_m = |corner: usize| report.ranges.unwrap().mean_m[corner][2];
    let found = after.means_m.iter().map(|mean| mean[2]);
    let found =
        found.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], z| [low.min(z), high.max(z)]);
    assert!((z_m(0) - found[0]).abs() < 1e-4 && (z_m(1) - found[1]).abs() < 1e-4, "{found:?}");

    // The alignment stays, and the version records that its files were aligned.
    let [before, after] = ["before", "after"].map(|twin| latest(&server, twin).manifest);
    assert_eq!(after.twin_from_capture, before.twin_from_capture);
    let alignment: Alignment = after.twin_from_capture.unwrap();
    assert_eq!(after.provenance.options.last(), Some(&format!("align={alignment}")));
}

#[tokio::test]
async fn a_push_without_a_frame_is_in_that_of_the_twin() {
    let server = TestServer::start().await;
    push(&server, "street", &scene(1), |_| {}).await;
    edit(&server, "street", &edits()[0]).await;
    let second = scene(2);
    for frame in [None, Some(PushFrame::Twin)] {
        let pushed = push(&server, "street", &second, |push| push.frame = frame).await;
        let report = pushed.report.unwrap();
        assert_eq!((report.frame, report.aligned), (Some(PushFrame::Twin), true));
        assert_eq!(pushed.version, Some(3), "the same content makes no second version");
    }
    let off = differences(&stored(&server, "street"), &second);
    assert!(off.iter().all(|&off| off < 1e-5), "{off:?}");
    assert!(latest(&server, "street").manifest.twin_from_capture.is_some());
}

#[tokio::test]
async fn the_frames_of_a_twin_that_was_never_aligned_are_one() {
    let server = TestServer::start().await;
    let scene = in_cell([0, 0], 40, 1);
    let plain = push(&server, "street", &scene, |_| {}).await;
    let capture = push(&server, "street", &scene, in_capture).await;
    assert_eq!(capture.version, Some(1), "{capture:?}");
    assert_eq!(capture.version_hash, plain.version_hash, "the same bytes");
    let report = capture.report.unwrap();
    assert_eq!((report.frame, report.aligned), (Some(PushFrame::Capture), false));
    let fresh = push(&server, "fresh", &scene, in_capture).await;
    assert_eq!((fresh.state, fresh.version), (PushState::Ready, Some(1)), "{fresh:?}");
    let chunks = |twin| latest(&server, twin).manifest.chunks;
    assert_eq!(chunks("fresh"), chunks("street"));
}

#[tokio::test]
async fn cells_are_those_of_the_twin_and_other_cells_stay() {
    let server = TestServer::start().await;
    push(&server, "street", &in_cell([0, 0], 40, 1), |_| {}).await;
    // Twice as large: cell (1, 0) of the capture, 64 m away, is around x = 128 m, which is cell (2,
    // 0) of the twin.
    let twice = json!({"scale": {"points": [[0, 0, 0], [0, 0, 1]], "distance_m": 2}});
    edit(&server, "street", &twice).await;
    let far = in_cell([1, 0], 30, 2);
    let named = |cells: &[[i32; 2]]| Some(CellSelection::Listed(cells.to_vec()));
    let refused = push(&server, "street", &far, |push| {
        in_capture(push);
        push.cells = named(&[[1, 0]]);
    })
    .await;
    assert_eq!(refused.error.unwrap().cells, [[1, 0]]);
    let pose = wildcity_client::Pose { xyz: [3.0, -1.0, 0.5], q: [1.0, 0.0, 0.0, 0.0] };
    let pushed = push(&server, "street", &far, |push| {
        in_capture(push);
        push.cells = None;
        push.preview.poses = Some(vec![pose]);
    })
    .await;
    let report = pushed.report.unwrap();
    let cells: Vec<_> = report.cells.iter().map(|c| (c.cell, c.before, c.after)).collect();
    assert_eq!(cells, [([2, 0], 0, 30)]);
    assert_eq!(report.previews[0].pose.xyz, [6.0, -2.0, 1.0], "the pose is in the same frame");
    let manifest = latest(&server, "street").manifest;
    assert_eq!(manifest.gaussians(), 70);
    assert_eq!(manifest.twin_from_capture.unwrap().metres_per_unit, 2.0);
    let versions = get(&server, "/v1/twins/street/versions").await.body["versions"].clone();
    let kinds: Vec<&Value> = (0..3).map(|index| &versions[index]["kind"]).collect();
    assert_eq!(kinds, ["push", "edit", "push"]);
}

#[tokio::test]
async fn a_frame_that_cannot_be_used_is_named() {
    let server = TestServer::start().await;
    let asked = json!({ "files": [{ "upload": "x" }], "frame": "world" });
    let reply = post(&server, "/v1/twins/test/pushes", &asked).await;
    reply.refused(400, "invalid_request");
    assert_eq!(reply.body["field"], "frame", "{reply:?}");

    // Aligned by a factor of 1,000: a scene that fits the bounds in the frame of the capture need
    // not fit in that of the twin.
    push(&server, "street", &in_cell([0, 0], 40, 1), |_| {}).await;
    let small = json!({"scale": {"points": [[0, 0, 0], [0, 0, 1]], "distance_m": 1000}});
    edit(&server, "street", &small).await;
    let mut far = in_cell([0, 0], 40, 2);
    far.means_m[7][1] = 9.9e7;
    let pushed = push(&server, "street", &far, in_capture).await;
    let error = pushed.error.unwrap();
    assert_eq!(pushed.state, PushState::Refused);
    assert!(error.message.starts_with("in the axes of the twin, Gaussian 7: "), "{error:?}");
    assert_eq!(get(&server, "/v1/twins/street").await.body["version"], 2);
}
