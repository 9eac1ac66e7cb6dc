//! The wire: schemas, golden vectors, damaged frames, and the Rust client against a server that
//! speaks from the vectors.
//!
//! Schemas and vectors are generated from the types by these tests. After a change of the wire:
//! `WILDCITY_BLESS=1 cargo test --release --test protocol`, and look at the difference.

mod client;
mod damaged;
mod fake_server;
mod frames;
mod messages;
mod observations;
mod readme;
mod schema;

use std::fs;
use std::path::PathBuf;

/// A file of the project's `protocol` folder.
fn protocol_path(name: &str) -> PathBuf {
    root().join("protocol").join(name)
}

/// Whether files are to be written rather than compared.
fn blessing() -> bool {
    std::env::var_os("WILDCITY_BLESS").is_some_and(|value| value == "1")
}

/// A file of the `protocol` folder.
fn read(name: &str) -> Vec<u8> {
    let path = protocol_path(name);
    fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Writes a file when blessing; else compares it.
fn check_file(name: &str, contents: &[u8]) {
    let path = protocol_path(name);
    if blessing() {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, contents).unwrap();
        return;
    }
    assert!(
        fs::read(&path).is_ok_and(|found| found == contents),
        "{} is not what the types in protocol/src give. If the wire was meant to change: \
         WILDCITY_BLESS=1 cargo test --release --test protocol",
        path.display()
    );
}

/// As [`check_file`], for a value as JSON for people to read.
fn check_json(name: &str, value: &impl serde::Serialize) {
    let mut text = serde_json::to_string_pretty(value).unwrap();
    text.push('\n');
    check_file(name, text.as_bytes());
}

/// The repository.
fn root() -> PathBuf {
    let package = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut above = package.ancestors();
    above
        .find(|dir| dir.join("Cargo.lock").is_file())
        .expect("a package within the repository")
        .to_owned()
}
