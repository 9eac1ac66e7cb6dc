//! Malicious bodies: each gets its own error, and the server keeps serving.

use serde_json::json;

use wildcity_client::PushState;

use crate::gltf_files::gltf;
use crate::http::{client, get, in_cell, new_push, post, send};
use crate::support::TestServer;

#[tokio::test]
async fn hostile_bodies() {
    let server = TestServer::start().await;
    let pushes = "/v1/twins/test/pushes";
    let raw = async |path: &str, body: &str| {
        let head = format!("POST {path} HTTP/1.1\r\nContent-Length: {}", body.len());
        send(server.address(), &head, body.as_bytes()).await
    };
    let deep = format!("{{\"x\": {}", "[".repeat(200_000));
    for path in ["/v1/uploads", pushes, "/v1/twins/test/rollback"] {
        assert_eq!(raw(path, &deep).await.status, 400);
        raw(path, "").await.refused(400, "malformed_json");
        raw(path, "\u{0}\u{1}").await.refused(400, "malformed_json");
        raw(path, "[]").await.refused(400, "invalid_request");
        assert_eq!(raw(path, "{} {}").await.status, 400);
    }
    assert_eq!(raw(pushes, &" ".repeat(2 << 20)).await.status, 413);
    let file = |more: serde_json::Value| {
        let mut file = json!({ "upload": "x" });
        file.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        json!({ "files": [file] })
    };
    let cells: Vec<_> = (0..50_000).map(|i| [i, i]).collect();
    for (body, code, field) in [
        (json!({ "files": [] }), "out_of_range", "files"),
        (json!({ "files": vec![json!({ "upload": "x" }); 257] }), "out_of_range", "files"),
        (json!({ "files": [{ "upload": "x" }], "colour": 1 }), "invalid_request", "colour"),
        (file(json!({ "axes": "sideways" })), "invalid_request", "files[0].axes"),
        (file(json!({ "scale": 0 })), "invalid_request", "files[0].scale"),
        (file(json!({ "scale": 1e300 })), "invalid_request", "files[0].scale"),
        (file(json!({ "name": "" })), "out_of_range", "files[0].name"),
        (json!({ "files": [{ "upload": 7 }] }), "invalid_request", "files[0].upload"),
        (json!({ "files": [{ "upload": "x" }], "cells": [] }), "out_of_range", "cells"),
        (json!({ "files": [{ "upload": "x" }], "record": "q1" }), "invalid_request", "record"),
        (
            json!({ "files": [{ "upload": "x" }], "profile": ["x=1"] }),
            "invalid_request",
            "profile[0]",
        ),
        (json!({ "files": [{ "upload": "x" }], "id": "../../etc" }), "invalid_name", "id"),
        (json!({ "files": [{ "upload": "x" }], "note": "n".repeat(1001) }), "out_of_range", "note"),
        (
            json!({ "files": [{ "upload": "x" }], "golden": { "poses": vec![crate::support::pose(0.0); 33] } }),
            "out_of_range",
            "golden.poses",
        ),
        (
            json!({ "files": [{ "upload": "x" }], "golden": { "poses": [{ "xyz": [1e9, 0, 0], "q": [1, 0, 0, 0] }] } }),
            "pose_invalid",
            "golden.poses[0].xyz[0]",
        ),
        (
            json!({ "files": [{ "upload": "x" }], "cells": cells }),
            "unknown_upload",
            "files[0].upload",
        ),
        (
            json!({ "files": [{ "upload": "../../../etc/passwd" }] }),
            "unknown_upload",
            "files[0].upload",
        ),
    ] {
        let refused = post(&server, pushes, &body).await;
        let status = if code == "unknown_upload" { 404 } else { 400 };
        refused.refused(status, code);
        assert_eq!(refused.body["field"], field, "{refused:?}");
    }
    for name in ["..", "a/b", "", "a".repeat(300).as_str(), "\n"] {
        let body = json!({ "name": name, "size": 1, "digest": format!("blake3:{:064}", 0) });
        let reply = post(&server, "/v1/uploads", &body).await;
        // A name is only shown and never used as a path; names with a separator are refused all the
        // same.
        assert!(reply.status == 400 || name == "..", "{name:?}: {reply:?}");
    }
    for digest in ["", "blake3:", "md5:00", &format!("blake3:{}", "G".repeat(64)), "blake3-/../x"] {
        let body = json!({ "name": "x", "size": 1, "digest": digest });
        post(&server, "/v1/uploads", &body).await.refused(400, "invalid_request");
    }
    for name in ["..%2f..%2fetc", "%2e%2e", "a%00b", "A", &"x".repeat(65)] {
        let ask = json!({ "files": [{ "upload": "x" }] });
        let reply = post(&server, &format!("/v1/twins/{name}/pushes"), &ask).await;
        assert!([400, 404].contains(&reply.status), "{name}: {reply:?}");
        assert!([400, 404].contains(&get(&server, &format!("/v1/twins/{name}")).await.status));
        assert_eq!(get(&server, &format!("/v1/uploads/{name}")).await.status, 404);
    }
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 1);
    server.still_serves().await;
}

/// A pushed scene may name the other files of its push, and nothing else that the server keeps.
#[tokio::test]
async fn a_pushed_scene_names_only_files_of_its_push() {
    let server = TestServer::start().await;
    let client = client(&server);
    let dir = tempfile::tempdir().unwrap();
    let upload = async |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        client.upload(&path, &mut |_, _| {}).await.unwrap().id
    };
    let pushed = async |uploads: &[&str]| {
        let begun = client.push("test", &new_push(uploads)).await.unwrap();
        client.wait_for_push(begun, &mut |_| {}).await.unwrap()
    };
    let scene = in_cell([0, 0], 40, 1);
    let (json, buffer) = gltf(&scene, "", r#""uri":"block.bin","#);
    let buffer_id = upload("block.bin", &buffer).await;
    let scene_id = upload("block.gltf", json.as_bytes()).await;
    // Another upload, by the name of its file in the server's directory.
    let stolen = json.replace("block.bin", &format!("{buffer_id}.data"));
    let stolen_id = upload("stolen.gltf", stolen.as_bytes()).await;

    for (uploads, part) in
        [(&stolen_id, format!("{buffer_id}.data")), (&scene_id, "block.bin".into())]
    {
        let refused = pushed(&[uploads]).await;
        assert_eq!(refused.state, PushState::Refused, "{refused:?}");
        let reason = refused.error.unwrap().message;
        assert!(reason.contains(&format!("part {part:?}: is not the name of")), "{reason}");
    }
    // A file that another file names is not a scene, wherever it is listed.
    for uploads in [[&*buffer_id, &*scene_id], [&*scene_id, &*buffer_id]] {
        let ready = pushed(&uploads).await;
        assert_eq!(ready.state, PushState::Ready, "{ready:?}");
        let report = ready.report.unwrap();
        assert_eq!((report.gaussians, report.files.len()), (40, 1));
    }
}
