//! The sky of a version: kept, shared, replaced, removed, damaged, collected.

use std::sync::Arc;
use std::time::Duration;

use glam::{DMat3, DVec3};
use wildcity_scene::RenderProfile;
use wildcity_scene::sky::SkyModel;
use wildcity_twin::ingest;
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{
    Catalog, CommitKind, NewSky, NewVersion, Retention, SkyBytes, StorageOptions, VersionChange,
};

use crate::places::{cells_alone, everywhere};
use crate::scene_files::{gaussians, safetensors};
use crate::sky_network::tensors;
use crate::versions::{commit, street};

fn sky_bytes(seed: usize) -> SkyBytes {
    let read = ingest::sky::read_bytes(&safetensors(&tensors(seed), &[]), None).unwrap();
    assert!(matches!(read.model, SkyModel::Network(..)));
    SkyBytes { bytes: read.bytes.into(), image: None, sky_from_world: DMat3::IDENTITY }
}

fn with_sky(change: Option<NewSky>) -> VersionChange {
    VersionChange { sky: Some(change), ..cells_alone() }
}

/// The storage options of `street`.
fn storage() -> StorageOptions {
    street(&gaussians(0, 0, 1.0, 1)).storage
}

#[test]
fn a_sky_comes_back_and_versions_share_it() {
    everywhere(|place| {
        let catalog = place.catalog();
        let scene = gaussians(300, 1, 10.0, 1);
        let put = |seed| Some(NewSky::Put(sky_bytes(seed)));
        let one = NewVersion { sky: put(1), ..street(&scene) };
        let first = catalog.commit(one.clone(), &mut |_, _| {}).unwrap();
        assert_eq!(catalog.commit(one, &mut |_, _| {}).unwrap(), first, "the same content");
        let named = first.manifest.sky.clone().unwrap();
        assert_eq!(named.bytes, sky_bytes(1).bytes.len() as u64);

        // A change keeps the sky, replaces it, or removes it.
        let change = |base, change| {
            let commit = catalog.begin("street", CommitKind::Push, storage()).unwrap();
            commit.change(base, change).unwrap()
        };
        let profile = Some(RenderProfile { near: 0.2, ..RenderProfile::DEFAULT });
        let second = change(1, VersionChange { profile, ..cells_alone() });
        assert_eq!(second.manifest.sky, Some(named.clone()));
        let third = change(2, with_sky(put(2)));
        assert_ne!(third.manifest.sky, second.manifest.sky);
        assert_eq!(catalog.diff("street", 2, 3).unwrap().settings, ["sky"]);
        let fourth = change(3, with_sky(None));
        assert_eq!(fourth.manifest.sky, None);
        let fifth = change(4, with_sky(Some(NewSky::Kept(named))));
        assert_eq!(fifth.manifest.sky, first.manifest.sky);

        let cache = Cache::new(catalog.clone());
        let open = |number| cache.open("street", Some(number)).unwrap();
        let [one, two, three, four] = [1, 2, 3, 4].map(open);
        let direction = DVec3::new(0.6, 0.0, 0.8);
        let rgb = |seed| {
            let model = ingest::sky::decode(&sky_bytes(seed).bytes, None).unwrap();
            wildcity_scene::Sky::new(model, DMat3::IDENTITY).rgb(direction)
        };
        assert_eq!(one.sky().unwrap().rgb(direction), rgb(1));
        assert_eq!(three.sky().unwrap().rgb(direction), rgb(2));
        assert!(Arc::ptr_eq(one.sky().unwrap(), two.sky().unwrap()), "one sky, one memory");
        assert!(four.sky().is_none());
        // Frames have it, and its memory is counted.
        let drawn = one.scene(&[], &RenderProfile::DEFAULT).unwrap();
        assert!(Arc::ptr_eq(drawn.sky.as_ref().unwrap(), one.sky().unwrap()));
        assert!(four.scene(&[], &RenderProfile::DEFAULT).unwrap().sky.is_none());
        let bytes = one.sky().unwrap().bytes() as u64;
        assert!(bytes > 6 * 129 * 129 * 8);
        assert_eq!(one.total_bytes(), four.total_bytes() + bytes);
    });
}

#[test]
fn garbage_collection_and_fsck_include_the_sky() {
    everywhere(|place| {
        let catalog = place.catalog();
        let scene = gaussians(300, 0, 10.0, 1);
        let put = |seed| Some(NewSky::Put(sky_bytes(seed)));
        catalog.commit(NewVersion { sky: put(1), ..street(&scene) }, &mut |_, _| {}).unwrap();
        let commit = catalog.begin("street", CommitKind::Push, storage()).unwrap();
        commit.change(1, with_sky(put(2))).unwrap();
        let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
        assert!(checked.is_sound());
        assert_eq!(checked.unreferenced.objects, 0);
        // Two manifests, a table, a chunk, and two skies.
        assert_eq!(checked.verified.objects, 6);

        let keep = Retention { versions: 1, grace: Duration::ZERO };
        catalog.collect("street", keep, false).unwrap();
        let removed = catalog.collect("street", keep, false).unwrap().removed;
        assert_eq!(removed.objects, 2, "a manifest and a sky");
        let version = catalog.version("street", None).unwrap();
        assert!(catalog.sky(&version).unwrap().is_some());
    });
}

#[test]
fn a_copy_of_a_twin_has_a_sky_of_its_own() {
    everywhere(|place| {
        let catalog = place.catalog();
        let scene = gaussians(300, 1, 10.0, 1);
        let new = NewVersion { sky: Some(NewSky::Put(sky_bytes(1))), ..street(&scene) };
        let with = catalog.commit(new, &mut |_, _| {}).unwrap();
        let copied = catalog.copy("street", None, "avenue").unwrap();
        catalog.remove("street").unwrap();
        assert!(copied.manifest.sky.is_some());
        assert_eq!(copied.manifest.sky, with.manifest.sky);
        assert!(catalog.verify("avenue", &mut |_, _| {}).unwrap().damaged.is_empty());
    });
}

#[test]
fn a_damaged_sky_is_found_and_repaired() {
    let dir = tempfile::tempdir().unwrap();
    let scene = gaussians(300, 0, 10.0, 1);
    let new = || NewVersion { sky: Some(NewSky::Put(sky_bytes(1))), ..street(&scene) };
    let version = commit(dir.path(), new()).unwrap();
    let hash = version.manifest.sky.as_ref().unwrap().object.clone();
    let path = dir.path().join("street/objects").join(&hash[..2]).join(&hash);
    let catalog = Catalog::open(dir.path()).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[200] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let error = catalog.sky(&version).unwrap_err().to_string();
    assert!(error.contains(&hash) && error.contains("is damaged"), "{error}");
    let error = Cache::new(catalog.clone()).open("street", None).unwrap_err().to_string();
    assert!(error.contains("is damaged"), "{error}");
    let checked = catalog.fsck("street", &mut |_, _| {}).unwrap();
    assert_eq!(checked.verified.damaged.len(), 1);
    assert_eq!(checked.verified.damaged[0].object, hash);
    std::fs::remove_file(&path).unwrap();
    assert_eq!(catalog.fsck("street", &mut |_, _| {}).unwrap().verified.damaged.len(), 1);
    assert_eq!(commit(dir.path(), new()).unwrap(), version);
    assert!(catalog.fsck("street", &mut |_, _| {}).unwrap().is_sound());
    assert!(catalog.sky(&version).unwrap().is_some());
}

/// A sky that no map of the default error has.
fn sharp_sky() -> SkyBytes {
    let mut noise = tensors(1);
    noise[0].2.iter_mut().for_each(|weight| *weight *= 1e4);
    let bytes = ingest::sky::read_bytes(&safetensors(&noise, &[]), None).unwrap().bytes;
    SkyBytes { bytes: bytes.into(), ..sky_bytes(1) }
}

#[test]
fn a_profile_that_the_kept_sky_cannot_be_drawn_with_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let scene = gaussians(300, 0, 10.0, 1);
    let profile = RenderProfile { sky_error: 0.0, ..RenderProfile::DEFAULT };
    let sky = Some(NewSky::Put(sharp_sky()));
    catalog.commit(NewVersion { sky, profile, ..street(&scene) }, &mut |_, _| {}).unwrap();
    let change = |profile: RenderProfile| {
        let commit = catalog.begin("street", CommitKind::Push, storage()).unwrap();
        commit.change(1, VersionChange { profile: Some(profile), ..cells_alone() })
    };
    let error = change(RenderProfile::DEFAULT).unwrap_err().to_string();
    assert!(error.contains("set sky_error to"), "{error}");
    assert_eq!(change(RenderProfile { near: 0.2, ..profile }).unwrap().number, 2);
}

#[test]
fn what_cannot_be_drawn_is_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let scene = gaussians(300, 0, 10.0, 1);
    let sharp = sharp_sky();
    let garbage = SkyBytes { bytes: b"no sky".as_slice().into(), ..sky_bytes(1) };
    let image = SkyBytes { image: Some(0), ..sky_bytes(1) };
    for (sky, wanted) in [
        (sharp, "set sky_error to"),
        (garbage, "it is not a safetensors file, a PNG, or a JPEG"),
        (image, "there is no image 0"),
    ] {
        let new = NewVersion { sky: Some(NewSky::Put(sky)), ..street(&scene) };
        let error = commit(dir.path(), new).unwrap_err().to_string();
        assert!(error.contains(wanted), "{error}");
        assert_eq!(
            crate::versions::files(&dir.path().join("street")),
            Vec::<std::path::PathBuf>::new()
        );
    }
}
