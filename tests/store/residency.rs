use std::fs;
use std::sync::Arc;

use glam::DVec3;
use wildcity::residency::{Cache, Eye, ResidencyError, Resident};
use wildcity::scene::RenderProfile;
use wildcity::store::Catalog;

use crate::scene_files::gaussians;
use crate::{commit, street};

/// Gaussians that a camera with all of the twin's detail draws.
fn gaussians_of(resident: &Resident) -> usize {
    let eye = Eye { position_m: DVec3::ZERO, focal_px: 1000.0 };
    resident.scene(&[eye], &RenderProfile { tau_px: 0.0, ..RenderProfile::default() }).gaussians()
}

#[test]
fn sessions_share_one_resident_twin() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), street(&gaussians(20_000, 1, 100.0, 1))).unwrap();
    let cache = Cache::new(Catalog::open(dir.path()).unwrap());
    let held: Vec<_> = std::thread::scope(|scope| {
        let opens: Vec<_> =
            (0..8).map(|_| scope.spawn(|| cache.open("street", None).unwrap())).collect();
        opens.into_iter().map(|open| open.join().unwrap()).collect()
    });
    assert!(held.iter().all(|resident| Arc::ptr_eq(resident, &held[0])), "loaded once");
    assert_eq!(Arc::strong_count(&held[0]), 8 + 1, "and the cache's own, for the next session");
    assert_eq!(gaussians_of(&held[0]), 20_000);
    assert_eq!(held[0].version.number, 1);

    // A session keeps the version it opened; a new one gets the latest.
    commit(dir.path(), street(&gaussians(10, 1, 100.0, 2))).unwrap();
    let latest = cache.open("street", None).unwrap();
    assert_eq!((latest.version.number, gaussians_of(&latest)), (2, 10));
    let old = cache.open("street", Some(1)).unwrap();
    assert!(Arc::ptr_eq(&old, &held[0]));

    // What was opened last stays for the next session, until another twin is opened.
    let first = Arc::downgrade(&held[0]);
    drop((held, old, latest));
    let again = cache.open("street", Some(1)).unwrap();
    assert!(std::ptr::eq(first.as_ptr(), &*again), "loaded again");
    drop(again);
    assert_eq!(gaussians_of(&cache.open("street", Some(2)).unwrap()), 10);
    assert!(first.upgrade().is_none(), "nobody holds it, and another was opened since");
    assert_eq!(gaussians_of(&cache.open("street", Some(1)).unwrap()), 20_000);
    assert_eq!(cache.twins().unwrap().len(), 1);
}

#[test]
fn a_failed_load_is_tried_again() {
    let dir = tempfile::tempdir().unwrap();
    let version = commit(dir.path(), street(&gaussians(1_000, 0, 10.0, 1))).unwrap();
    let cache = Cache::new(Catalog::open(dir.path()).unwrap());
    let hash = &version.manifest.chunks[0].object;
    let path = dir.path().join("street/objects").join(&hash[..2]).join(hash);
    let away = dir.path().join("away");
    fs::rename(&path, &away).unwrap();
    assert!(cache.open("street", None).unwrap_err().to_string().contains("cannot open"));
    fs::rename(&away, &path).unwrap();
    assert_eq!(gaussians_of(&cache.open("street", None).unwrap()), 1_000);
}

#[test]
fn a_gaussian_of_degree_one_takes_at_most_120_bytes() {
    let dir = tempfile::tempdir().unwrap();
    commit(dir.path(), street(&gaussians(50_000, 1, 200.0, 1))).unwrap();
    let cache = Cache::new(Catalog::open(dir.path()).unwrap());
    let resident = cache.open("street", None).unwrap();
    let each = resident.bytes() as f64 / 50_000.0;
    assert!((92.0..120.0).contains(&each), "{each} bytes");
}

#[test]
fn twins_that_do_not_fit_beside_those_in_use_are_refused_before_they_are_loaded() {
    let dir = tempfile::tempdir().unwrap();
    let (few, many) = (gaussians(1_000, 1, 100.0, 1), gaussians(5_000, 1, 100.0, 2));
    commit(dir.path(), street(&few)).unwrap();
    commit(dir.path(), street(&many)).unwrap();
    let catalog = Catalog::open(dir.path()).unwrap();
    let unlimited = Cache::new(catalog.clone());
    let [few_bytes, many_bytes] =
        [1, 2].map(|number| unlimited.open("street", Some(number)).unwrap().bytes() as u64);

    let cache = Cache::limited(catalog.clone(), Some(few_bytes + many_bytes - 1));
    let held = cache.open("street", Some(1)).unwrap();
    match cache.open("street", Some(2)).unwrap_err() {
        ResidencyError::NoRoom { needed_bytes, held_bytes, limit_bytes, .. } => {
            let wanted = (many_bytes, few_bytes, few_bytes + many_bytes - 1);
            assert_eq!((needed_bytes, held_bytes, limit_bytes), wanted, "exact, and unloaded");
        }
        error => panic!("{error}"),
    }
    // What is in memory already costs nothing more, and what is let go is room again.
    let again = cache.open("street", Some(1)).unwrap();
    assert!(Arc::ptr_eq(&again, &held));
    drop((again, held));
    assert_eq!(gaussians_of(&cache.open("street", Some(2)).unwrap()), 5_000);

    let both = Cache::limited(catalog, Some(few_bytes + many_bytes));
    let held = both.open("street", Some(1)).unwrap();
    assert_eq!(gaussians_of(&both.open("street", Some(2)).unwrap()), 5_000);
    drop(held);
}
