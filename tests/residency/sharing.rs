//! Sections that several sessions or versions share are in memory once.

use std::sync::Arc;

use glam::DVec3;
use wildcity_scene::{Chunk, RenderProfile};
use wildcity_twin::residency::{Cache, Resident, RigExtent, Viewpoint};

use crate::scene_files::gaussians;
use crate::source::Faulty;
use crate::streaming::{PROFILE, commit, demo, eyes, need_bytes, unlimited, views};

/// Everything in full detail.
fn pin_all(resident: &Arc<Resident>) -> wildcity_twin::residency::PinnedScene {
    let eye = Viewpoint { position_m: DVec3::ZERO, focal_px: 1000.0 };
    let profile = RenderProfile { tau_px: 0.0, reach_m: None, ..PROFILE };
    resident.scene(&[eye], &profile).unwrap()
}

#[test]
fn two_sessions_on_one_road_load_it_once() {
    let source = Arc::new(Faulty::new(demo().catalog()));
    let cache = Cache::with_source(demo().catalog(), source.clone(), None);
    let held: Vec<_> = std::thread::scope(|scope| {
        let opens: Vec<_> =
            (0..8).map(|_| scope.spawn(|| cache.open("demo", None).unwrap())).collect();
        opens.into_iter().map(|open| open.join().unwrap()).collect()
    });
    assert!(held.iter().all(|resident| Arc::ptr_eq(resident, &held[0])), "opened once");
    let eyes = eyes(&views(demo().at(100.0)));
    let scenes: Vec<_> = std::thread::scope(|scope| {
        let asks = held.iter().map(|resident| scope.spawn(|| resident.scene(&eyes, &PROFILE)));
        let asks: Vec<_> = asks.collect();
        asks.into_iter().map(|ask| ask.join().unwrap().unwrap()).collect()
    });
    for scene in &scenes {
        let mut pairs = scene.chunks.iter().zip(&scenes[0].chunks);
        assert!(pairs.all(|(a, b)| Arc::ptr_eq(a, b)), "one copy");
    }
    assert_eq!(source.most_reads(), 1);
    assert_eq!(cache.stats().held_bytes, need_bytes(&held[0], demo().at(100.0)));
}

#[test]
fn versions_share_the_memory_of_common_sections() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = gaussians(20_000, 1, 300.0, 1);
    commit(dir.path(), "street", &scene);
    let catalog = wildcity_twin::store::Catalog::open(dir.path()).unwrap();
    let cache = Cache::new(catalog);
    let first = cache.open("street", None).unwrap();
    let old = pin_all(&first);
    let old_bytes = cache.stats().held_bytes;
    assert_eq!(old_bytes, old.bytes() as u64, "what is accounted for is what is held");

    // One Gaussian changes, and so one block of one cell.
    scene.sh[0] += 0.5;
    commit(dir.path(), "street", &scene);
    let second = cache.open("street", None).unwrap();
    let new = pin_all(&second);
    let same = new.chunks.iter().filter(|chunk| old.chunks.iter().any(|o| Arc::ptr_eq(o, chunk)));
    let same = same.count();
    assert_eq!((new.chunks.len() - same, old.chunks.len()), (1, new.chunks.len()));
    let changed = new.chunks.iter().find(|c| !old.chunks.iter().any(|o| Arc::ptr_eq(o, c)));
    assert_eq!(cache.stats().held_bytes - old_bytes, changed.unwrap().bytes() as u64);

    // The old version is unchanged, and a version that is opened again finds its sections in
    // memory.
    let loads = cache.stats().loads;
    drop((old, first, new, second));
    let again = pin_all(&cache.open("street", Some(1)).unwrap());
    assert_eq!(again.gaussians(), 20_000);
    assert_eq!(cache.stats().loads, loads);
}

#[test]
fn a_section_takes_the_memory_that_is_computed_for_it() {
    let resident = unlimited().open("demo", None).unwrap();
    let scene = pin_all(&resident);
    for chunk in &scene.chunks {
        let classes = chunk.classes().map_or(0, <[_]>::len) as u64;
        let said = Chunk::needed_bytes(chunk.sh_degree(), chunk.len() as u64) + classes;
        assert_eq!(said, chunk.bytes() as u64);
    }
    let each = scene.bytes() as f64 / scene.gaussians() as f64;
    assert!(each < 120.0, "{each} bytes a Gaussian");
}

#[test]
fn a_thousand_sessions_leave_nothing_behind() {
    let cache = Cache::limited(demo().catalog(), Some(32 << 20));
    let lens = RigExtent { views: 2, focal_px: 70.0, least_focal_px: 40.0, radius_m: 1.7 };
    let before = cache.stats();
    for session in 0..1_000 {
        let resident = cache.open("demo", None).unwrap();
        let reservation = resident.reserve(lens).unwrap();
        if session % 10 == 0 {
            let eyes = eyes(&views(demo().at(f64::from(session) * 0.6)));
            resident.scene(&eyes, &PROFILE).unwrap();
        }
        assert!(cache.stats().reserved_bytes == reservation.bytes());
    }
    let after = cache.stats();
    assert_eq!((before.reserved_bytes, after.reserved_bytes), (0, 0));
    assert!(after.held_bytes <= after.limit_bytes && after.evictions > 0, "{after:?}");
}
