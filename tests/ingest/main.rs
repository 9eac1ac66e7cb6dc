//! Reading formats of other programs: what is written is read back, and damage is refused with an
//! error that names it.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/formats.rs"]
mod format_files;
#[path = "../support/images.rs"]
mod images;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;

mod archives;
mod axes;
mod captures;
mod cases;
mod classes;
mod conformance;
mod corpus;
mod damage;
mod formats;
mod fuzz;
mod hostile;
mod materials;
mod meshes;
mod notes;
mod points;
mod real_scenes;
mod round_trip;
mod skies;

use wildcity_scene::Gaussians;
use wildcity_twin::ingest::{self, IngestError};

/// Reads a file with these bytes.
fn read(bytes: &[u8]) -> Result<Gaussians, IngestError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene");
    std::fs::write(&path, bytes).unwrap();
    ingest::read(&path, &mut |_, _| {})
}

/// The error of a file with these bytes.
fn refusal(bytes: &[u8]) -> String {
    read(bytes).unwrap_err().to_string()
}
