//! Copies of twins, other names, and removal, in a directory and in an object store.

use std::time::Duration;

use wildcity_twin::store::{Catalog, Retention, StoreError, Version};

use crate::places::{Place, cells_alone, change, commit, everywhere};
use crate::scene_files::gaussians;
use crate::versions::files;

/// A twin of three versions, each of which changed cell (3, 3).
fn twin(place: &Place) -> Catalog {
    let catalog = place.catalog();
    commit(&catalog, &gaussians(1_000, 0, 40.0, 1));
    for number in 2..=3 {
        change(&catalog, [3, 3], number).change(number - 1, cells_alone()).unwrap();
    }
    catalog
}

/// The content of a version without the names of its twin and of its table.
fn content(version: &Version) -> Vec<(String, u64)> {
    let chunks = version.manifest.chunks.iter();
    chunks.map(|chunk| (chunk.object.clone(), chunk.count)).collect()
}

fn is_whole(catalog: &Catalog, name: &str) -> bool {
    catalog.verify(name, &mut |_, _| {}).unwrap().damaged.is_empty()
}

#[test]
fn a_copy_has_the_content_of_its_version() {
    everywhere(|place| {
        let catalog = twin(place);
        for number in [None, Some(2)] {
            let name = format!("copy-{}", number.unwrap_or(3));
            let copied = catalog.copy("street", number, &name).unwrap();
            let original = catalog.version("street", number).unwrap();
            assert_eq!((copied.number, &*copied.manifest.twin), (1, &*name));
            assert_ne!(copied.hash, original.hash);
            assert_eq!(content(&copied), content(&original));
            assert_eq!(copied.manifest.profile, original.manifest.profile);
            assert_eq!(catalog.version(&name, None).unwrap(), copied);
            assert!(is_whole(&catalog, &name));
        }
        // Each twin has its own objects.
        catalog.remove("street").unwrap();
        assert!(is_whole(&catalog, "copy-2") && is_whole(&catalog, "copy-3"));

        let error = catalog.copy("copy-3", None, "copy-2").unwrap_err();
        assert!(matches!(error, StoreError::TwinExists { latest: 1, .. }), "{error}");
        let error = catalog.copy("copy-3", None, "Copy").unwrap_err();
        assert!(matches!(error, StoreError::Name { .. }), "{error}");
        let error = catalog.copy("copy-3", Some(7), "other").unwrap_err();
        assert!(matches!(error, StoreError::NoVersion { number: 7, .. }), "{error}");
        assert_eq!(catalog.twins().unwrap().twins.len(), 2);
    });
}

#[test]
fn a_renamed_twin_has_all_versions_and_the_old_name_is_free() {
    everywhere(|place| {
        let catalog = twin(place);
        let contents = |name: &str| -> Vec<_> {
            let versions = catalog.versions(name).unwrap().into_iter();
            versions
                .map(|entry| content(&catalog.version(name, Some(entry.number)).unwrap()))
                .collect()
        };
        let kinds = |name: &str| -> Vec<_> {
            catalog.versions(name).unwrap().iter().map(|entry| entry.kind).collect()
        };
        let before = (contents("street"), kinds("street"));
        let renamed = catalog.rename("street", "avenue").unwrap();
        assert_eq!((renamed.number, &*renamed.manifest.twin), (3, "avenue"));
        assert_eq!((contents("avenue"), kinds("avenue")), before);
        assert!(is_whole(&catalog, "avenue"));
        assert!(matches!(catalog.version("street", None), Err(StoreError::NoTwin { .. })));
        // Nothing of the old twin says anything about a new one of its name.
        let again = commit(&catalog, &gaussians(500, 0, 40.0, 2));
        assert_eq!((again.number, catalog.version("street", None).unwrap()), (1, again.clone()));
        assert!(is_whole(&catalog, "street"));
        let error = catalog.rename("street", "avenue").unwrap_err();
        assert!(matches!(error, StoreError::TwinExists { latest: 3, .. }), "{error}");
    });
}

#[test]
fn versions_that_were_collected_are_not_renamed() {
    everywhere(|place| {
        let catalog = twin(place);
        for _ in 0..2 {
            let keep = Retention { versions: 2, grace: Duration::ZERO };
            catalog.collect("street", keep, false).unwrap();
        }
        assert_eq!(catalog.rename("street", "avenue").unwrap().number, 2);
        assert!(is_whole(&catalog, "avenue"));
    });
}

#[test]
fn a_removed_twin_leaves_nothing() {
    everywhere(|place| {
        let catalog = twin(place);
        catalog.lease("street", 2, "a test", Duration::from_secs(60)).unwrap();
        catalog.remove("street").unwrap();
        assert!(place.objects().is_empty());
        // An object store has no directories; that of the test may keep empty ones.
        assert_eq!(files(&place.twins().join("street")), [] as [std::path::PathBuf; 0]);
        let is_there = place.twins().join("street").exists();
        assert!(!is_there || matches!(place, Place::S3(_)));
        assert!(catalog.twins().unwrap().twins.is_empty());
        let error = catalog.remove("street").unwrap_err();
        assert!(matches!(error, StoreError::NoTwin { .. }), "{error}");
    });
}

#[test]
fn a_twin_in_use_is_neither_removed_nor_renamed() {
    everywhere(|place| {
        let catalog = twin(place);
        let lease = catalog.lease("street", 2, "a server", Duration::from_secs(60)).unwrap();
        for refused in
            [catalog.remove("street").unwrap_err(), catalog.rename("street", "avenue").unwrap_err()]
        {
            let is_leased = matches!(refused, StoreError::Leased { number: 2, .. });
            assert!(is_leased && refused.to_string().contains("in use"), "{refused}");
        }
        for number in 1..=3 {
            catalog.version("street", Some(number)).unwrap();
        }
        assert_eq!(catalog.twins().unwrap().twins.len(), 1, "nothing was copied");
        drop(lease);
        catalog.remove("street").unwrap();
    });
}
