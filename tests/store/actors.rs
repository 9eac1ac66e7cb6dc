//! Assets of actors in the store, and cutting them out of a twin.

use glam::{DQuat, DVec3};
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat};
use wildcity_twin::store::{
    ActorList, AddedActor, CUT_ABOVE_M, Catalog, NewVersion, Retention, SameName, StorageOptions,
    StoreError, StoredActor,
};

use crate::places::{Place, commit, everywhere};
use crate::s3::{Fault, S3, keys};
use crate::scene_files::gaussians;
use crate::versions::files;

fn description(name: &str) -> AssetDescription {
    AssetDescription {
        name: name.to_owned(),
        class: ActorClass::Vehicle,
        box_: ActorBox { length_m: 4.0, width_m: 4.0, height_m: 4.0 },
        provenance: Provenance::new("test".to_owned()),
    }
}

fn asset(name: &str, seed: u64) -> ActorAsset {
    ActorAsset::new(&gaussians(3_000, 1, 2.0, seed), description(name)).unwrap()
}

#[test]
fn an_asset_is_read_as_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    assert_eq!(catalog.actors().unwrap(), ActorList::default());
    let car = asset("car", 1);
    let stored = catalog.put_actor(&car, RecordFormat::F32).unwrap();
    assert_eq!(stored.gaussians(), 3_000);
    let read = catalog.actor(&stored.hash).unwrap();
    assert_eq!(read.description, car.description);
    assert_eq!(read.levels.len(), car.levels.len());
    for (read, own) in read.levels.iter().zip(&car.levels) {
        assert_eq!((read.error_m, read.chunk.len()), (own.error_m, own.chunk.len()));
        for index in 0..own.chunk.len() {
            for k in 0..column::SH + 12 {
                assert_eq!(read.chunk.value(index, k), own.chunk.value(index, k));
            }
        }
    }
    // An equal asset is the same object; an asset with another record is not.
    assert_eq!(catalog.put_actor(&car, RecordFormat::F32).unwrap(), stored);
    assert_eq!(catalog.actors().unwrap().actors, std::slice::from_ref(&stored));
    let small = catalog.put_actor(&car, RecordFormat::Q32).unwrap();
    assert!(small.hash != stored.hash && small.bytes < stored.bytes);
    // Assets are no twin, and no garbage.
    assert!(catalog.twins().unwrap().twins.is_empty());
    Catalog::open(dir.path()).unwrap();
    assert_eq!(catalog.actors().unwrap().actors.len(), 2);
}

#[test]
fn assets_are_found_by_name_and_by_hash() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let car = catalog.put_actor(&asset("car", 1), RecordFormat::Q32).unwrap();
    let van = catalog.put_actor(&asset("van", 2), RecordFormat::Q32).unwrap();
    assert_eq!(catalog.find_actor("car").unwrap(), car);
    assert_eq!(catalog.find_actor(&van.hash[..8]).unwrap(), van);
    assert_eq!(catalog.find_actor(&van.hash).unwrap(), van);
    let error = catalog.find_actor("bus").unwrap_err().to_string();
    assert!(error.contains("there is no actor") && error.contains("car ("), "{error}");
    catalog.put_actor(&asset("car", 3), RecordFormat::Q32).unwrap();
    let error = catalog.find_actor("car").unwrap_err().to_string();
    assert!(error.contains("more than one"), "{error}");
    let error = catalog.actor(&"0".repeat(64)).unwrap_err();
    assert!(matches!(error, StoreError::NoActor { .. }), "{error}");
    assert!(catalog.actor("../secret").is_err());
}

#[test]
fn a_damaged_asset_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let stored = catalog.put_actor(&asset("car", 1), RecordFormat::Q32).unwrap();
    let path = dir.path().join(".actors/objects").join(&stored.hash[..2]).join(&stored.hash);
    let bytes = std::fs::read(&path).unwrap();
    for at in (0..bytes.len()).step_by(bytes.len() / 40) {
        let mut wrong = bytes.clone();
        wrong[at] ^= 0x40;
        std::fs::write(&path, &wrong).unwrap();
        let error = catalog.actor(&stored.hash).unwrap_err();
        assert!(matches!(error, StoreError::ActorDamaged { .. }), "byte {at}: {error}");
    }
    // Objects whose hash is right and whose content is not, as if another program had written them.
    let mut refused = 0;
    let mut random = crate::scene_files::Random(5);
    for _ in 0..2_000 {
        let mut wrong = bytes.clone();
        for _ in 0..1 + (3.0 * random.unit()) as usize {
            let at = (random.unit() * wrong.len().min(900) as f64) as usize;
            wrong[at] = (256.0 * random.unit()) as u8;
        }
        wrong.truncate((random.unit() * 1.3 * wrong.len() as f64) as usize);
        let hash = blake3::hash(&wrong).to_hex().to_string();
        let path = dir.path().join(".actors/objects").join(&hash[..2]).join(&hash);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, &wrong).unwrap();
        refused += u32::from(catalog.actor(&hash).is_err());
        std::fs::remove_file(&path).unwrap();
    }
    assert!(refused > 1_500, "{refused} of 2,000 were refused");
}

/// The steps of a push.
fn add(catalog: &Catalog, name: &str, seed: u64) -> Result<AddedActor, StoreError> {
    catalog.add_actor(&asset(name, seed), RecordFormat::Q32, SameName::Refused)
}

fn names(actors: &[StoredActor]) -> Vec<&str> {
    actors.iter().map(|actor| &*actor.description.name).collect()
}

#[test]
fn damage_is_the_assets_own() {
    everywhere(|place| {
        let catalog = place.catalog();
        let van = add(&catalog, "van", 1).unwrap().actor;
        let car = add(&catalog, "car", 2).unwrap().actor;
        let path = place.twins().join(".actors/objects").join(&car.hash[..2]).join(&car.hash);
        let whole = std::fs::read(&path).unwrap();
        let with = |at: usize, byte: u8| {
            let mut bytes = whole.clone();
            bytes[at] ^= byte;
            bytes
        };
        let last = whole.len() - 1;
        for (bytes, name, why) in [
            (with(last, 1), Some("car"), "its bytes hash to"),
            (whole[..last].to_vec(), Some("car"), "its bytes hash to"),
            (with(0, 1), None, "it does not start as an actor"),
            (with(8, 2), None, "it has format 3; this build reads format 1"),
            (whole[..100].to_vec(), None, "it ends in its header"),
            (Vec::new(), None, "it is shorter than its start"),
        ] {
            std::fs::write(&path, &bytes).unwrap();
            let ActorList { actors, damaged } = catalog.actors().unwrap();
            assert_eq!((actors, damaged.len()), (vec![van.clone()], 1), "{why}");
            assert_eq!((&damaged[0].hash, damaged[0].name.as_deref()), (&car.hash, name));
            assert!(damaged[0].reason.contains(why), "{damaged:?}");
            for text in ["van", &van.hash, &van.hash[..6]] {
                assert_eq!(catalog.find_actor(text).unwrap(), van);
            }
            let mut texts = vec![&*car.hash, &car.hash[..8]];
            texts.extend(name);
            for text in texts {
                let error = catalog.find_actor(text).unwrap_err();
                assert!(matches!(error, StoreError::ActorDamaged { .. }), "{error}");
                assert!(error.to_string().contains(why), "{error}");
            }
            catalog.actor(&van.hash).unwrap();
            let error = catalog.actor(&car.hash).unwrap_err();
            assert!(matches!(error, StoreError::ActorDamaged { .. }), "{error}");
            // Another asset may be stored, also one of the same name.
            let other = add(&catalog, "car", 3).unwrap().actor;
            assert_eq!(catalog.find_actor("car").unwrap(), other);
            catalog.remove_actor(&other.hash, false).unwrap();
            // Storing the same asset again repairs it.
            assert_eq!(add(&catalog, "car", 2).unwrap().actor, car);
            assert_eq!(std::fs::read(&path).unwrap(), whole);
            assert_eq!(names(&catalog.actors().unwrap().actors), ["car", "van"]);
        }
        // Digits that a damaged one has, too, stand for neither.
        let alike = format!("{}{}", &van.hash[..6], "0".repeat(58));
        let path_alike = path.parent().unwrap().with_file_name(&alike[..2]).join(&alike);
        std::fs::write(&path_alike, "damaged").unwrap();
        let error = catalog.find_actor(&van.hash[..6]).unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 2, .. }), "{error}");
        assert_eq!(catalog.find_actor(&van.hash[..12]).unwrap(), van);
        std::fs::remove_file(path_alike).unwrap();
        // A lost asset does not exist.
        std::fs::remove_file(&path).unwrap();
        assert_eq!(names(&catalog.actors().unwrap().actors), ["van"]);
        let error = catalog.find_actor(&car.hash).unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 0, .. }), "{error}");
        assert!(add(&catalog, "car", 2).unwrap().is_new);
    });
}

#[test]
fn a_link_a_pipe_and_a_directory_are_damaged_assets() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let van = add(&catalog, "van", 1).unwrap().actor;
    let car = add(&catalog, "car", 2).unwrap().actor;
    let path = dir.path().join(".actors/objects").join(&car.hash[..2]).join(&car.hash);
    let elsewhere = dir.path().join("elsewhere");
    std::fs::copy(&path, &elsewhere).unwrap();
    let loops = || std::os::unix::fs::symlink(&path, &path).unwrap();
    let leaves = || std::os::unix::fs::symlink(&elsewhere, &path).unwrap();
    let pipe = || {
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
    };
    let folder = || std::fs::create_dir(&path).unwrap();
    let cases: [(&dyn Fn(), &str, bool); 4] = [
        (&loops, "it is a symbolic link", true),
        (&leaves, "it is a symbolic link", true),
        (&pipe, "it is not a regular file", true),
        (&folder, "it is not a regular file", false),
    ];
    for (replace, why, is_repaired) in cases {
        std::fs::remove_file(&path).unwrap();
        replace();
        let ActorList { actors, damaged } = catalog.actors().unwrap();
        assert_eq!((actors, damaged.len()), (vec![van.clone()], 1), "{why}");
        assert!(damaged[0].hash == car.hash && damaged[0].reason.contains(why), "{damaged:?}");
        assert_eq!(catalog.find_actor("van").unwrap(), van);
        for error in
            [catalog.find_actor(&car.hash).unwrap_err(), catalog.actor(&car.hash).unwrap_err()]
        {
            assert!(matches!(error, StoreError::ActorDamaged { .. }), "{error}");
            assert!(error.to_string().contains(why), "{error}");
            assert!(!error.to_string().contains(&*dir.path().to_string_lossy()), "{error}");
        }
        add(&catalog, "car", 3).unwrap();
        catalog.remove_actor("car", false).unwrap();
        if is_repaired {
            assert!(add(&catalog, "car", 2).unwrap().is_new);
            assert_eq!(catalog.actors().unwrap().actors.len(), 2);
        } else {
            let error = catalog.remove_actor(&car.hash, false).unwrap_err().to_string();
            assert!(error.starts_with("cannot remove") && error.contains(&car.hash), "{error}");
        }
    }
}

/// A folder of objects that is not a folder: a link to itself or a file in its place.
#[test]
fn a_damaged_folder_hides_no_other() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let van = add(&catalog, "van", 1).unwrap().actor;
    let put = |seed| catalog.put_actor(&asset("car", seed), RecordFormat::Q32).unwrap();
    let car = (2..).map(put);
    // Assets of another folder than the first.
    let car = { car }.find(|car| car.hash[..2] != van.hash[..2]).unwrap();
    let folder = dir.path().join(".actors/objects").join(&car.hash[..2]);
    let whole = dir.path().join("elsewhere");
    std::fs::rename(&folder, &whole).unwrap();
    let links = |to: &std::path::Path| std::os::unix::fs::symlink(to, &folder).unwrap();
    let loops = || links(&folder);
    let dangles = || links(&dir.path().join("nowhere"));
    let file = || std::fs::write(&folder, "no folder").unwrap();
    let cases: [&dyn Fn(); 3] = [&loops, &dangles, &file];
    for replace in cases {
        replace();
        let ActorList { actors, damaged } = catalog.actors().unwrap();
        assert_eq!((actors, damaged.len()), (vec![van.clone()], 1));
        assert_eq!((&*damaged[0].hash, &damaged[0].name), (&car.hash[..2], &None));
        assert!(damaged[0].reason.contains("it is not a directory"), "{damaged:?}");
        for text in ["van", &van.hash, &van.hash[..6]] {
            assert_eq!(catalog.find_actor(text).unwrap(), van);
        }
        catalog.actor(&van.hash).unwrap();
        for error in [
            catalog.find_actor(&car.hash).unwrap_err(),
            catalog.find_actor(&car.hash[..6]).unwrap_err(),
            catalog.actor(&car.hash).unwrap_err(),
            catalog.remove_actor(&car.hash, true).unwrap_err(),
            catalog.remove_actor(&car.hash, false).unwrap_err(),
        ] {
            assert!(matches!(error, StoreError::ActorDamaged { .. }), "{error}");
            assert!(error.to_string().contains("mend it in the store"), "{error}");
            assert!(!error.to_string().contains(&*dir.path().to_string_lossy()), "{error}");
        }
        let error = catalog.find_actor("bus").unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 0, .. }), "{error}");
        let other = (20..).map(|seed| asset("bus", seed));
        let bus = { other }
            .find_map(|bus| catalog.add_actor(&bus, RecordFormat::Q32, SameName::Refused).ok());
        assert_eq!(catalog.remove_actor("bus", false).unwrap(), bus.unwrap().actor.hash);
        std::fs::remove_file(&folder).unwrap();
    }
    // A link to a folder is one.
    links(&whole);
    assert_eq!(catalog.find_actor(&car.hash).unwrap(), car);
    assert_eq!(catalog.actors().unwrap().damaged, []);
}

#[test]
fn an_asset_is_removed_alone() {
    everywhere(|place| {
        let catalog = place.catalog();
        let objects = || {
            let of = place.twins().join(".actors");
            if matches!(place, Place::S3(_)) { keys(&of) } else { files(&of) }
        };
        let van = add(&catalog, "van", 1).unwrap().actor;
        let car = add(&catalog, "car", 2).unwrap().actor;
        let twice = catalog.put_actor(&asset("car", 3), RecordFormat::Q32).unwrap();
        // Neither of two that have the name.
        let error = catalog.remove_actor("car", false).unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 2, .. }), "{error}");
        assert!(error.to_string().contains(&twice.hash[..12]), "{error}");
        assert_eq!(catalog.remove_actor(&twice.hash[..12], true).unwrap(), twice.hash);
        assert_eq!(objects().len(), 3, "nothing is removed by a dry run");
        assert_eq!(catalog.remove_actor(&twice.hash[..12], false).unwrap(), twice.hash);
        assert_eq!(catalog.remove_actor("car", false).unwrap(), car.hash);
        assert_eq!(catalog.actors().unwrap().actors, std::slice::from_ref(&van));
        assert_eq!(objects().len(), 1);
        let error = catalog.actor(&car.hash).unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 0, .. }), "{error}");
        let error = catalog.remove_actor("car", false).unwrap_err();
        assert!(matches!(error, StoreError::NoActor { found: 0, .. }), "{error}");
        // A damaged one.
        let path = place.twins().join(".actors/objects").join(&van.hash[..2]).join(&van.hash);
        std::fs::write(path, "damaged").unwrap();
        assert_eq!(catalog.remove_actor(&van.hash, false).unwrap(), van.hash);
        assert_eq!(catalog.actors().unwrap(), ActorList::default());
        assert_eq!(objects().len(), 0);
        assert!(add(&catalog, "car", 2).unwrap().is_new, "its name is free again");
    });
}

#[test]
fn garbage_collection_of_twins_keeps_assets() {
    everywhere(|place| {
        let catalog = place.catalog();
        let car = add(&catalog, "car", 1).unwrap().actor;
        for seed in 1..3 {
            commit(&catalog, &gaussians(500, 0, 40.0, seed));
        }
        let keep = Retention { versions: 1, grace: std::time::Duration::ZERO };
        catalog.collect("street", keep, false).unwrap();
        assert!(catalog.collect("street", keep, false).unwrap().removed.objects > 0);
        assert_eq!(catalog.actor(&car.hash).unwrap().description, car.description);
        let error = catalog.collect(".actors", keep, false).unwrap_err();
        assert!(matches!(error, StoreError::Name { .. }), "{error}");
    });
}

#[test]
fn an_asset_in_a_failing_object_store_is_whole_or_none() {
    let s3 = S3::start();
    let catalog = s3.catalog();
    let objects = || keys(&s3.twins().join(".actors/objects")).len();
    s3.fail("PUT", "/.actors/objects/", 3, Fault::Status(500));
    let error = add(&catalog, "car", 1).unwrap_err().to_string();
    assert!(error.starts_with("cannot write s3://bucket/twins/.actors/objects/"), "{error}");
    assert_eq!((s3.to_fail(), objects()), (0, 0));
    assert_eq!(catalog.actors().unwrap(), ActorList::default());
    for (seed, fault) in (1..).zip([Fault::Status(503), Fault::AnswerLost, Fault::Denied(500)]) {
        let name = format!("car{seed}");
        s3.fail("PUT", "/.actors/objects/", 1, fault);
        let added = add(&catalog, &name, seed).unwrap();
        assert_eq!((added.is_new, s3.to_fail()), (true, 0), "{fault:?}");
        assert_eq!(catalog.find_actor(&name).unwrap(), added.actor);
        assert_eq!(catalog.actor(&added.actor.hash).unwrap().description, added.actor.description);
        assert!(!add(&catalog, &name, seed).unwrap().is_new);
    }
    let error = add(&catalog, "car1", 9).unwrap_err();
    assert!(matches!(error, StoreError::ActorExists { .. }), "{error}");
    assert_eq!(objects(), 3);
    // Damage on the way is read again; an asset that cannot be read hides no other.
    s3.fail("GET", "/.actors/objects/", 1, Fault::Flipped);
    assert_eq!(names(&catalog.actors().unwrap().actors), ["car1", "car2", "car3"]);
    s3.fail("GET", "/.actors/objects/", 3, Fault::Status(500));
    let ActorList { actors, damaged } = catalog.actors().unwrap();
    assert_eq!((actors.len(), damaged.len(), s3.to_fail()), (2, 1, 0));
    assert!(damaged[0].reason.starts_with("cannot read it"), "{damaged:?}");
    // It may have any name: no name is given to another, or said to be free.
    for name in ["car1", "car2", "car3", "car4"] {
        s3.fail("GET", "/.actors/objects/", 3, Fault::Status(500));
        let error = catalog.find_actor(name).unwrap_err();
        assert!(matches!(error, StoreError::Io { .. }), "{name}: {error}");
        assert_eq!(s3.to_fail(), 0);
    }
    s3.fail("GET", "/.actors/objects/", 3, Fault::Status(500));
    let error = add(&catalog, "car4", 4).unwrap_err();
    assert!(matches!(error, StoreError::Io { .. }), "{error}");
}

#[test]
fn what_is_cut_out_and_what_stays_are_the_twin() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let all = gaussians(20_000, 1, 30.0, 3);
    let new = NewVersion {
        storage: StorageOptions { record: RecordFormat::F32, levels: false },
        ..NewVersion::from_gaussians("street", &all, Provenance::new("test".to_owned()))
    };
    let base = catalog.commit(new, &mut |_, _| {}).unwrap();
    let pose =
        Pose { position_m: DVec3::new(3.0, -2.0, -5.0), rotation: DQuat::from_rotation_z(0.6) };
    let box_ = ActorBox { length_m: 12.0, width_m: 8.0, height_m: 9.0 };
    let inside = |mean_m: &[f64; 3]| {
        let at_m = pose.inverse().transform_point(DVec3::from_array(*mean_m));
        at_m.x.abs() <= 6.0 && at_m.y.abs() <= 4.0 && at_m.z >= CUT_ABOVE_M && at_m.z <= 9.0
    };
    let wanted = all.means_m.iter().filter(|mean_m| inside(mean_m)).count();
    assert!(wanted > 20);
    let cut = catalog.cut(&base, &pose, &box_).unwrap();
    assert_eq!(cut.gaussians.len(), wanted);
    assert_eq!(cut.version.number, 2);
    assert_eq!(cut.version.manifest.gaussians(), 20_000 - wanted as u64);
    // Put back, all of them are where they were.
    let mut back = cut.gaussians;
    back.transform(&pose);
    let sorted = |gaussians: &Gaussians| {
        let mut means: Vec<[i64; 3]> = gaussians
            .means_m
            .iter()
            .filter(|mean_m| inside(mean_m))
            .map(|mean_m| mean_m.map(|m| (m * 1e4).round() as i64))
            .collect();
        means.sort_unstable();
        means
    };
    let [was, is] = [sorted(&all), sorted(&back)];
    let off = was.iter().zip(&is).flat_map(|(a, b)| (0..3).map(move |k| (a[k] - b[k]).abs()));
    assert!(off.max().unwrap() <= 1 && was.len() == is.len());

    let nothing = catalog.cut(&cut.version, &pose, &box_).unwrap_err();
    assert!(matches!(nothing, StoreError::NothingToCut { cell: None }), "{nothing}");
}
