//! Garbage collection and fsck, in a directory and in an object store.

use std::fs;
use std::time::Duration;

use wildcity_twin::store::{Catalog, ObjectTotals, Retention, StoreError};

use crate::places::{Place, cells_alone, change, commit, everywhere};
use crate::scene_files::gaussians;
use crate::versions::{files, turn};

const NOW: Duration = Duration::ZERO;
const DAY: Duration = Duration::from_secs(86_400);

/// A twin of `versions` versions, each of which changed cell (3, 3).
fn twin(place: &Place, versions: u64) -> Catalog {
    let catalog = place.catalog();
    commit(&catalog, &gaussians(1_000, 0, 40.0, 1));
    for number in 2..=versions {
        let version = change(&catalog, [3, 3], number).change(number - 1, cells_alone()).unwrap();
        assert_eq!(version.number, number);
    }
    catalog
}

/// Objects that only one version names: its manifest, its table, and the chunk of (3, 3).
const OWN: u64 = 3;

#[test]
fn garbage_is_removed_in_two_steps_and_kept_versions_are_not() {
    everywhere(|place| {
        let catalog = twin(place, 5);
        let before = place.objects();
        let keep = |versions, grace| Retention { versions, grace };
        // A dry run.
        let dry = catalog.collect("street", keep(2, NOW), true).unwrap();
        assert_eq!((&dry.kept[..], dry.removed), (&[4, 5][..], ObjectTotals::default()));
        // The first version had no cell (3, 3), so it has only a manifest and a table.
        assert_eq!(dry.noted.objects, 2 + 2 * OWN);
        assert_eq!(catalog.collect("street", keep(2, NOW), true).unwrap(), dry);

        let first = catalog.collect("street", keep(2, NOW), false).unwrap();
        assert_eq!(first, dry);
        assert_eq!(place.objects(), before);
        // Not old enough.
        let second = catalog.collect("street", keep(2, DAY), false).unwrap();
        assert_eq!((second.removed, second.noted), (ObjectTotals::default(), dry.noted));
        assert_eq!(place.objects(), before);
        let third = catalog.collect("street", keep(2, NOW), false).unwrap();
        assert_eq!((third.removed, third.noted), (dry.noted, ObjectTotals::default()));
        assert_eq!(place.objects().len() as u64, before.len() as u64 - dry.noted.objects);

        for number in [4, 5] {
            let version = catalog.version("street", Some(number)).unwrap();
            for chunk in &version.manifest.chunks {
                catalog.section(&version, chunk, &chunk.sections[0]).unwrap();
            }
        }
        let error = catalog.version("street", Some(2)).unwrap_err();
        assert!(matches!(error, StoreError::GarbageCollected { number: 2, .. }), "{error}");
        let error = catalog.rollback("street", 3).unwrap_err();
        assert!(matches!(error, StoreError::GarbageCollected { number: 3, .. }), "{error}");
        let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
        assert!(checked.is_sound(), "{checked:?}");
        assert_eq!(
            (&checked.collected[..], checked.unreferenced),
            (&[1, 2, 3][..], ObjectTotals::default())
        );
        // What a killed commit left is still distinguished from it.
        assert_eq!(change(&catalog, [9, 9], 1).change(5, cells_alone()).unwrap().number, 6);
        let listed = catalog.versions("street").unwrap();
        assert_eq!(listed.len(), 6, "the log stays");
    });
}

/// Ends the locks of all leases, as the kernel does when their processes end.
fn end_locks(place: &Place) {
    let mut locks = files(&place.twins().join("street/leases"));
    locks.retain(|path| path.extension().is_some_and(|extension| extension == "lock"));
    locks.iter().for_each(|path| std::fs::remove_file(path).unwrap());
}

/// In a directory, a lease holds as long as its process lives, whatever the clock says.
#[test]
fn a_version_in_use_is_kept_though_its_lease_expired() {
    let place = Place::Directory(tempfile::tempdir().unwrap());
    let catalog = twin(&place, 3);
    let keep = Retention { versions: 1, grace: NOW };
    let lease = catalog.lease("street", 2, "a test", Duration::ZERO).unwrap();
    for _ in 0..2 {
        assert_eq!(catalog.collect("street", keep, false).unwrap().kept, [2, 3]);
    }
    drop(lease);
    assert_eq!(catalog.collect("street", keep, false).unwrap().kept, [3]);
    assert!(files(&place.twins().join("street/leases")).is_empty(), "nothing is left of the lease");
}

#[test]
fn a_leased_version_is_kept_however_old() {
    everywhere(|place| {
        let catalog = twin(place, 4);
        let keep = Retention { versions: 1, grace: NOW };
        let error = catalog.lease("street", 9, "test", DAY).unwrap_err();
        assert!(matches!(error, StoreError::NoVersion { number: 9, .. }), "{error}");
        // A lease that expired without being dropped.
        std::mem::forget(catalog.lease("street", 3, "killed", Duration::ZERO).unwrap());
        end_locks(place);
        let mut lease = catalog.lease("street", 2, "a test", DAY).unwrap();
        lease.renew().unwrap();
        for _ in 0..2 {
            let found = place.catalog().collect("street", keep, false).unwrap();
            assert_eq!(found.kept, [2, 4]);
        }
        let version = catalog.version("street", Some(2)).unwrap();
        let cell = version.manifest.chunks.iter().find(|chunk| chunk.cell == [3, 3]).unwrap();
        catalog.section(&version, cell, &cell.sections[0]).unwrap();
        let error = catalog.version("street", Some(3)).unwrap_err();
        assert!(matches!(error, StoreError::GarbageCollected { .. }), "{error}");
        drop(lease);
        let found = catalog.collect("street", keep, false).unwrap();
        assert_eq!((&found.kept[..], found.noted.objects), (&[4][..], OWN));
    });
}

#[test]
fn an_object_that_is_put_again_is_no_garbage_any_more() {
    everywhere(|place| {
        let catalog = twin(place, 3);
        let keep = Retention { versions: 1, grace: NOW };
        catalog.collect("street", keep, false).unwrap();
        // The cell of version 2 is put again, and its object with it.
        let again = change(&catalog, [3, 3], 2).change(3, cells_alone()).unwrap();
        assert_eq!(again.number, 4);
        catalog.collect("street", keep, false).unwrap();
        assert!(catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());
        let version = catalog.version("street", None).unwrap();
        for chunk in &version.manifest.chunks {
            catalog.section(&version, chunk, &chunk.sections[0]).unwrap();
        }
    });
}

/// An object that was noted as garbage of an old version may be one of a newer version, which is
/// not noted yet.
#[test]
fn a_version_loses_all_of_its_objects_or_none() {
    everywhere(|place| {
        let keep = Retention { versions: 1, grace: NOW };
        let is_sound = |catalog: &Catalog, gone: &[u64]| {
            let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
            assert!(checked.is_sound(), "{checked:?}");
            assert_eq!(checked.collected, gone);
        };
        let catalog = twin(place, 3);
        catalog.collect("street", keep, false).unwrap();
        // Version 5 has the cell of version 2 again beside a new one, and version 6 has not.
        let push = |cell, seed, base| {
            change(&catalog, cell, seed).change(base, cells_alone()).unwrap();
        };
        push([9, 9], 1, 3);
        push([3, 3], 2, 4);
        push([3, 3], 5, 5);
        let second = catalog.collect("street", keep, false).unwrap();
        is_sound(&catalog, &[1, 2]);
        // The manifests and tables of versions 1 and 2 go; the chunk of version 2 is needed.
        // Versions 3 and 4 share one.
        assert_eq!((second.removed.objects, second.noted.objects), (4, 2 * OWN + 2));
        let third = catalog.collect("street", keep, false).unwrap();
        is_sound(&catalog, &[1, 2, 3, 4, 5]);
        assert_eq!((third.removed, third.noted), (second.noted, ObjectTotals::default()));

        // A rollback needs the objects again, and writes none of them. So does version 9.
        push([3, 3], 6, 6);
        catalog.collect("street", keep, false).unwrap();
        assert_eq!(catalog.rollback("street", 6).unwrap().number, 8);
        push([9, 9], 2, 8);
        push([3, 3], 7, 9);
        catalog.collect("street", keep, false).unwrap();
        is_sound(&catalog, &[1, 2, 3, 4, 5, 6, 8]);
        catalog.collect("street", keep, false).unwrap();
        is_sound(&catalog, &[1, 2, 3, 4, 5, 6, 7, 8, 9]);
    });
}

#[test]
fn a_damaged_manifest_of_an_old_version_keeps_all_objects_and_is_named() {
    everywhere(|place| {
        let keep = Retention { versions: 1, grace: NOW };
        let catalog = twin(place, 3);
        let noted = catalog.collect("street", keep, false).unwrap().noted;
        let third = catalog.version("street", None).unwrap();
        change(&catalog, [3, 3], 4).change(3, cells_alone()).unwrap();
        // Version 3 is not kept any more, and not noted yet.
        let hash = &third.hash;
        let file = place.twins().join("street/objects").join(&hash[..2]).join(hash);
        let manifest = fs::read(&file).unwrap();
        fs::write(&file, &manifest[1..]).unwrap();
        let blocked = place.catalog().collect("street", keep, false).unwrap();
        assert_eq!(blocked.removed, ObjectTotals::default());
        let (number, damage) = blocked.blocked_by.unwrap();
        assert_eq!(number, 3);
        assert!(damage.contains(hash), "{damage}");
        // The next run removes the manifest, and with it all that was noted.
        let free = place.catalog().collect("street", keep, false).unwrap();
        assert_eq!((free.removed.objects, free.blocked_by), (noted.objects + OWN, None));
    });
}

/// Holds in a directory. In an object store, only the grace period protects objects that no version
/// names yet.
#[test]
fn a_commit_in_preparation_is_not_disturbed() {
    let place = Place::Directory(tempfile::tempdir().unwrap());
    let catalog = twin(&place, 3);
    // One commit with a new object, and one with an object that is removed meanwhile.
    let new = change(&catalog, [5, 5], 7);
    let old = change(&catalog, [3, 3], 2);
    let keep = Retention { versions: 1, grace: NOW };
    let removed: u64 = (0..3)
        .map(|_| place.catalog().collect("street", keep, false).unwrap().removed.objects)
        .sum();
    assert_eq!(removed, 2 + OWN);
    assert_eq!(new.change(3, cells_alone()).unwrap().number, 4);
    assert_eq!(old.change(4, cells_alone()).unwrap().number, 5);
    let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
    assert!(checked.is_sound() && !checked.staging, "{checked:?}");
}

#[test]
fn a_version_leased_just_before_the_removal_is_kept() {
    let place = Place::Directory(tempfile::tempdir().unwrap());
    let catalog = twin(&place, 4);
    let keep = Retention { versions: 1, grace: NOW };
    catalog.collect("street", keep, false).unwrap();
    let turn = turn(&place.twins());
    let (found, lease) = std::thread::scope(|scope| {
        let waits = scope.spawn(|| catalog.collect("street", keep, false).unwrap());
        std::thread::sleep(Duration::from_millis(300));
        let lease = catalog.lease("street", 2, "a test", DAY).unwrap();
        drop(turn);
        (waits.join().unwrap(), lease)
    });
    assert_eq!(found.kept, [2, 4]);
    let version = catalog.version("street", Some(2)).unwrap();
    for chunk in &version.manifest.chunks {
        catalog.section(&version, chunk, &chunk.sections[0]).unwrap();
    }
    let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
    assert!(checked.is_sound(), "{checked:?}");
    assert_eq!(checked.collected, [1, 3]);
    drop(lease);
}

#[test]
fn a_collected_version_cannot_be_leased() {
    everywhere(|place| {
        let catalog = twin(place, 3);
        let mut ended = catalog.lease("street", 2, "late", Duration::ZERO).unwrap();
        end_locks(place);
        for _ in 0..2 {
            catalog.collect("street", Retention { versions: 1, grace: NOW }, false).unwrap();
        }
        let error = catalog.lease("street", 1, "a test", DAY).unwrap_err();
        assert!(matches!(error, StoreError::GarbageCollected { number: 1, .. }), "{error}");
        let error = ended.renew().unwrap_err();
        assert!(matches!(error, StoreError::GarbageCollected { number: 2, .. }), "{error}");
    });
}

#[test]
fn invalid_names_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(&dir.path().join("twins")).unwrap();
    // A file outside of the twins, which is neither a side file nor an object.
    let outside = dir.path().join("outside");
    std::fs::create_dir_all(outside.join("gc/collected")).unwrap();
    std::fs::create_dir_all(outside.join("gc/candidates")).unwrap();
    std::fs::create_dir_all(outside.join("objects/ab")).unwrap();
    std::os::unix::fs::symlink("nowhere", outside.join("objects/ab/cd")).unwrap();
    let name = "../outside";
    let errors = [
        catalog.collect(name, Retention { versions: 1, grace: NOW }, false).unwrap_err(),
        catalog.fsck(name, &mut |_, _| {}).unwrap_err(),
        catalog.verify(name, &mut |_, _| {}).unwrap_err(),
    ];
    for error in errors {
        assert!(matches!(error, StoreError::Name { .. }), "{error}");
    }
}

#[test]
fn a_side_file_too_large_to_be_read_is_not_written() {
    everywhere(|place| {
        let catalog = twin(place, 1);
        let holder = "x".repeat(16 << 20);
        let error = catalog.lease("street", 1, &holder, DAY).unwrap_err();
        assert!(matches!(error, StoreError::SideFileSize { .. }), "{error}");
    });
}

#[test]
fn fsck_names_gaps_in_the_log() {
    everywhere(|place| {
        let catalog = twin(place, 4);
        let log = place.twins().join("street/log");
        std::fs::remove_file(log.join("0000000002")).unwrap();
        std::fs::write(log.join("0000000003"), "{").unwrap();
        let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
        assert!(!checked.is_sound());
        assert_eq!(checked.gaps, [2]);
        assert_eq!(checked.records.iter().map(|(number, _)| *number).collect::<Vec<_>>(), [3]);
        assert_eq!(checked.verified.damaged.len(), 0);
        assert_eq!(checked.unreferenced.objects, 2 * OWN);
    });
}
