//! Versions of a small twin, and its files on disk.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::{Path, PathBuf};

use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RecordFormat};
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions, StoreError, Version};

/// A version of twin "street" with nothing but Gaussians.
pub(crate) fn street(gaussians: &Gaussians) -> NewVersion<'_> {
    let storage = StorageOptions { record: RecordFormat::F32, levels: false };
    let provenance = Provenance::new("test".into());
    NewVersion { storage, ..NewVersion::from_gaussians("street", gaussians, provenance) }
}

/// As [`street`], of another name.
pub(crate) fn street_named<'a>(name: &'a str, gaussians: &'a Gaussians) -> NewVersion<'a> {
    NewVersion { name, ..street(gaussians) }
}

pub(crate) fn commit(dir: &Path, new: NewVersion<'_>) -> Result<Version, StoreError> {
    Catalog::open(dir)?.commit(new, &mut |_, _| {})
}

/// All files below a directory, sorted.
pub(crate) fn files(dir: &Path) -> Vec<PathBuf> {
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

/// Takes the publish lock of twin "street" in a directory, until the file is dropped.
pub(crate) fn turn(dir: &Path) -> std::fs::File {
    let turn =
        std::fs::File::options().append(true).open(dir.join(".staging/street.lock")).unwrap();
    turn.lock().unwrap();
    turn
}
