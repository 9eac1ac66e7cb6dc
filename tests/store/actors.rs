//! Assets of actors in the store, and cutting them out of a twin.

use glam::{DQuat, DVec3};
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::Pose;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass, Gaussians, RecordFormat};
use wildcity_twin::store::{CUT_ABOVE_M, Catalog, NewVersion, StorageOptions, StoreError};

use crate::scene_files::gaussians;

fn description(name: &str) -> AssetDescription {
    AssetDescription {
        name: name.to_owned(),
        class: ActorClass::Vehicle,
        box_: ActorBox { length_m: 4.0, width_m: 4.0, height_m: 4.0 },
        provenance: Provenance::of("test".to_owned()),
    }
}

fn asset(name: &str, seed: u64) -> ActorAsset {
    ActorAsset::new(&gaussians(3_000, 1, 2.0, seed), description(name)).unwrap()
}

#[test]
fn an_asset_is_read_as_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    assert_eq!(catalog.actors().unwrap(), []);
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
    // The same again is the same object; another record is another one.
    assert_eq!(catalog.put_actor(&car, RecordFormat::F32).unwrap(), stored);
    assert_eq!(catalog.actors().unwrap(), std::slice::from_ref(&stored));
    let small = catalog.put_actor(&car, RecordFormat::Q32).unwrap();
    assert!(small.hash != stored.hash && small.bytes < stored.bytes);
    // Assets are no twin, and no garbage.
    assert!(catalog.twins().unwrap().twins.is_empty());
    Catalog::open(dir.path()).unwrap();
    assert_eq!(catalog.actors().unwrap().len(), 2);
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
        assert!(matches!(error, StoreError::Damaged { .. }), "byte {at}: {error}");
    }
    // Objects whose hash is right and whose content is not: as of another program.
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

#[test]
fn what_is_cut_out_and_what_stays_are_the_twin() {
    let dir = tempfile::tempdir().unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let all = gaussians(20_000, 1, 30.0, 3);
    let new = NewVersion {
        storage: StorageOptions { record: RecordFormat::F32, levels: false },
        ..NewVersion::of("street", &all, Provenance::of("test".to_owned()))
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
