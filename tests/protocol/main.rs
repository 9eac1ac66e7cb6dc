//! The protocol: schemas, golden vectors, damaged frames, and the Rust client against a server that
//! answers with the golden vectors.
//!
//! Schemas and vectors are generated from the types by these tests. After a change of the types run
//! `WILDCITY_BLESS=1 cargo test -p wildcity-client --test protocol`, and review the difference.

#[path = "../support/root.rs"]
mod root;

mod client;
mod damaged;
mod dependencies;
mod fake_server;
mod frames;
mod messages;
mod observations;
mod readme;
mod schema;
mod tls;

use std::fs;
use std::path::PathBuf;

/// A file of the project's `protocol` folder.
fn protocol_path(name: &str) -> PathBuf {
    root::root().join("protocol").join(name)
}

/// Whether the tests write the files instead of comparing them.
fn blessing() -> bool {
    std::env::var_os("WILDCITY_BLESS").is_some_and(|value| value == "1")
}

/// A file of the `protocol` folder.
fn read(name: &str) -> Vec<u8> {
    let path = protocol_path(name);
    fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Compares a file with its expected contents, or writes it when blessing.
fn check_file(name: &str, contents: &[u8]) {
    let path = protocol_path(name);
    if blessing() {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, contents).unwrap();
        return;
    }
    assert!(
        fs::read(&path).is_ok_and(|found| found == contents),
        "{} differs from what the types in protocol/src give. If that is intended: \
         WILDCITY_BLESS=1 cargo test -p wildcity-client --test protocol",
        path.display()
    );
}

/// As [`check_file`], for a value as indented JSON.
fn check_json(name: &str, value: &impl serde::Serialize) {
    let mut text = serde_json::to_string_pretty(value).unwrap();
    text.push('\n');
    check_file(name, text.as_bytes());
}
