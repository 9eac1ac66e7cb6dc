//! Assets of actors over HTTP.

mod damaged;
mod made;
mod refused;
mod stopped;

use std::path::Path;
use std::time::Duration;

use serde_json::json;
use wildcity_client::{ActorClass, HttpClient, HttpError, NewActor, PushFile};
use wildcity_push::{AssetSettings, AssetSource, SourceAxes, SourceScene, make_asset, read_actor};
use wildcity_scene::{Gaussians, RecordFormat};
use wildcity_twin::store::{Catalog, StoredActor};

use crate::http::{get, in_cell, write};
use crate::metrics::scrape;
use crate::support::{TEST_TIMEOUT, TestServer};

/// A ball of Gaussians 2 m in radius.
pub(super) fn ball(count: usize, seed: u64) -> Gaussians {
    let mut gaussians = in_cell([0, 0], count, seed);
    gaussians.means_m.iter_mut().flatten().for_each(|m| *m *= 0.25);
    gaussians
}

pub(super) fn new_actor(name: &str, uploads: &[&str]) -> NewActor {
    let file = |id: &&str| PushFile {
        upload: (*id).to_owned(),
        axes: Some("identity".to_owned()),
        scale: Some(1.0),
        name: None,
    };
    NewActor {
        name: name.to_owned(),
        class: ActorClass::Vehicle,
        files: uploads.iter().map(file).collect(),
        gaussians: None,
        record: None,
    }
}

pub(super) async fn upload(client: &HttpClient, path: &Path) -> String {
    client.upload(path, &mut |_, _| {}).await.unwrap().id
}

/// Uploads Gaussians as a PLY file.
pub(super) async fn upload_ply(client: &HttpClient, name: &str, gaussians: &Gaussians) -> String {
    let dir = tempfile::tempdir().unwrap();
    upload(client, &write(dir.path(), name, gaussians)).await
}

/// The asset that `wildcity actor import` stores for a file.
pub(super) fn imported(
    path: &Path,
    name: &str,
    axes: &str,
    record: RecordFormat,
    count: u32,
) -> StoredActor {
    let dir = tempfile::tempdir().unwrap();
    let axes = SourceAxes::parse(axes, 1.0).unwrap();
    let read = read_actor(path, &axes, count, &mut |_, _| {}).unwrap();
    let SourceScene { gaussians, hash, .. } = read;
    let class = wildcity_scene::ActorClass::Vehicle;
    let settings = AssetSettings { name: name.to_owned(), class, mesh_gaussians: count, record };
    let source = AssetSource { gaussians, hashes: vec![hash], options: axes.options().to_vec() };
    let asset = make_asset(source, &settings).unwrap();
    Catalog::open(dir.path()).unwrap().put_actor(&asset, record).unwrap()
}

/// Asserts that there is no asset, and no part of one.
pub(super) async fn nothing_is_stored(server: &TestServer) {
    assert_eq!(get(server, "/v1/actors").await.body, json!({ "actors": [] }));
    let objects = server.twins.path().join(".actors/objects");
    let entries = std::fs::read_dir(objects).map(Iterator::count).unwrap_or(0);
    assert_eq!(entries, 0, "objects that no list has");
}

/// The refusal of a push whose request is good and whose files are not.
pub(super) async fn refusal(client: &HttpClient, actor: &NewActor) -> (u16, String, String) {
    match client.push_actor(actor).await {
        Err(HttpError::Refused { status, code, message, .. }) => {
            let code = serde_json::to_value(code).unwrap();
            (status, code.as_str().unwrap().to_owned(), message)
        }
        other => panic!("not refused: {other:?}"),
    }
}

/// Waits until the metrics have a line.
pub(super) async fn metrics_have(server: &TestServer, line: &str) {
    let found = async {
        while !scrape(server).await.lines().any(|found| found == line) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, found).await.unwrap_or_else(|_| panic!("no {line}"));
}
