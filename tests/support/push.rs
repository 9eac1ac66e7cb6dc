//! Raw HTTP, and pushes of small files.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use wildcity_client::{ConnectOptions, HttpClient, NewPush, PreviewRequest, Push, PushFile};
use wildcity_scene::Gaussians;

use crate::scene_files::{self, inria_columns, ply};
use crate::support::{self, TestServer};

/// An HTTP answer: its status, its header lines, its body, and its body if that is JSON.
#[derive(Debug)]
pub(crate) struct Reply {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) text: String,
    pub(crate) body: Value,
}

impl Reply {
    /// The value of a header; `name` is in lower case.
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.head.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
    }

    /// Asserts a refusal.
    pub(crate) fn refused(&self, status: u16, code: &str) {
        assert_eq!((self.status, self.body["code"].as_str()), (status, Some(code)), "{self:?}");
    }
}

/// Sends bytes unchanged on a new connection, and reads until the server closes.
pub(crate) async fn send(address: SocketAddr, head: &str, body: &[u8]) -> Reply {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let head = format!("{}\r\nHost: localhost\r\nConnection: close\r\n\r\n", head.trim_end());
    stream.write_all(head.as_bytes()).await.unwrap();
    // A server that refuses need not read all of it.
    let _ = stream.write_all(body).await;
    let mut answer = Vec::new();
    let read = stream.read_to_end(&mut answer);
    let read = tokio::time::timeout(support::TEST_TIMEOUT, read).await.expect("an answer in time");
    read.unwrap();
    let text = String::from_utf8(answer).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
    let status = head.split(' ').nth(1).expect("a status").parse().unwrap();
    let text = body.to_owned();
    let body = serde_json::from_str(body).unwrap_or(Value::Null);
    Reply { status, head: head.to_owned(), text, body }
}

/// Sends JSON.
pub(crate) async fn post(server: &TestServer, path: &str, body: &Value) -> Reply {
    let body = body.to_string();
    let head = format!("POST {path} HTTP/1.1\r\nContent-Length: {}", body.len());
    send(server.address(), &head, body.as_bytes()).await
}

pub(crate) async fn get(server: &TestServer, path: &str) -> Reply {
    send(server.address(), &format!("GET {path} HTTP/1.1"), b"").await
}

pub(crate) fn client(server: &TestServer) -> HttpClient {
    HttpClient::new(&format!("http://{}", server.address()), &ConnectOptions::default()).unwrap()
}

/// Writes Gaussians as a PLY file with INRIA's columns.
pub(crate) fn write(dir: &Path, name: &str, gaussians: &Gaussians) -> PathBuf {
    let path = dir.join(name);
    let columns = inria_columns(gaussians.sh_degree, false);
    std::fs::write(&path, ply(gaussians, &columns)).unwrap();
    path
}

/// A push of some uploads, with every default.
pub(crate) fn new_push(uploads: &[&str]) -> NewPush {
    let file = |id: &&str| PushFile {
        upload: (*id).to_owned(),
        axes: Some("identity".to_owned()),
        scale: Some(1.0),
        name: None,
    };
    NewPush {
        id: None,
        files: uploads.iter().map(file).collect(),
        frame: None,
        base: None,
        cells: None,
        record: None,
        levels: true,
        profile: Vec::new(),
        note: None,
        preview: PreviewRequest::default(),
        drop_bad: false,
    }
}

/// Uploads a scene, pushes it with the options that `change` sets, and waits for the end.
pub(crate) async fn push(
    server: &TestServer,
    gaussians: &Gaussians,
    change: impl FnOnce(&mut NewPush),
) -> Push {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "scene.ply", gaussians);
    let client = client(server);
    let upload = client.upload(&path, &mut |_, _| {}).await.unwrap();
    let mut asked = new_push(&[&upload.id]);
    change(&mut asked);
    let begun = client.push("test", &asked).await.unwrap();
    client.wait_for_push(begun, &mut |_| {}).await.unwrap()
}

/// Gaussians in one cell, about its centre.
pub(crate) fn in_cell(cell: [i32; 2], count: usize, seed: u64) -> Gaussians {
    let mut gaussians = scene_files::gaussians(count, 0, 8.0, seed);
    for mean in &mut gaussians.means_m {
        mean[0] += 64.0 * f64::from(cell[0]);
        mean[1] += 64.0 * f64::from(cell[1]);
    }
    gaussians
}
