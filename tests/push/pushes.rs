//! Pushes: all of their cells change at once; a refusal lists everything that is wrong; the same
//! push again has the same result.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::json;
use wildcity_client::{AllCells, CellSelection, NewPush, Push, PushState};
use wildcity_protocol::error::Code;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::Gaussians;
use wildcity_scene::align::Alignment;
use wildcity_server::Limits;
use wildcity_twin::store::{Catalog, Edit};

use crate::http::{client, get, in_cell, new_push, post, push, send, write};
use crate::scene_files::gaussians;
use crate::support::{TEST_TIMEOUT, TestServer};

#[tokio::test]
async fn a_push_replaces_the_cells_that_it_touches() {
    let server = TestServer::start().await;
    let mut gaussians = in_cell([0, 0], 40, 1);
    let far = in_cell([3, -1], 10, 2);
    gaussians.append(&far);
    let pushed = push(&server, &gaussians, |_| {}).await;
    assert_eq!((pushed.state, pushed.version), (PushState::Ready, Some(2)), "{pushed:?}");
    let report = pushed.report.unwrap();
    let cells: Vec<_> = report.cells.iter().map(|c| (c.cell, c.before, c.after)).collect();
    assert_eq!(cells, [([3, -1], 0, 10), ([0, 0], 32, 40)]);
    assert_eq!((report.gaussians, report.left_out, report.files.len()), (50, 0, 1));
    assert_eq!(report.previews.len(), 4, "a few poses along the trajectory");

    let catalog = Catalog::open(server.twins.path()).unwrap();
    let version = catalog.version("test", None).unwrap();
    let counts: Vec<_> = version.manifest.chunks.iter().map(|c| (c.cell, c.count)).collect();
    assert_eq!(counts, [([3, -1], 10), ([0, 0], 40), ([1, 0], 32)]);
    assert_eq!(version.manifest.trajectories.len(), 1, "the rest of the twin stays");
    let listed = get(&server, "/v1/twins/test").await.body;
    assert_eq!((&listed["version"], &listed["gaussians"]), (&json!(2), &json!(82)));
    let versions = get(&server, "/v1/twins/test/versions").await.body["versions"].clone();
    assert_eq!(versions.as_array().unwrap().len(), 2);
    assert_eq!((&versions[1]["kind"], &versions[1]["parent"]), (&json!("push"), &json!(1)));

    let back = post(&server, "/v1/twins/test/rollback", &json!({ "version": 1 })).await;
    assert_eq!((back.status, &back.body["version"]), (200, &json!(3)), "{back:?}");
    assert_eq!(back.body["version_hash"], versions[0]["version_hash"]);
    post(&server, "/v1/twins/test/rollback", &json!({ "version": 9 }))
        .await
        .refused(404, "unknown_version");
}

/// Axes and scale are those of each file; stored and reported values are in the twin's axes.
#[tokio::test]
async fn each_file_has_its_axes_and_its_scale() {
    let server = TestServer::start().await;
    let dir = tempfile::tempdir().unwrap();
    let mut one = Gaussians::default();
    one.means_m.push([1.0, 2.0, 3.0]);
    one.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
    one.ln_scales.push([0.1_f32, 0.2, 0.3].map(f32::ln));
    one.logit_opacities.push(0.0);
    one.sh.extend([0.0; 3]);
    let client = client(&server);
    let mut uploads = Vec::new();
    for logit in [0.0, 1.0] {
        one.logit_opacities[0] = logit;
        let path = write(dir.path(), "one.ply", &one);
        uploads.push(client.upload(&path, &mut |_, _| {}).await.unwrap().id);
    }
    let mut asked = new_push(&[&uploads[0], &uploads[1]]);
    asked.record = Some("f32".to_owned());
    // x right, y down, z forward, in half metres; and a quarter turn.
    (asked.files[0].axes, asked.files[0].scale) = (Some("y-down-z-forward".to_owned()), Some(0.5));
    asked.files[1].axes = Some("0 -1 0 1 0 0 0 0 1".to_owned());
    let begun = client.push("turned", &asked).await.unwrap();
    let pushed = client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    let ranges = pushed.report.unwrap().ranges.unwrap();
    assert_eq!(ranges.mean_m, [[-2.0, 1.0, -1.0], [0.5, 1.5, 3.0]]);
    let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
    assert!(near(ranges.scale_m[0], 0.05) && near(ranges.scale_m[1], 0.3), "{ranges:?}");

    let catalog = Catalog::open(server.twins.path()).unwrap();
    let version = catalog.version("turned", None).unwrap();
    let entry = &version.manifest.chunks[0];
    let mut centres_m = Vec::new();
    for section in entry.sections.iter().filter(|section| section.level == 0) {
        let chunk = catalog.section(&version, entry, section).unwrap();
        centres_m.extend(chunk.to_gaussians().means_m);
    }
    centres_m.sort_by(|a, b| a[0].total_cmp(&b[0]));
    assert_eq!(centres_m, [[-2.0, 1.0, 3.0], [0.5, 1.5, -1.0]]);
}

#[tokio::test]
async fn a_push_makes_a_new_twin() {
    let server = TestServer::start().await;
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "a.ply", &in_cell([0, 0], 20, 1));
    let client = client(&server);
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let begun = client.push("fresh", &new_push(&[&upload.id])).await.unwrap();
    let pushed = client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    assert_eq!((pushed.state, pushed.version), (PushState::Ready, Some(1)), "{pushed:?}");
    assert_eq!(get(&server, "/v1/twins/fresh").await.body["gaussians"], 20);
}

#[tokio::test]
async fn the_same_push_again_is_the_same_answer() {
    let server = TestServer::start().await;
    let gaussians = in_cell([0, 0], 40, 1);
    let first = push(&server, &gaussians, |push| push.id = Some("one".to_owned())).await;
    let again = push(&server, &gaussians, |push| push.id = Some("one".to_owned())).await;
    assert_eq!(first, again);
    let other = push(&server, &gaussians, |_| {}).await;
    assert_eq!(other.version, Some(2), "the same content as the latest version's is that version");
    // After a rollback, the same content makes a new version.
    post(&server, "/v1/twins/test/rollback", &json!({ "version": 1 })).await;
    assert_eq!(push(&server, &gaussians, |_| {}).await.version, Some(4));
    let taken = json!({ "id": "one", "files": [{ "upload": "blake3-0" }], "note": "another" });
    post(&server, "/v1/twins/test/pushes", &taken).await.refused(400, "out_of_range");
}

#[tokio::test]
async fn every_bad_gaussian_is_named() {
    let server = TestServer::start().await;
    let mut gaussians = in_cell([0, 0], 5000, 1);
    gaussians.means_m[17][1] = f64::NAN;
    gaussians.quats_wxyz[18] = [0.0; 4];
    for index in 100..140 {
        gaussians.ln_scales[index][2] = 11.0;
    }
    let pushed = push(&server, &gaussians, |_| {}).await;
    assert_eq!((pushed.state, pushed.version), (PushState::Refused, None));
    let error = pushed.error.unwrap();
    assert_eq!(error.code, Code::PushRefused);
    assert!(error.message.starts_with("scene.ply: Gaussian 17: y is NaN"), "{}", error.message);
    let report = pushed.report.unwrap();
    let file = &report.files[0];
    assert_eq!((file.gaussians, file.bad, file.first_bad.len()), (5000, 42, 16));
    let named: Vec<_> = file.first_bad.iter().map(|bad| (bad.index, &*bad.field)).collect();
    assert_eq!(named[0], (17, "y"));
    assert_eq!(named[1].0, 18);
    assert_eq!(named[2], (100, "scale_2"));
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);
    server.still_serves().await;
}

/// A few Gaussians in a neighbouring cell must not replace all of its Gaussians.
#[tokio::test]
async fn a_margin_does_not_replace_the_neighbouring_cell() {
    let server = TestServer::start().await;
    let mut gaussians = in_cell([0, 0], 40, 1);
    for mean in gaussians.means_m.iter_mut().take(3) {
        mean[0] = 33.0;
    }
    let refused = push(&server, &gaussians, |_| {}).await;
    let error = refused.error.unwrap();
    assert_eq!((refused.state, error.cells), (PushState::Refused, vec![[1, 0]]));
    assert!(error.message.contains("3 Gaussians in place of 32"), "{}", error.message);
    let named = |cells: &[[i32; 2]]| Some(CellSelection::Listed(cells.to_vec()));
    let pushed = push(&server, &gaussians, |push| push.cells = named(&[[0, 0]])).await;
    assert_eq!(pushed.state, PushState::Ready, "{pushed:?}");
    assert_eq!(pushed.report.unwrap().left_out, 3);
    assert_eq!(get(&server, "/v1/twins/test").await.body["gaussians"], 37 + 32);
    // A cell that is named is replaced.
    let pushed = push(&server, &gaussians, |push| push.cells = named(&[[0, 0], [1, 0]])).await;
    assert_eq!(pushed.state, PushState::Ready, "{pushed:?}");
    assert_eq!(get(&server, "/v1/twins/test").await.body["gaussians"], 40);
    let empty = push(&server, &gaussians, |push| push.cells = named(&[[0, 0], [7, 7]])).await;
    assert_eq!(empty.error.unwrap().cells, [[7, 7]]);
}

#[tokio::test]
async fn cells_that_changed_since_the_base_are_not_overwritten() {
    let server = TestServer::start().await;
    let changed = push(&server, &in_cell([0, 0], 40, 1), |push| push.base = Some(1)).await;
    assert_eq!(changed.version, Some(2), "{changed:?}");
    // Other cells are added on top.
    let apart = push(&server, &in_cell([1, 0], 50, 2), |push| push.base = Some(1)).await;
    assert_eq!(apart.version, Some(3), "{apart:?}");
    assert_eq!(get(&server, "/v1/twins/test").await.body["gaussians"], 90);
    // The same cell is refused: at once if it is named, otherwise when the files are read.
    let late = push(&server, &in_cell([0, 0], 60, 3), |push| push.base = Some(1)).await;
    let error = late.error.unwrap();
    assert_eq!((late.state, error.code), (PushState::Refused, Code::Conflict));
    assert_eq!(error.cells, [[0, 0]]);
    let ask = json!({ "files": [{ "upload": "x" }], "base": 1, "cells": [[0, 0], [5, 5]] });
    let refused = post(&server, "/v1/twins/test/pushes", &ask).await;
    refused.refused(409, "conflict");
    assert_eq!(refused.body["cells"], json!([[0, 0]]));
    let ask = json!({ "files": [{ "upload": "x" }], "base": 9 });
    post(&server, "/v1/twins/test/pushes", &ask).await.refused(404, "unknown_version");
    // All of the twin, from an old version.
    let ask = json!({ "files": [{ "upload": "x" }], "base": 2, "cells": "all" });
    let refused = post(&server, "/v1/twins/test/pushes", &ask).await;
    assert_eq!((refused.status, &refused.body["cells"]), (409, &json!([[1, 0]])));
    let whole = in_cell([2, 2], 7, 4);
    let all = push(&server, &whole, |push| {
        push.cells = Some(CellSelection::All(AllCells::All));
        push.base = Some(3);
    });
    assert_eq!(all.await.version, Some(4));
    assert_eq!(get(&server, "/v1/twins/test").await.body["gaussians"], 7);
}

/// A push of all cells is of the version that it was checked against, also if it names none.
#[tokio::test]
async fn all_cells_replace_nothing_that_changed_while_they_were_checked() {
    let server = TestServer::start().await;
    let client = client(&server);
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "whole.ply", &in_cell([2, 2], 7, 1));
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let cells = Some(CellSelection::All(AllCells::All));
    let whole = NewPush { cells, ..new_push(&[&upload.id]) };
    // The preview of a push renders eight frames. During these, another program writes a version.
    server.painter.slow_ms.store(500, Ordering::SeqCst);
    let begun = client.push("test", &whole).await.unwrap();
    let catalog = Catalog::open(server.twins.path()).unwrap();
    let twice = Alignment { metres_per_unit: 2.0, ..Alignment::IDENTITY };
    let edit = Edit { alignment: twice, trajectories: Vec::new(), rig: None };
    let path = format!("/v1/twins/test/pushes/{}", begun.id);
    let has_cells = async {
        while get(&server, &path).await.body["report"]["cells"].as_array().is_none_or(Vec::is_empty)
        {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, has_cells).await.expect("the push is checked");
    let base = catalog.version("test", None).unwrap();
    catalog.edit(&base, edit, &mut |_, _| {}).unwrap();
    let refused = client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    let error = refused.error.expect("the other version changed what this one replaces");
    assert_eq!((refused.state, error.code), (PushState::Refused, Code::Conflict), "{error:?}");
    let latest = catalog.version("test", None).unwrap();
    assert_eq!((latest.number, latest.manifest.twin_from_capture), (2, Some(twice)));

    server.painter.slow_ms.store(0, Ordering::SeqCst);
    let again = NewPush { id: Some("again".to_owned()), ..whole };
    let again = client.push("test", &again).await.unwrap();
    let again = client.wait_for_push(again, &mut |_| {}).await.unwrap();
    assert_eq!((again.state, again.version), (PushState::Ready, Some(3)), "{again:?}");
    assert_eq!(catalog.version("test", None).unwrap().manifest.twin_from_capture, Some(twice));
}

#[tokio::test]
async fn views_before_and_after_are_compared() {
    let cpu = Arc::new(Cpu::new(2, Simd::Best).unwrap());
    let server = TestServer::configured(|config| config.backend = cpu).await;
    let gaussians = in_cell([0, 0], 400, 1);
    let refused = push(&server, &gaussians, |push| push.preview.min_psnr_db = Some(90.0)).await;
    assert_eq!(refused.state, PushState::Refused);
    assert!(refused.error.unwrap().message.contains("min_psnr_db is 90"));
    let golden = refused.report.unwrap().previews;
    assert_eq!(golden.len(), 4);
    assert!(golden.iter().all(|golden| golden.psnr_db.is_some_and(|db| db < 90.0)), "{golden:?}");
    let pushed = push(&server, &gaussians, |push| push.preview.min_psnr_db = Some(1.0)).await;
    assert_eq!(pushed.version, Some(2), "{pushed:?}");
    // The same content looks the same, up to the rounding of its record format.
    let again = push(&server, &gaussians, |push| {
        push.preview.min_psnr_db = Some(60.0);
        push.note = Some("once more".to_owned());
    });
    let again = again.await;
    assert_eq!(again.state, PushState::Ready, "{again:?}");
}

/// Levels of detail cause no difference, although a twin is rendered with them from afar and a push
/// has none yet.
#[tokio::test]
async fn the_same_content_has_equal_views_from_afar() {
    let cpu = Arc::new(Cpu::new(2, Simd::Best).unwrap());
    let server = TestServer::configured(|config| config.backend = cpu).await;
    let gaussians = in_cell([0, 0], 20_000, 1);
    let pose = |x: f64| wildcity_client::Pose { xyz: [x, 0.0, 2.0], q: [1.0, 0.0, 0.0, 0.0] };
    let exact = |push: &mut NewPush| {
        push.cells = Some(CellSelection::All(AllCells::All));
        push.record = Some("f32".to_owned());
        push.preview.poses = Some(vec![pose(-150.0)]);
    };
    assert_eq!(push(&server, &gaussians, exact).await.version, Some(2));
    let sections = |number| {
        let catalog = Catalog::open(server.twins.path()).unwrap();
        catalog.version("test", Some(number)).unwrap().manifest.chunks[0].sections.len()
    };
    assert!(sections(2) > 16, "no levels: {}", sections(2));
    let again = push(&server, &gaussians, |push| {
        exact(push);
        push.preview.min_psnr_db = Some(99.0);
        push.note = Some("once more".to_owned());
    });
    let again = again.await;
    let previews = again.report.as_ref().map(|report| &report.previews[..]);
    assert!(
        matches!(previews, Some([seen]) if seen.psnr_db.is_none()) && again.version == Some(3),
        "{again:?}"
    );
    // Both cameras, to the front and to the rear, look past the twin.
    let blind = push(&server, &gaussians, |push| {
        exact(push);
        push.preview.poses =
            Some(vec![wildcity_client::Pose { xyz: [0.0, 900.0, 2.0], ..pose(0.0) }]);
        push.preview.min_psnr_db = Some(1.0);
    });
    let blind = blind.await;
    let error = blind.error.expect("nothing is seen");
    assert!(error.message.contains("no Gaussian is seen from these poses"), "{}", error.message);
}

/// No agent waits for a preview: on a busy server its frames may take longer than a step may.
#[tokio::test]
async fn a_preview_has_more_time_than_a_step() {
    let cpu = Arc::new(Cpu::new(2, Simd::Best).unwrap());
    let server = TestServer::configured(|config| {
        config.backend = cpu;
        config.limits.step = Duration::from_nanos(1);
    })
    .await;
    let pushed = push(&server, &in_cell([0, 0], 400, 1), |_| {}).await;
    assert_eq!(pushed.state, PushState::Ready, "{pushed:?}");
    assert_eq!(pushed.report.unwrap().previews.len(), 4);
}

/// A push with `min_psnr_db` is refused if there is nothing to compare it with.
#[tokio::test]
async fn a_psnr_that_cannot_be_measured_is_refused() {
    let server = TestServer::start().await;
    let alike = |push: &mut NewPush| push.preview.min_psnr_db = Some(1.0);
    let refused = |pushed: &Push, why: &str| {
        let error = pushed.error.as_ref().expect(why);
        assert_eq!((pushed.state, error.code), (PushState::Refused, Code::OutOfRange));
        assert!(error.message.contains(why), "{}", error.message);
    };
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "a.ply", &in_cell([0, 0], 20, 1));
    let client = client(&server);
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let fresh = async |change: &dyn Fn(&mut NewPush)| {
        let mut asked = new_push(&[&upload.id]);
        change(&mut asked);
        let begun = client.push("fresh", &asked).await.unwrap();
        client.wait_for_push(begun, &mut |_| {}).await.unwrap()
    };
    refused(&fresh(&alike).await, "no version before");
    assert_eq!(fresh(&|_| {}).await.state, PushState::Ready);
    refused(&fresh(&alike).await, "no recorded drive");
    let nowhere = |push: &mut NewPush| {
        alike(push);
        push.preview.poses = Some(Vec::new());
    };
    refused(&fresh(&nowhere).await, "names none");
    let other = gaussians(40, 1, 8.0, 3);
    let pushed = push(&server, &other, |push| {
        alike(push);
        push.cells = Some(CellSelection::All(AllCells::All));
    });
    refused(&pushed.await, "SH degree is 1, and 0");
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);
}

/// A crash of the renderer fails the frame or the preview that caused it, and nothing else.
#[tokio::test]
async fn a_crash_while_comparing_fails_the_push_and_nothing_else() {
    let server = TestServer::start().await;
    server.painter.crash.store(true, Ordering::SeqCst);
    let failed = push(&server, &in_cell([0, 0], 40, 1), |push| push.id = Some("p".into())).await;
    assert_eq!((failed.state, failed.version), (PushState::Failed, None), "{failed:?}");
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);
    // A failed push can be sent again.
    let again = push(&server, &in_cell([0, 0], 40, 1), |push| push.id = Some("p".into())).await;
    assert_eq!((again.state, again.version), (PushState::Ready, Some(2)), "{again:?}");
    server.still_serves().await;
}

/// A push that takes long delays no push of another twin, and can be cancelled.
#[tokio::test]
async fn a_slow_push_delays_no_other_twin_and_can_be_cancelled() {
    let server = TestServer::start().await;
    let client = client(&server);
    let dir = tempfile::tempdir().unwrap();
    let upload = async |name: &str, gaussians: Gaussians| {
        let path = write(dir.path(), name, &gaussians);
        client.upload(&path, &mut |_, _| {}).await.unwrap().id
    };
    let slow_id = upload("slow.ply", in_cell([0, 0], 40, 1)).await;
    let other_id = upload("other.ply", in_cell([0, 0], 20, 2)).await;
    // The preview of a push renders eight frames.
    server.painter.slow_ms.store(1_000, Ordering::SeqCst);
    let slow = NewPush { id: Some("slow".to_owned()), ..new_push(&[&slow_id]) };
    let begun = client.push("test", &slow).await.unwrap();
    let other = client.push("other", &new_push(&[&other_id])).await.unwrap();
    let other = client.wait_for_push(other, &mut |_| {}).await.unwrap();
    assert_eq!(other.state, PushState::Ready, "{other:?}");
    let path = format!("/v1/twins/test/pushes/{}", begun.id);
    let state = get(&server, &path).await.body["state"].clone();
    assert!(["ingesting", "validating"].contains(&state.as_str().unwrap()), "{state}");

    let delete = format!("DELETE {path} HTTP/1.1");
    let cancelled = send(server.address(), &delete, b"").await;
    assert_eq!((cancelled.status, &cancelled.body["state"]), (200, &json!("failed")));
    assert_eq!(cancelled.body["error"]["code"], "conflict", "{cancelled:?}");
    send(server.address(), &delete, b"").await.refused(409, "conflict");
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);

    // It is not in the way of the same push, sent again.
    server.painter.slow_ms.store(0, Ordering::SeqCst);
    let again = client.push("test", &slow).await.unwrap();
    let again = client.wait_for_push(again, &mut |_| {}).await.unwrap();
    assert_eq!((again.state, again.version), (PushState::Ready, Some(2)), "{again:?}");
    send(server.address(), &delete, b"").await.refused(409, "conflict");
}

/// A push that takes too long to check is refused, and the next one runs.
#[tokio::test]
async fn a_push_has_a_time_limit() {
    // The last push must be this fast, also on a busy machine.
    let limits = Limits { push: Duration::from_secs(5), ..Limits::default() };
    let server = TestServer::with(limits).await;
    server.painter.slow_ms.store(6_000, Ordering::SeqCst);
    let refused = push(&server, &in_cell([0, 0], 40, 1), |_| {}).await;
    assert_eq!(refused.state, PushState::Refused);
    let reason = refused.error.unwrap().message;
    assert!(reason.contains("took longer than"), "{reason}");
    server.painter.slow_ms.store(0, Ordering::SeqCst);
    assert_eq!(push(&server, &in_cell([0, 0], 41, 1), |_| {}).await.state, PushState::Ready);
}
