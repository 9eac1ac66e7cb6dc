//! Assets of actors over HTTP: what is pushed is what `wildcity actor import` makes, sessions drive among it, and
//! whatever goes wrong leaves nothing.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use wildcity_client::{ActorClass, HttpClient, HttpError, NewActor, Push, PushFile};
use wildcity_push::{AssetSettings, AssetSource, SourceAxes, SourceScene, make_asset, read_actor};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::{Gaussians, RecordFormat};
use wildcity_server::Limits;
use wildcity_twin::store::{Catalog, StoredActor};

use crate::gltf_files::gltf;
use crate::http::{client, get, in_cell, post, push_of, send, write};
use crate::metrics::scrape;
use crate::support::{TEST_TIMEOUT, TestServer, refused};

/// A ball of Gaussians 2 m in radius.
fn ball(count: usize, seed: u64) -> Gaussians {
    let mut gaussians = in_cell([0, 0], count, seed);
    gaussians.means_m.iter_mut().flatten().for_each(|m| *m *= 0.25);
    gaussians
}

fn actor_of(name: &str, uploads: &[&str]) -> NewActor {
    let file = |id: &&str| PushFile {
        upload: (*id).to_owned(),
        axes: "identity".to_owned(),
        scale: 1.0,
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

async fn upload(client: &HttpClient, path: &Path) -> String {
    client.upload(path, &mut |_, _| {}).await.unwrap().id
}

/// Uploads Gaussians as a PLY file.
async fn upload_ply(client: &HttpClient, name: &str, gaussians: &Gaussians) -> String {
    let dir = tempfile::tempdir().unwrap();
    upload(client, &write(dir.path(), name, gaussians)).await
}

/// What `wildcity actor import` stores of a file.
fn imported(path: &Path, name: &str, axes: &str, record: RecordFormat, count: u32) -> StoredActor {
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

/// Asserts that no asset is there, and no part of one.
async fn nothing_is_stored(server: &TestServer) {
    assert_eq!(get(server, "/v1/actors").await.body, json!({ "actors": [] }));
    let objects = server.twins.path().join(".actors/objects");
    let entries = std::fs::read_dir(objects).map(Iterator::count).unwrap_or(0);
    assert_eq!(entries, 0, "objects that no list has");
}

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

    // Once more it is there already. Other options make another asset.
    let again = post(&server, "/v1/actors", &asked).await;
    assert_eq!((again.status, &again.body), (200, &made.body));
    asked["record"] = "q24".into();
    let taken = post(&server, "/v1/actors", &asked).await;
    taken.refused(409, "conflict");
    assert_eq!(taken.body["field"], "name");
    asked["name"] = "small".into();
    let small = post(&server, "/v1/actors", &asked).await;
    assert_eq!(small.status, 201, "{small:?}");

    let listed = client.actors().await.unwrap();
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
async fn a_pushed_vehicle_is_that_of_an_import() {
    let Some(truck) = crate::data::real("vehicles/CesiumMilkTruck.glb") else { return };
    let server = TestServer::start().await;
    let client = client(&server);
    let axes = "0 0 1 1 0 0 0 1 0";
    let wanted = imported(&truck, "truck", axes, RecordFormat::default(), 20_000);
    let mut asked = actor_of("truck", &[&upload(&client, &truck).await]);
    asked.files[0].axes = axes.to_owned();
    asked.gaussians = Some(20_000);
    let made = client.push_actor(&asked).await.unwrap();
    assert_eq!(made.hash, wanted.hash);
    assert!(made.gaussians >= 20_000 && made.box_.width_m > 4.5, "{made:?}");

    // A vehicle that names its texture, in a folder beside it.
    let texture = "Textures/colormap-car.png";
    let van = crate::data::real("vehicles/kenney_carkit/van.glb").unwrap();
    let paint = van.parent().unwrap().join(texture);
    let wanted = imported(&van, "van", "identity", RecordFormat::default(), 200_000);
    let uploads = [upload(&client, &van).await, upload(&client, &paint).await];
    let mut asked = actor_of("van", &[&uploads[0], &uploads[1]]);
    let (_, _, message) = refusal(&client, &asked).await;
    assert!(message.contains(&format!("part {texture:?}: is not the name of")), "{message}");
    asked.files[1].name = Some(texture.to_owned());
    assert_eq!(client.push_actor(&asked).await.unwrap().hash, wanted.hash);
}

/// The image of an ego at rest, with an actor 6 m ahead that is drawn from an asset, or from none.
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
    let made = client.push_actor(&actor_of("ball", &[&id])).await.unwrap();
    let without = image_with(&server, None).await;
    let by_name = image_with(&server, Some("ball")).await;
    assert_ne!(by_name, without, "the asset is seen");
    assert_eq!(by_name, image_with(&server, Some(&made.hash)).await);
    // The session that was refused can open now.
    early.open(json!({ "scenario": scenario })).await;
}

#[tokio::test]
async fn every_bad_request_has_its_code_and_field() {
    let server = TestServer::start().await;
    let whole = json!({ "name": "a", "class": "vehicle", "files": [{ "upload": "x" }] });
    let with = |field: &str, value: Value| {
        let mut body = whole.clone();
        body[field] = value;
        body
    };
    let without = |field: &str| {
        let mut body = whole.clone();
        body.as_object_mut().unwrap().remove(field);
        body
    };
    let file = |more: Value| {
        let mut file = json!({ "upload": "x" });
        file.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        with("files", json!([file]))
    };
    for (body, code, field) in [
        (without("name"), "invalid_request", "name"),
        (without("class"), "invalid_request", "class"),
        (without("files"), "invalid_request", "files"),
        (with("name", json!("")), "invalid_name", "name"),
        (with("name", json!("../car")), "invalid_name", "name"),
        (with("name", json!("x".repeat(65))), "invalid_name", "name"),
        (with("name", json!(7)), "invalid_request", "name"),
        (with("class", json!("tank")), "invalid_request", "class"),
        (with("class", json!("Vehicle")), "invalid_request", "class"),
        (with("class", json!(null)), "invalid_request", "class"),
        (with("files", json!([])), "out_of_range", "files"),
        (with("files", json!(vec![json!({ "upload": "x" }); 257])), "out_of_range", "files"),
        (with("files", json!("x")), "invalid_request", "files"),
        (with("files", json!([{}])), "invalid_request", "files[0].upload"),
        (with("files", json!([{ "upload": 7 }])), "invalid_request", "files[0].upload"),
        (with("colour", json!("red")), "invalid_request", "colour"),
        (with("gaussians", json!(999)), "out_of_range", "gaussians"),
        (with("gaussians", json!(1_000_001)), "out_of_range", "gaussians"),
        (with("gaussians", json!(-1)), "out_of_range", "gaussians"),
        (with("gaussians", json!(2.5)), "invalid_request", "gaussians"),
        (with("gaussians", json!("many")), "invalid_request", "gaussians"),
        (with("record", json!("q1")), "invalid_request", "record"),
        (file(json!({ "axes": "sideways" })), "invalid_request", "files[0].axes"),
        (file(json!({ "scale": 0 })), "invalid_request", "files[0].scale"),
        (file(json!({ "scale": 1e300 })), "invalid_request", "files[0].scale"),
        (file(json!({ "size": 1 })), "invalid_request", "files[0].size"),
        (file(json!({ "name": "" })), "out_of_range", "files[0].name"),
        (file(json!({ "name": "a\nb" })), "out_of_range", "files[0].name"),
        (file(json!({ "name": "n".repeat(1025) })), "out_of_range", "files[0].name"),
        (whole.clone(), "unknown_upload", "files[0].upload"),
        (file(json!({ "upload": "../../../etc/passwd" })), "unknown_upload", "files[0].upload"),
    ] {
        let reply = post(&server, "/v1/actors", &body).await;
        let status = if code == "unknown_upload" { 404 } else { 400 };
        reply.refused(status, code);
        assert_eq!(reply.body["field"], field, "{body}: {reply:?}");
    }
    for path in ["..%2f..%2fetc", "%2e%2e", "a%00b", "A", &"x".repeat(300)] {
        get(&server, &format!("/v1/actors/{path}")).await.refused(404, "unknown_actor");
    }
    let head = "DELETE /v1/actors/x HTTP/1.1";
    assert_eq!(send(server.address(), head, b"").await.status, 405);
    nothing_is_stored(&server).await;
    server.still_serves().await;
}

/// The refusal of a push whose request is good and whose files are not.
async fn refusal(client: &HttpClient, actor: &NewActor) -> (u16, String, String) {
    match client.push_actor(actor).await {
        Err(HttpError::Refused { status, code, message, .. }) => {
            let code = serde_json::to_value(code).unwrap();
            (status, code.as_str().unwrap().to_owned(), message)
        }
        other => panic!("not refused: {other:?}"),
    }
}

#[tokio::test]
async fn files_that_are_no_actor_are_refused_with_their_reason() {
    let server = TestServer::start().await;
    let client = client(&server);
    let dir = tempfile::tempdir().unwrap();
    let mut nan = ball(500, 1);
    nan.means_m[17][1] = f64::NAN;
    let scene = ball(40, 3);
    let whole = crate::gltf_files::glb(gltf(&scene, "", ""));
    let (json, buffer) = gltf(&scene, "", r#""uri":"block.bin","#);
    let bytes = async |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        upload(&client, &path).await
    };
    let buffer_id = bytes("block.bin", &buffer).await;
    // Another upload, by the name of its file in the server's directory.
    let stolen = json.replace("block.bin", &format!("{buffer_id}.data"));
    let million = upload_ply(&client, "million.ply", &ball(1_000_001, 2)).await;
    for (uploads, why) in [
        (vec![upload_ply(&client, "nan.ply", &nan).await], "nan.ply: Gaussian 17: y is NaN"),
        (
            vec![upload_ply(&client, "street.ply", &in_cell([3, 0], 40, 1)).await, million.clone()],
            "length_m is",
        ),
        (vec![million.clone(), million], "at most 2000000 are accepted"),
        (vec![bytes("cut.glb", &whole[..whole.len() / 2]).await], "cut.glb: "),
        (vec![bytes("text.ply", b"ply\nformat").await], "text.ply: "),
        (vec![bytes("none.txt", b"no scene").await], "none.txt: "),
        (
            vec![bytes("stolen.gltf", stolen.as_bytes()).await, buffer_id.clone()],
            "is not the name of",
        ),
        (vec![bytes("alone.gltf", json.as_bytes()).await], "is not the name of"),
    ] {
        let uploads: Vec<&str> = uploads.iter().map(|id| &**id).collect();
        let (status, code, message) = refusal(&client, &actor_of("thing", &uploads)).await;
        assert_eq!((status, &*code), (422, "push_refused"), "{message}");
        assert!(message.contains(why), "not {why:?}: {message}");
    }
    nothing_is_stored(&server).await;

    // With the file that it names, the scene is an actor of one file.
    let scene_id = bytes("block.gltf", json.as_bytes()).await;
    let made = client.push_actor(&actor_of("block", &[&buffer_id, &scene_id])).await.unwrap();
    std::fs::write(dir.path().join("block.bin"), &buffer).unwrap();
    let path = dir.path().join("block.gltf");
    let wanted = imported(&path, "block", "identity", RecordFormat::default(), 200_000);
    assert_eq!((made.gaussians, made.hash), (40, wanted.hash));
    server.still_serves().await;
}

#[tokio::test]
async fn an_unfinished_upload_is_refused() {
    let server = TestServer::start().await;
    let digest = format!("blake3:{}", blake3::hash(b"ten bytes.").to_hex());
    let announced = json!({ "name": "x", "size": 10, "digest": digest });
    let begun = post(&server, "/v1/uploads", &announced).await;
    let id = begun.body["id"].as_str().unwrap();
    let body = json!({ "name": "a", "class": "object", "files": [{ "upload": id }] });
    let reply = post(&server, "/v1/actors", &body).await;
    reply.refused(400, "out_of_range");
    assert_eq!(reply.body["field"], "files[0].upload");
    assert!(reply.body["message"].as_str().unwrap().contains("0 of 10 bytes"), "{reply:?}");
    nothing_is_stored(&server).await;
}

/// Waits until the metrics have a line.
async fn metrics_have(server: &TestServer, line: &str) {
    let found = async {
        while !scrape(server).await.lines().any(|found| found == line) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, found).await.unwrap_or_else(|_| panic!("no {line}"));
}

/// Sends the request of a push, and keeps the connection open.
async fn begin(server: &TestServer, asked: &NewActor) -> TcpStream {
    let body = serde_json::to_string(asked).unwrap();
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let head = format!(
        "POST /v1/actors HTTP/1.1\r\nHost: localhost\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    stream.write_all(format!("{head}{body}").as_bytes()).await.unwrap();
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_goes_away_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let audit = dir.path().join("audit.jsonl");
    let server = TestServer::configured(|config| config.audit = Some(audit.clone())).await;
    let client = client(&server);
    // Reading these and making their levels of detail takes seconds.
    let id = upload_ply(&client, "large.ply", &ball(1_000_000, 1)).await;
    let stream = begin(&server, &actor_of("large", &[&id])).await;
    metrics_have(&server, "wildcity_pushes_open 1").await;
    drop(stream);
    metrics_have(&server, "wildcity_pushes_total{outcome=\"failed\"} 1").await;
    metrics_have(&server, "wildcity_pushes_open 0").await;
    nothing_is_stored(&server).await;
    let text = std::fs::read_to_string(&audit).unwrap();
    assert!(text.lines().last().unwrap().contains("the push was cancelled"), "{text}");
    // Sent again, it is made; by then the threads of the first are done, and have stored nothing.
    let made = client.push_actor(&actor_of("large", &[&id])).await.unwrap();
    let listed = client.actors().await.unwrap();
    assert_eq!((listed.len(), &listed[0].hash), (1, &made.hash));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_stops_leaves_nothing_half_made() {
    let server = TestServer::start().await;
    let client = client(&server);
    let id = upload_ply(&client, "large.ply", &ball(1_000_000, 1)).await;
    let pushing = client.clone();
    let asked = actor_of("large", &[&id]);
    let pushed = tokio::spawn(async move { pushing.push_actor(&asked).await });
    metrics_have(&server, "wildcity_pushes_open 1").await;
    let TestServer { running, twins, .. } = server;
    running.stop().await;
    match pushed.await.unwrap() {
        Err(HttpError::Refused { status, .. }) => assert_eq!(status, 503),
        Err(HttpError::NoAnswer { .. }) => {}
        other => panic!("{other:?}"),
    }
    // The threads go on for a moment.
    tokio::time::sleep(Duration::from_secs(3)).await;
    let catalog = Catalog::open(twins.path()).unwrap();
    assert_eq!(catalog.actors().unwrap(), []);
    assert!(!twins.path().join(".actors/objects").exists());
}

#[tokio::test]
async fn a_push_of_an_asset_has_a_time_limit_and_waits_for_memory() {
    let limits = Limits { push: Duration::from_millis(30), ..Limits::default() };
    let server = TestServer::with(limits).await;
    let slow = client(&server);
    let id = upload_ply(&slow, "large.ply", &ball(500_000, 1)).await;
    let (status, code, message) = refusal(&slow, &actor_of("large", &[&id])).await;
    assert_eq!((status, &*code), (422, "push_refused"), "{message}");
    assert!(message.contains("took longer than"), "{message}");
    tokio::time::sleep(Duration::from_secs(2)).await;
    nothing_is_stored(&server).await;

    // While a push of a twin has all of the memory, one of an asset waits.
    let limits = Limits { push_memory_bytes: Some(1 << 20), ..Limits::default() };
    let server = TestServer::with(limits).await;
    let client = client(&server);
    let twin = upload_ply(&client, "twin.ply", &in_cell([0, 0], 40, 1)).await;
    let small = upload_ply(&client, "small.ply", &ball(40, 2)).await;
    server.painter.slow_ms.store(300, Ordering::SeqCst);
    let begun = client.push("test", &push_of(&[&twin])).await.unwrap();
    let asked = actor_of("small", &[&small]);
    let made = async {
        let made = client.push_actor(&asked).await.unwrap();
        (made.gaussians, get(&server, "/v1/twins/test").await.body["version"].clone())
    };
    let ignored = &mut |_: &Push| {};
    let ended = client.wait_for_push(begun, ignored);
    let ((gaussians, version), ended) = tokio::join!(made, ended);
    assert_eq!((gaussians, version), (40, json!(2)), "{ended:?}");
}

#[tokio::test]
async fn pushes_of_assets_count_among_the_open_ones() {
    let limits = Limits { pushes: 1, ..Limits::default() };
    let server = TestServer::with(limits).await;
    let client = client(&server);
    let twin = upload_ply(&client, "twin.ply", &in_cell([0, 0], 40, 1)).await;
    let small = upload_ply(&client, "small.ply", &ball(40, 2)).await;
    server.painter.slow_ms.store(300, Ordering::SeqCst);
    let begun = client.push("test", &push_of(&[&twin])).await.unwrap();
    let (status, code, message) = refusal(&client, &actor_of("small", &[&small])).await;
    assert_eq!((status, &*code), (503, "busy"), "{message}");
    client.wait_for_push(begun, &mut |_| {}).await.unwrap();
    client.push_actor(&actor_of("small", &[&small])).await.unwrap();
}
