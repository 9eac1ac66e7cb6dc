//! A directory and an object store, on which the same tests run.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::PathBuf;

use wildcity_scene::Gaussians;
use wildcity_twin::store::{
    Catalog, Commit, CommitKind, NewVersion, StorageOptions, Version, VersionChange,
};

use crate::s3::{S3, keys};
use crate::scene_files::gaussians;
use crate::versions::{files, street};

pub(crate) fn whole(scene: &Gaussians) -> NewVersion<'_> {
    NewVersion { storage: StorageOptions::default(), ..street(scene) }
}

pub(crate) enum Place {
    Directory(tempfile::TempDir),
    S3(S3),
}

impl Place {
    pub(crate) fn catalog(&self) -> Catalog {
        match self {
            Self::Directory(dir) => Catalog::open(dir.path()).unwrap(),
            Self::S3(s3) => s3.catalog(),
        }
    }

    pub(crate) fn twins(&self) -> PathBuf {
        match self {
            Self::Directory(dir) => dir.path().to_owned(),
            Self::S3(s3) => s3.twins(),
        }
    }

    pub(crate) fn objects(&self) -> Vec<PathBuf> {
        let of = self.twins().join("street/objects");
        if matches!(self, Self::S3(_)) { keys(&of) } else { files(&of) }
    }
}

pub(crate) fn everywhere(test: impl Fn(&Place)) {
    test(&Place::Directory(tempfile::tempdir().unwrap()));
    test(&Place::S3(S3::start()));
}

pub(crate) fn commit(catalog: &Catalog, scene: &Gaussians) -> Version {
    catalog.commit(whole(scene), &mut |_, _| {}).unwrap()
}

/// A change of one cell, in preparation.
pub(crate) fn change(catalog: &Catalog, cell: [i32; 2], seed: u64) -> Commit {
    let mut scene = gaussians(300, 0, 10.0, seed);
    for mean_m in &mut scene.means_m {
        mean_m[0] += 64.0 * f64::from(cell[0]);
        mean_m[1] += 64.0 * f64::from(cell[1]);
    }
    let mut commit = catalog.begin("street", CommitKind::Push, StorageOptions::default()).unwrap();
    commit.put(&scene, None, &mut |_, _| {}).unwrap();
    commit
}

pub(crate) fn cells_alone() -> VersionChange {
    let provenance = street(&gaussians(0, 0, 1.0, 0)).provenance;
    VersionChange::new(provenance)
}
