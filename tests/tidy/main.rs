//! Rules for the source that Cargo cannot check: which crate may be used where within a package, no
//! import cycles, no dialect, plain prose, links that lead to files and headings, licences; the
//! book and the version.

mod book;
mod cycles;
mod dialect;
mod errors;
mod licences;
mod links;
mod packages;
mod prose;
mod source;
mod versions;

use std::path::PathBuf;

/// The repository.
fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}
