//! A pushed asset equals that of `wildcity actor import`, and sessions can use it.

use std::sync::Arc;

use serde_json::json;
use wildcity_client::{ActorClass, NewActor};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::RecordFormat;

use crate::http::{client, get, post, write};
use crate::metrics::scrape;
use crate::support::{TestServer, refused};

use super::{ball, imported, new_actor, refusal, upload, upload_ply};

#[tokio::test]
async fn a_pushed_asset_is_that_of_an_import() {
    let server = TestServer::start().await;
    let client = client(&server);
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "thing.ply", &ball(3_000, 1));
    let id = upload(&client, &path).await;
    let wanted = imported(&path, "thing", "y-down-z-forward", RecordFormat::F32, 200_000);

    let mut asked = json!({
        "name": "thing", "class": "vehicle", "record": "f32",
        "files": [{ "upload": id, "axes": "y-down-z-forward" }],
    });
    let made = post(&server, "/v1/actors", &asked).await;
    assert_eq!((made.status, &made.body["hash"]), (201, &json!(wanted.hash)), "{made:?}");
    assert_eq!(made.header("location"), Some(&*format!("/v1/actors/{}", wanted.hash)));
    let body = &made.body;
    assert_eq!((&body["name"], &body["class"]), (&json!("thing"), &json!("vehicle")));
    assert_eq!((&body["gaussians"], &body["record"]), (&json!(3_000), &json!("f32")));
    assert_eq!(body["bytes"], wanted.bytes);
    assert_eq!(body["box"]["length_m"], wanted.description.box_.length_m);
    let provenance = &wanted.description.provenance;
    assert_eq!(body["provenance"]["source"], json!(provenance.source));
    assert_eq!(body["provenance"]["options"], json!(provenance.options));
    assert_eq!(body["levels"].as_array().unwrap().len(), wanted.levels.len());
    assert_eq!(
        body["levels"][0],
        json!({ "gaussians": 3_000, "error_m": 0.0, "bytes": wanted.levels[0].bytes })
    );

    // The second push finds the asset of the first one. Other options make a different asset.
    let again = post(&server, "/v1/actors", &asked).await;
    assert_eq!((again.status, &again.body), (200, &made.body));
    asked["record"] = "q24".into();
    let taken = post(&server, "/v1/actors", &asked).await;
    taken.refused(409, "conflict");
    assert_eq!(taken.body["field"], "name");
    asked["name"] = "small".into();
    let small = post(&server, "/v1/actors", &asked).await;
    assert_eq!(small.status, 201, "{small:?}");

    let listed = client.actors().await.unwrap().actors;
    let names: Vec<&str> = listed.iter().map(|actor| &*actor.name).collect();
    assert_eq!(names, ["small", "thing"]);
    for text in ["thing", &wanted.hash, &wanted.hash[..8]] {
        assert_eq!(client.actor(text).await.unwrap(), listed[1], "{text}");
    }
    let unknown = get(&server, "/v1/actors/bus").await;
    unknown.refused(404, "unknown_actor");
    assert_eq!(unknown.body["field"], "actor");
    let metrics = scrape(&server).await;
    for line in [
        "wildcity_pushes_total{outcome=\"ready\"} 3",
        "wildcity_pushes_total{outcome=\"refused\"} 1",
        "wildcity_pushes_open 0",
    ] {
        assert!(metrics.lines().any(|found| found == line), "no {line:?} in\n{metrics}");
    }
}

#[tokio::test]
async fn classes_and_scales_are_those_asked_for() {
    let server = TestServer::start().await;
    let client = client(&server);
    let id = upload_ply(&client, "ball.ply", &ball(300, 1)).await;
    let whole = client.push_actor(&new_actor("whole", &[&id])).await.unwrap();
    for (class, name) in [
        (ActorClass::Vehicle, "vehicle"),
        (ActorClass::Pedestrian, "pedestrian"),
        (ActorClass::Bicycle, "bicycle"),
        (ActorClass::Object, "object"),
    ] {
        let mut asked = NewActor { class, ..new_actor(name, &[&id]) };
        asked.files[0].scale = Some(0.5);
        let made = client.push_actor(&asked).await.unwrap();
        assert_eq!((made.class, made.box_.length_m), (class, 0.5 * whole.box_.length_m));
        assert_eq!(get(&server, &format!("/v1/actors/{name}")).await.body["class"], name);
    }
}

#[tokio::test]
async fn a_pushed_vehicle_is_that_of_an_import() {
    let Some(truck) = crate::data::real("vehicles/CesiumMilkTruck.glb") else { return };
    let server = TestServer::start().await;
    let client = client(&server);
    let axes = "0 0 1 1 0 0 0 1 0";
    let wanted = imported(&truck, "truck", axes, RecordFormat::default(), 20_000);
    let mut asked = new_actor("truck", &[&upload(&client, &truck).await]);
    asked.files[0].axes = Some(axes.to_owned());
    asked.gaussians = Some(20_000);
    let made = client.push_actor(&asked).await.unwrap();
    assert_eq!(made.hash, wanted.hash);
    assert!(made.gaussians >= 20_000 && made.box_.width_m > 4.5, "{made:?}");

    // A vehicle that names its texture, in a folder next to it.
    let texture = "Textures/colormap-car.png";
    let van = crate::data::real("vehicles/kenney_carkit/van.glb").unwrap();
    let paint = van.parent().unwrap().join(texture);
    let wanted = imported(&van, "van", "identity", RecordFormat::default(), 200_000);
    let uploads = [upload(&client, &van).await, upload(&client, &paint).await];
    let mut asked = new_actor("van", &[&uploads[0], &uploads[1]]);
    let (_, _, message) = refusal(&client, &asked).await;
    assert!(message.contains(&format!("part {texture:?}: is not the name of")), "{message}");
    asked.files[1].name = Some(texture.to_owned());
    assert_eq!(client.push_actor(&asked).await.unwrap().hash, wanted.hash);
}

/// The image of an ego at rest, with an actor 6 m ahead that is drawn from an asset, or without
/// one.
async fn image_with(server: &TestServer, asset: Option<&str>) -> Vec<u8> {
    let mut actor = json!({ "name": "ahead", "stand": { "xyz": [6, 0, 0] } });
    match asset {
        Some(asset) => actor["asset"] = asset.into(),
        None => actor["size"] = json!([4.0, 2.0, 1.5]),
    }
    let scenario = json!({ "format": "wildcity.scenario/1", "name": "one", "twin": { "name": "test" },
                           "actors": [actor] });
    let mut agent = server.agent().await;
    let outputs = json!({ "cameras": ["front"], "encoding": "raw" });
    agent.open(json!({ "scenario": scenario, "outputs": outputs })).await;
    agent.look(json!({ "type": "reset" })).await;
    let seen = agent.step(0.5).await;
    let tensors = seen.tensors();
    tensors.tensor("camera/front/rgb").unwrap().data().to_vec()
}

#[tokio::test]
async fn a_session_that_opens_afterwards_drives_with_it() {
    let cpu = Arc::new(Cpu::new(2, Simd::Best).unwrap());
    let server = TestServer::configured(|config| config.backend = cpu).await;
    let scenario = json!({ "format": "wildcity.scenario/1", "name": "one", "twin": { "name": "test" },
                           "actors": [{ "name": "ahead", "asset": "ball", "stand": { "xyz": [6, 0, 0] } }] });
    let mut early = server.agent().await;
    refused(&early.try_open(json!({ "scenario": scenario })).await, "scenario_invalid");

    let client = client(&server);
    let id = upload_ply(&client, "ball.ply", &ball(3_000, 1)).await;
    let made = client.push_actor(&new_actor("ball", &[&id])).await.unwrap();
    let without = image_with(&server, None).await;
    let by_name = image_with(&server, Some("ball")).await;
    assert_ne!(by_name, without, "the asset is seen");
    assert_eq!(by_name, image_with(&server, Some(&made.hash)).await);
    // The session that was refused can open now.
    early.open(json!({ "scenario": scenario })).await;
}
