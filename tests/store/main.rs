//! Twins on disk: what is committed comes back, and whatever goes wrong leaves old or nothing.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/s3.rs"]
mod s3;
#[path = "../support/scene_files.rs"]
mod scene_files;

mod command_line;
mod commits;
mod crash;
mod damage;
mod demo;
mod garbage;
mod places;
mod real_scenes;
mod remote;
mod round_trip;
mod skies;

use std::path::{Path, PathBuf};

use wildcity::scene::manifest::Provenance;
use wildcity::scene::{Gaussians, Record};
use wildcity::store::{Catalog, NewVersion, StorageOptions, StoreError, Version};

/// A version of twin "street" with nothing but Gaussians.
fn street(gaussians: &Gaussians) -> NewVersion<'_> {
    let storage = StorageOptions { record: Record::F32, levels: false };
    let provenance = Provenance::of("test".into());
    NewVersion { storage, ..NewVersion::of("street", gaussians, provenance) }
}

fn commit(dir: &Path, new: NewVersion<'_>) -> Result<Version, StoreError> {
    Catalog::open(dir)?.commit(new, &mut |_, _| {})
}

/// All files below a directory, sorted.
fn files(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// The turn to publish versions of twin "street" in a directory, until it is dropped.
fn turn(dir: &Path) -> std::fs::File {
    let turn =
        std::fs::File::options().append(true).open(dir.join(".staging/street.lock")).unwrap();
    turn.lock().unwrap();
    turn
}

/// The command that users run.
fn wildcity() -> std::process::Command {
    std::process::Command::new(env!("CARGO_BIN_EXE_wildcity"))
}
