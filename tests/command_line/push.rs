//! `wildcity push`, as users run it.

use std::process::Command;

use crate::http::{get, in_cell, write};
use crate::support::TestServer;

#[tokio::test(flavor = "multi_thread")]
async fn a_file_is_pushed_and_reported() {
    let server = TestServer::start().await;
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), "block.ply", &in_cell([0, 0], 40, 1));
    let run = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_wildcity"))
            .arg("push")
            .arg(&path)
            .args(["--twin", "test", "--server", &format!("http://{}", server.address())])
            .args(arguments)
            .output()
            .unwrap()
    };
    let done = tokio::task::block_in_place(|| run(&["--cells", "0,0", "--note", "first"]));
    let (out, err) =
        (String::from_utf8(done.stdout).unwrap(), String::from_utf8(done.stderr).unwrap());
    assert!(done.status.success(), "{out}{err}");
    for line in
        ["block.ply: 40 Gaussians", "1: 32 Gaussians before, 40 after", "version 2 is ready"]
    {
        assert!(out.contains(line), "no {line:?} in {out}");
    }
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 2);

    let done = tokio::task::block_in_place(|| run(&["--cells", "9,9"]));
    let err = String::from_utf8(done.stderr).unwrap();
    assert!(!done.status.success() && err.contains("(9, 9)"), "{err}");
    let done = tokio::task::block_in_place(|| run(&["--base", "1"]));
    // The change since the base is this same content, as after a lost answer.
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let done = tokio::task::block_in_place(|| run(&["--cells", "x"]));
    assert!(!done.status.success());
    assert_eq!(get(&server, "/v1/twins/test").await.body["version"], 3);
}
