//! Drives through a city from end to end, with memory for a small part of it.

use wildcity_scene::route::Route;
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::city_twin::{City, city};
use crate::streaming::{PROFILE, bytes, eyes, pixels, views};

#[test]
fn two_kilometres_with_the_memory_of_the_worst_frame_look_as_with_unlimited_memory() {
    let City { dir, drive } = city(2_000.0);
    let open = |limit_bytes: Option<u64>| {
        let cache = Cache::limited(Catalog::open(dir.path()).unwrap(), limit_bytes);
        let resident = cache.open("city", None).unwrap();
        (cache, resident)
    };
    let (_all, whole) = open(None);
    let route = Route::new(&drive).unwrap();
    let poses: Vec<_> =
        (0..=50).map(|i| route.at(f64::from(i) * route.length_m() / 50.0).world_from_rig).collect();
    let need = |pose| bytes(&whole, &whole.demand(&eyes(&views(pose)), &PROFILE));
    let limit_bytes = poses.iter().map(|&pose| need(pose)).max().unwrap();
    assert!(8 * limit_bytes < whole.total_bytes(), "{limit_bytes} of {}", whole.total_bytes());

    let (cache, resident) = open(Some(limit_bytes));
    for pose in poses {
        let eyes = eyes(&views(pose));
        let scene = resident.scene(&eyes, &PROFILE).unwrap();
        let held_bytes = cache.stats().held_bytes;
        assert!(held_bytes <= limit_bytes, "{held_bytes} of {limit_bytes}");
        let truth = whole.scene(&eyes, &PROFILE).unwrap();
        assert_eq!(pixels(&scene, pose), pixels(&truth, pose), "at {:?}", pose.position_m);
    }
    let stats = cache.stats();
    assert!(stats.evictions > 1000, "{stats:?}");
}
