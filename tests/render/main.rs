//! The backends against each other, against images made by others, and at the extremes.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/scene_files.rs"]
#[expect(dead_code, reason = "the writers of files are for the tests of ingest")]
mod scene_files;
#[path = "../support/streets.rs"]
mod streets;

mod determinism;
mod extremes;
mod others;
mod parity;
