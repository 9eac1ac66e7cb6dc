//! What the files of a push say besides their Gaussians, and what the request leaves to the twin.

use wildcity_client::{AllCells, CellSelection, NewPush, PushState};
use wildcity_scene::Gaussians;
use wildcity_twin::store::Catalog;

use crate::http::{client, in_cell, new_push, push};
use crate::scene_files::{inria_columns, ply};
use crate::support::TestServer;

fn all(asked: &mut NewPush) {
    asked.cells = Some(CellSelection::All(AllCells::All));
}

/// In place of the axes and the scale of the test's pushes, none.
fn without_axes(asked: &mut NewPush) {
    all(asked);
    (asked.files[0].axes, asked.files[0].scale) = (None, None);
}

/// A push used to turn the twin on its side if it gave no axes.
#[tokio::test]
async fn a_push_without_axes_has_those_of_the_twin() {
    let server = TestServer::start().await;
    let scene = in_cell([0, 0], 40, 1);
    let first = push(&server, &scene, |asked| {
        all(asked);
        asked.files[0].axes = Some("y-down-z-forward".to_owned());
        asked.files[0].scale = Some(0.5);
    })
    .await;
    assert_eq!((first.state, first.version), (PushState::Ready, Some(2)), "{first:?}");
    let again = push(&server, &scene, without_axes).await;
    assert_eq!(again.version_hash, first.version_hash, "{again:?}");
    let file = &again.report.unwrap().files[0];
    assert!(file.warnings.is_empty(), "{file:?}");
    assert!(file.assumed[0].contains("those of the twin, y-down-z-forward, are used"), "{file:?}");
    assert!(file.assumed[1].contains("that of the twin, 0.5, is used"), "{file:?}");

    // Given axes count, and files of different axes need them.
    let given = push(&server, &scene, |asked| {
        all(asked);
        asked.files.push(asked.files[0].clone());
        asked.files[1].axes = Some("y-up-z-back".to_owned());
    })
    .await;
    assert_eq!((given.state, given.version), (PushState::Ready, Some(3)), "{given:?}");
    let refused = push(&server, &scene, without_axes).await;
    let error = refused.error.unwrap();
    assert!(error.message.starts_with("files[0].axes: give axes and scale"), "{error:?}");
}

#[tokio::test]
async fn invalid_gaussians_are_left_out_on_request() {
    let server = TestServer::start().await;
    let mut scene = in_cell([0, 0], 40, 1);
    scene.means_m[3][0] = f64::NAN;
    scene.quats_wxyz[7] = [0.0; 4];
    let refused = push(&server, &scene, all).await;
    let message = refused.error.unwrap().message;
    assert!(message.contains("Gaussian 3: x is NaN") && message.contains("drop_bad"), "{message}");
    let pushed = push(&server, &scene, |asked| {
        all(asked);
        asked.drop_bad = true;
    })
    .await;
    let file = &pushed.report.unwrap().files[0];
    assert_eq!((pushed.version, file.gaussians, file.dropped), (Some(2), 38, 2));
}

/// A PLY with a comment.
fn commented(scene: &Gaussians, comment: &str) -> Vec<u8> {
    let file = ply(scene, &inria_columns(0, false));
    let own = b"comment made by a test\n";
    let at = file.windows(own.len()).position(|window| window == own).unwrap();
    [&file[..at], format!("comment {comment}\n").as_bytes(), &file[at + own.len()..]].concat()
}

#[tokio::test]
async fn a_tag_of_training_makes_the_profile_of_a_new_twin_and_a_warning_for_others() {
    let server = TestServer::start().await;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("mip.ply");
    std::fs::write(&path, commented(&in_cell([0, 0], 40, 1), "SplatRenderMode: mip")).unwrap();
    let client = client(&server);
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    for (twin, is_new) in [("fresh", true), ("test", false)] {
        let begun = client.push(twin, &new_push(&[&upload.id])).await.unwrap();
        let pushed = client.wait_for_push(begun, &mut |_| {}).await.unwrap();
        assert_eq!(pushed.state, PushState::Ready, "{pushed:?}");
        let catalog = Catalog::open(server.twins.path()).unwrap();
        let profile = catalog.version(twin, None).unwrap().manifest.profile;
        assert_eq!((profile.antialiased, profile.blur == 0.1), (is_new, is_new), "{twin}");
        let warnings = &pushed.report.unwrap().files[0].warnings;
        let warned = warnings.iter().any(|warning| warning.contains("--set antialiased=true"));
        assert_eq!(warned, !is_new, "{warnings:?}");
    }
}
