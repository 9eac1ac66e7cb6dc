//! Requests and files that are no actor are refused, and leave nothing.

use serde_json::{Value, json};
use wildcity_scene::RecordFormat;

use crate::gltf_files::gltf;
use crate::http::{client, get, in_cell, post, send};
use crate::support::TestServer;

use super::{ball, imported, new_actor, nothing_is_stored, refusal, upload, upload_ply};

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
    // Another file of the same name, so that the name stands for neither.
    let mut other = buffer.clone();
    other[0] ^= 1;
    let other_id = bytes("block.bin", &other).await;
    let ambiguous = bytes("ambiguous.gltf", json.as_bytes()).await;
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
        (vec![ambiguous, buffer_id.clone(), other_id], "is not the name of"),
        (vec![upload_ply(&client, "empty.ply", &ball(0, 4)).await], "no Gaussians"),
        (vec![bytes("alone.gltf", json.as_bytes()).await], "is not the name of"),
    ] {
        let uploads: Vec<&str> = uploads.iter().map(|id| &**id).collect();
        let (status, code, message) = refusal(&client, &new_actor("thing", &uploads)).await;
        assert_eq!((status, &*code), (422, "push_refused"), "{message}");
        assert!(message.contains(why), "not {why:?}: {message}");
    }
    nothing_is_stored(&server).await;

    // With the file that it names, the scene is an actor of one file.
    let scene_id = bytes("block.gltf", json.as_bytes()).await;
    let made = client.push_actor(&new_actor("block", &[&buffer_id, &scene_id])).await.unwrap();
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
