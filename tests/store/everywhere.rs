//! Tests that run on a directory and on an object store alike.

use std::path::{Path, PathBuf};

use wildcity_twin::store::{Catalog, CommitKind, NewVersion, StoreError, Version, VersionSettings};

use crate::places::{cells_alone, change, commit, everywhere, whole};
use crate::s3::S3;
use crate::scene_files::gaussians;
use crate::versions::street;

fn read_all(catalog: &Catalog, version: &Version) -> u64 {
    let mut gaussians = 0;
    for chunk in &version.manifest.chunks {
        for section in &chunk.sections {
            let read = catalog.section(version, chunk, section).unwrap();
            assert_eq!(read.len(), section.count as usize);
            gaussians += if section.level == 0 { read.len() as u64 } else { 0 };
        }
    }
    gaussians
}

#[test]
fn a_version_comes_back() {
    everywhere(|place| {
        let scene = gaussians(3_000, 0, 150.0, 1);
        let first = commit(&place.catalog(), &scene);
        let catalog = place.catalog();
        assert_eq!(catalog.version("street", None).unwrap(), first);
        assert_eq!(catalog.twins().unwrap().twins[0].hash, first.hash);
        assert_eq!(read_all(&catalog, &first), 3_000);
        assert_eq!(place.objects().len(), first.manifest.chunks.len() + 2);
        // The same content is the same version; a missing version is an error.
        assert_eq!(commit(&catalog, &scene), first);
        let error = catalog.version("avenue", None).unwrap_err();
        assert!(matches!(&error, StoreError::NoTwin { known, .. } if known == &["street"]));
        let error = catalog.version("street", Some(2)).unwrap_err();
        assert!(matches!(error, StoreError::NoVersion { number: 2, latest: 1, .. }), "{error}");
        assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);
    });
}

#[test]
fn a_version_has_one_hash_wherever_it_is() {
    let scene = gaussians(1_000, 0, 100.0, 2);
    let s3 = S3::start();
    let dir = tempfile::tempdir().unwrap();
    let there = commit(&s3.catalog(), &scene);
    assert_eq!(commit(&Catalog::open(dir.path()).unwrap(), &scene).hash, there.hash);
}

#[test]
fn many_commits_at_once_are_all_in() {
    everywhere(|place| {
        let catalog = place.catalog();
        commit(&catalog, &gaussians(1_000, 0, 40.0, 1));
        let numbers = std::thread::scope(|scope| {
            let commits: Vec<_> = (0..6)
                .map(|x| {
                    let catalog = place.catalog();
                    scope.spawn(move || {
                        change(&catalog, [x, 9], 5).change(1, cells_alone()).unwrap().number
                    })
                })
                .collect();
            let mut numbers: Vec<_> =
                commits.into_iter().map(|commit| commit.join().unwrap()).collect();
            numbers.sort_unstable();
            numbers
        });
        assert_eq!(numbers, [2, 3, 4, 5, 6, 7]);
        let last = catalog.version("street", None).unwrap();
        let pushed = last.manifest.chunks.iter().filter(|chunk| chunk.cell[1] == 9);
        assert_eq!(pushed.count(), 6);
        assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);
    });
}

#[test]
fn the_same_cell_is_refused_and_an_old_version_comes_back() {
    everywhere(|place| {
        let catalog = place.catalog();
        let first = commit(&catalog, &gaussians(1_000, 0, 40.0, 1));
        let one = change(&catalog, [3, 3], 1);
        let two = change(&catalog, [3, 3], 2);
        one.change(1, cells_alone()).unwrap();
        let error = two.change(1, cells_alone()).unwrap_err();
        let StoreError::Overlap { cells, latest: 2, .. } = &error else { panic!("{error}") };
        assert_eq!(cells, &[[3, 3]]);
        let back = catalog.rollback("street", 1).unwrap();
        assert_eq!((back.number, &back.hash), (3, &first.hash));
        let kinds: Vec<_> =
            catalog.versions("street").unwrap().iter().map(|entry| entry.kind).collect();
        assert_eq!(kinds, [CommitKind::Import, CommitKind::Push, CommitKind::Rollback]);
        let diff = catalog.diff("street", 2, 3).unwrap();
        assert_eq!((diff.cells.len(), diff.cells[0].cell, diff.cells[0].after), (1, [3, 3], None));
    });
}

#[test]
fn damage_is_found_and_repaired_by_the_same_import() {
    everywhere(|place| {
        let catalog = place.catalog();
        let scene = gaussians(2_000, 0, 100.0, 1);
        let version = commit(&catalog, &scene);
        let chunk = &version.manifest.chunks[1];
        let path = |hash: &str| place.twins().join("street/objects").join(&hash[..2]).join(hash);
        let flip = |path: &Path| {
            let mut bytes = std::fs::read(path).unwrap();
            let last = bytes.len() - 1;
            bytes[last] ^= 1;
            std::fs::write(path, bytes).unwrap();
        };
        for hash in [&chunk.object, &version.hash, &version.manifest.table.object] {
            flip(&path(hash));
            let found = catalog.verify("street", &mut |_, _| {}).unwrap().damaged;
            assert_eq!(found.iter().map(|d| &d.object).collect::<Vec<_>>(), [hash]);
            commit(&catalog, &scene);
            assert_eq!(catalog.verify("street", &mut |_, _| {}).unwrap().damaged.len(), 0);
        }
        std::fs::write(path(&chunk.object), "short").unwrap();
        let error = catalog.section(&version, chunk, &chunk.sections[0]).unwrap_err();
        assert!(error.to_string().contains("it has 5 bytes"), "{error}");
        assert!(matches!(error, StoreError::Damaged { .. }), "{error}");
        std::fs::remove_file(path(&chunk.object)).unwrap();
        let error = catalog.section(&version, chunk, &chunk.sections[0]).unwrap_err();
        let StoreError::Io { cause, .. } = &error else { panic!("{error}") };
        assert_eq!(cause.kind(), std::io::ErrorKind::NotFound, "{error}");
        assert!(error.to_string().contains(&chunk.object), "{error}");
    });
}

#[test]
fn what_cannot_be_used_leaves_nothing() {
    everywhere(|place| {
        let catalog = place.catalog();
        let mut scene = gaussians(100, 0, 10.0, 1);
        scene.ln_scales[7][0] = f32::NAN;
        catalog.commit(whole(&scene), &mut |_, _| {}).unwrap_err();
        assert_eq!(place.objects(), [""; 0].map(PathBuf::from));
        assert_eq!(catalog.twins().unwrap().twins, []);
    });
}

#[test]
fn settings_are_replaced_whole() {
    everywhere(|place| {
        let catalog = place.catalog();
        let NewVersion { profile, rig, trajectories, sky, geo, provenance, .. } =
            street(&gaussians(0, 0, 1.0, 0));
        let commit = change(&catalog, [0, 0], 1);
        let id = commit.id().to_owned();
        let twin_from_capture = None;
        let settings =
            VersionSettings { profile, rig, trajectories, sky, geo, twin_from_capture, provenance };
        let version = commit.replace(None, settings).unwrap();
        assert_eq!(version.manifest.gaussians(), 300);
        assert_eq!(catalog.versions("street").unwrap()[0].commit, Some(id));
    });
}
