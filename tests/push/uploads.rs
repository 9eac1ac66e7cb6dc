//! Uploads: resumed, checked, limited; no file is left of an upload that is refused.

use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use wildcity_server::{Limits, SpoolLimits};

use crate::http::{Reply, get, post, send};
use crate::support::{TEST_TIMEOUT, TestServer};

fn content(size: usize) -> Vec<u8> {
    (0..size).map(|i| (i * i % 251) as u8).collect()
}

async fn begin(server: &TestServer, content: &[u8]) -> Reply {
    let digest = format!("blake3:{}", blake3::hash(content).to_hex());
    let body = json!({ "name": "scene.ply", "size": content.len(), "digest": digest });
    post(server, "/v1/uploads", &body).await
}

async fn append(server: &TestServer, path: &str, offset: u64, more: &str, body: &[u8]) -> Reply {
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nUpload-Offset: {offset}\r\nContent-Length: {}\r\n{more}",
        body.len()
    );
    send(server.address(), &head, body).await
}

/// Names of the files in the spool, but for its lock.
fn spooled(server: &TestServer) -> Vec<String> {
    let entries = std::fs::read_dir(server.twins.path().join(".uploads")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<_> = names.filter(|name| name != "lock").collect();
    names.sort();
    names
}

/// Waits until an upload has `offset` bytes.
async fn reaches(server: &TestServer, path: &str, offset: u64) -> Value {
    let reached = async {
        loop {
            let body = get(server, path).await.body;
            if body["offset"] == offset {
                return body;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, reached).await.expect("the bytes arrive")
}

#[tokio::test]
async fn an_upload_that_is_cut_goes_on_where_it_stopped() {
    let server = TestServer::start().await;
    let content = content(3 << 20);
    let begun = begin(&server, &content).await;
    assert_eq!(begun.status, 201, "{begun:?}");
    let path = begun.header("location").unwrap().to_owned();
    assert_eq!(begun.header("upload-offset"), Some("0"));
    // Half of the announced bytes, and then the connection is cut.
    let mut stream = TcpStream::connect(server.address()).await.unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: localhost\r\nUpload-Offset: 0\r\nContent-Length: {}\r\n\r\n",
        content.len()
    );
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.write_all(&content[..1_500_000]).await.unwrap();
    stream.shutdown().await.unwrap();
    let half = reaches(&server, &path, 1_500_000).await;
    assert_eq!((&half["complete"], &half["size"]), (&json!(false), &json!(content.len())));
    let head = send(server.address(), &format!("HEAD {path} HTTP/1.1"), b"").await;
    assert_eq!(head.header("upload-offset"), Some("1500000"));
    // Announced again, it is the same upload.
    let again = begin(&server, &content).await;
    assert_eq!((again.status, &again.body["offset"]), (201, &json!(1_500_000)));
    let end = append(&server, &path, 1_500_000, "", &content[1_500_000..]).await;
    assert_eq!((end.status, &end.body["complete"]), (200, &json!(true)), "{end:?}");
    assert_eq!(begin(&server, &content).await.status, 200, "known content needs no bytes");
    assert_eq!(spooled(&server).len(), 2, "the file and what was announced");
}

#[tokio::test]
async fn an_incomplete_upload_survives_a_restart_and_stray_files_do_not() {
    let server = TestServer::start().await;
    let content = content(100_000);
    let path = begin(&server, &content).await.header("location").unwrap().to_owned();
    append(&server, &path, 0, "", &content[..60_000]).await;
    let twins = server.twins.path().to_owned();
    let hash = blake3::hash(b"never announced").to_hex();
    let orphans = ["part", "gone"].map(|kind| format!("blake3-{hash}.{kind}"));
    let other = "notes.txt";
    for name in orphans.iter().map(String::as_str).chain([other]) {
        std::fs::write(twins.join(".uploads").join(name), b"x").unwrap();
    }
    let TestServer { running, twins: kept, .. } = server;
    running.stop().await;
    let server =
        TestServer::configured(|config| config.directories.uploads = twins.join(".uploads")).await;
    assert_eq!(get(&server, &path).await.body["offset"], 60_000);
    let end = append(&server, &path, 60_000, "", &content[60_000..]).await;
    assert_eq!(end.body["complete"], true, "{end:?}");
    assert!(orphans.iter().all(|orphan| !twins.join(".uploads").join(orphan).exists()));
    assert!(twins.join(".uploads").join(other).exists(), "a file of another name stays");
    drop(kept);
}

#[tokio::test]
async fn two_servers_do_not_share_a_spool() {
    let server = TestServer::start().await;
    let spool = server.twins.path().join(".uploads");
    let second = TestServer::configured(|config| config.directories.uploads = spool).await;
    let refused = begin(&second, b"x").await;
    refused.refused(503, "busy");
    assert!(refused.body["message"].as_str().unwrap().contains("--uploads"), "{refused:?}");
    second.still_serves().await;
    assert_eq!(begin(&server, b"x").await.status, 201);
}

#[tokio::test]
async fn an_upload_that_does_not_match_its_announcement_is_removed() {
    let server = TestServer::start().await;
    let good = content(5000);
    let bad = [&content(4999)[..], b"!"].concat();
    let path = begin(&server, &good).await.header("location").unwrap().to_owned();
    append(&server, &path, 0, "", &bad).await.refused(422, "upload_digest");
    get(&server, &path).await.refused(404, "unknown_upload");
    assert_eq!(spooled(&server), Vec::<String>::new());

    // An upload of no bytes is checked at once.
    let digest = format!("blake3:{:064}", 0);
    let empty = json!({ "name": "empty.ply", "size": 0, "digest": digest });
    for _ in 0..2 {
        post(&server, "/v1/uploads", &empty).await.refused(422, "upload_digest");
        assert_eq!(spooled(&server), Vec::<String>::new());
    }

    let path = begin(&server, &good).await.header("location").unwrap().to_owned();
    append(&server, &path, 1, "", &good[1..]).await.refused(409, "upload_offset");
    let at = append(&server, &path, 1, "", &good[1..]).await.body["offset"].clone();
    assert_eq!(at, 0, "a wrong offset is told the right one");
    // Too long by its Content-Length, and by the bytes that come.
    append(&server, &path, 0, "", &[&good[..], b"x"].concat()).await.refused(422, "upload_digest");
    let chunked = "PATCH {path} HTTP/1.1\r\nUpload-Offset: 0\r\nTransfer-Encoding: chunked";
    let body = [format!("{:x}\r\n", good.len() + 1).as_bytes(), &good, b"x\r\n0\r\n\r\n"].concat();
    let chunked = chunked.replace("{path}", &path);
    send(server.address(), &chunked, &body).await.refused(422, "upload_digest");
    assert_eq!(get(&server, &path).await.body["offset"], 0, "nothing of it stays");
    // RFC 9530: a digest of only this body.
    let wrong = "Content-Digest: sha-256=:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=:";
    append(&server, &path, 0, wrong, &good[..100]).await.refused(422, "upload_digest");
    assert_eq!(get(&server, &path).await.body["offset"], 0);
    append(&server, &path, 0, "Content-Digest: sha-256=:x:", b"x")
        .await
        .refused(400, "invalid_request");
    let digest =
        "Content-Digest: sha-512=:eA==:, sha-256=:LCa0a2j/xo/5m0U8HTBBNBNCLXBkg7+g+YpeiGJm564=:";
    let first = append(&server, &path, 0, digest, b"foo").await;
    assert_eq!((first.status, &first.body["offset"]), (200, &json!(3)), "{first:?}");
    send(server.address(), &format!("PATCH {path} HTTP/1.1\r\nContent-Length: 0"), b"")
        .await
        .refused(400, "invalid_request");
    let gone = send(server.address(), &format!("DELETE {path} HTTP/1.1"), b"").await;
    assert_eq!(gone.status, 204);
    assert_eq!(spooled(&server), Vec::<String>::new());
}

#[tokio::test]
async fn an_upload_with_a_sha_256() {
    let server = TestServer::start().await;
    let hex = "2c26b46b68ffc68ff99b453c1d30413413422d706483bfa0f98a5e886266e7ae";
    let body = json!({ "name": "foo", "size": 3, "digest": format!("sha-256:{hex}") });
    let begun = post(&server, "/v1/uploads", &body).await;
    let path = begun.header("location").unwrap().to_owned();
    assert_eq!(append(&server, &path, 0, "", b"foo").await.body["complete"], true);
    let other = json!({ "name": "foo", "size": 4, "digest": format!("sha-256:{hex}") });
    post(&server, "/v1/uploads", &other).await.refused(422, "upload_digest");
}

#[tokio::test]
async fn the_spool_has_its_limits() {
    let spool = SpoolLimits { uploads: 2, bytes: 1000, ..SpoolLimits::default() };
    let server = TestServer::with(Limits { spool, ..Limits::default() }).await;
    let full = begin(&server, &content(1001)).await;
    full.refused(507, "storage_full");
    let one = content(600);
    let path = begin(&server, &one).await.header("location").unwrap().to_owned();
    begin(&server, &content(401)).await.refused(507, "storage_full");
    assert_eq!(begin(&server, &content(400)).await.status, 201);
    begin(&server, &content(0)).await.refused(507, "storage_full");
    // A finished one makes room for a new one.
    append(&server, &path, 0, "", &one).await;
    assert_eq!(begin(&server, &content(599)).await.status, 201);
    get(&server, &path).await.refused(404, "unknown_upload");
    assert_eq!(spooled(&server).len(), 4);

    let huge = json!({ "name": "x", "size": u64::MAX, "digest": format!("blake3:{:064}", 0) });
    post(&server, "/v1/uploads", &huge).await.refused(400, "out_of_range");
}

#[tokio::test]
async fn an_upload_that_is_too_old_is_removed() {
    let spool = SpoolLimits { age: Duration::from_millis(50), ..SpoolLimits::default() };
    let server = TestServer::with(Limits { spool, ..Limits::default() }).await;
    begin(&server, b"left alone").await;
    let gone = async {
        while !spooled(&server).is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, gone).await.expect("it is removed");
}

/// The client reconnects while the server still waits for bytes on the old connection.
#[tokio::test]
async fn a_new_connection_takes_the_upload_over() {
    let server = TestServer::start().await;
    let content = content(2_000_000);
    let path = begin(&server, &content).await.header("location").unwrap().to_owned();
    let mut stalled = TcpStream::connect(server.address()).await.unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: localhost\r\nUpload-Offset: 0\r\nContent-Length: {}\r\n\r\n",
        content.len()
    );
    stalled.write_all(head.as_bytes()).await.unwrap();
    stalled.write_all(&content[..1_100_000]).await.unwrap();
    // The first MiB is written to disk; the rest is only in memory.
    let reached = async {
        loop {
            let offset = get(&server, &path).await.body["offset"].as_u64().unwrap();
            if offset >= 1 << 20 {
                return offset;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let offset = tokio::time::timeout(TEST_TIMEOUT, reached).await.unwrap();
    let end = append(&server, &path, offset, "", &content[offset as usize..]).await;
    assert_eq!(end.body["complete"], true, "{end:?}");
}
