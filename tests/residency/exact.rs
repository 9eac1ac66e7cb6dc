//! The drawn sections are a function of the pose: the amount of memory changes when a frame is
//! drawn, never its pixels.

use wildcity_scene::RenderProfile;
use wildcity_twin::residency::{BlockIndex, Cache, Resident, RigExtent};

use crate::scene_files::Random;
use crate::streaming::{PROFILE, bytes, demo, eyes, need_bytes, pixels, unlimited, views};

/// A frame's pixels. Checks that the memory stays within its limit.
fn drawn(resident: &std::sync::Arc<Resident>, station_m: f64) -> Vec<Vec<u8>> {
    let pose = demo().at(station_m);
    let scene = resident.scene(&eyes(&views(pose)), &PROFILE).unwrap();
    let stats = resident.stats();
    assert!(stats.held_bytes <= stats.limit_bytes, "{stats:?}");
    pixels(&scene, pose)
}

#[test]
fn a_cache_of_exactly_what_a_frame_needs_draws_it() {
    let all = unlimited().open("demo", None).unwrap();
    for station_m in [0.0, 200.0, 410.0] {
        let limit_bytes = need_bytes(&all, demo().at(station_m));
        let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
        let resident = cache.open("demo", None).unwrap();
        assert_eq!(drawn(&resident, station_m), drawn(&all, station_m));
        let stats = cache.stats();
        assert_eq!((stats.held_bytes, stats.evictions), (limit_bytes, 0), "to the byte");

        let less = Cache::limited(demo().catalog(), Some(limit_bytes - 1));
        let resident = less.open("demo", None).unwrap();
        let views = views(demo().at(station_m));
        let refused = resident.scene(&eyes(&views), &PROFILE).unwrap_err().to_string();
        assert!(refused.contains(&limit_bytes.to_string()), "{refused}");
        assert_eq!(less.stats().loads, 0, "refused before anything is loaded");
    }
}

#[test]
fn two_hundred_teleports_under_random_budgets_draw_what_the_whole_twin_does() {
    let all = unlimited().open("demo", None).unwrap();
    let mut random = Random(7);
    let most = (0..60).map(|i| need_bytes(&all, demo().at(10.0 * f64::from(i)))).max().unwrap();
    for _ in 0..5 {
        let limit_bytes = most + (random.unit() * most as f64) as u64;
        let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
        let resident = cache.open("demo", None).unwrap();
        for _ in 0..40 {
            // Poses on a grid, so that one image drawn with unlimited memory serves many of them.
            let station_m = 10.0 * (random.unit() * 59.0).floor();
            assert_eq!(drawn(&resident, station_m), drawn(&all, station_m), "at {station_m} m");
        }
        let stats = cache.stats();
        assert!(stats.evictions > 0 && stats.hits > 0 && stats.misses > 0, "{stats:?}");
        assert_eq!(stats.loads, stats.misses, "nothing is loaded twice at a time");
    }
}

#[test]
fn the_index_finds_what_looking_at_every_block_finds() {
    let resident = unlimited().open("demo", None).unwrap();
    let manifest = &resident.version.manifest;
    let index = BlockIndex::new(manifest);
    let mut random = Random(3);
    for reach_m in [None, Some(0.0), Some(30.0), Some(120.0), Some(5_000.0)] {
        for tau_px in [0.0, 0.5, 4.0] {
            let profile = RenderProfile { reach_m, tau_px, ..PROFILE };
            for _ in 0..10 {
                let mut pose = demo().at(700.0 * random.unit() - 50.0);
                pose.position_m.y += 400.0 * random.unit() - 200.0;
                let eyes = eyes(&views(pose));
                let plain = plain_walk(manifest, &eyes, &profile);
                assert_eq!(index.demand(manifest, &eyes, &profile), plain);
            }
        }
    }
}

/// The rule, computed without an index.
fn plain_walk(
    manifest: &wildcity_scene::Manifest,
    eyes: &[wildcity_twin::residency::Viewpoint],
    profile: &RenderProfile,
) -> Vec<wildcity_twin::residency::SectionRef> {
    let mut needed = Vec::new();
    for (chunk, entry) in manifest.chunks.iter().enumerate() {
        for (section, full) in entry.sections.iter().enumerate().filter(|(_, s)| s.level == 0) {
            let bounds = entry.section_bounds(full);
            let level = |eye: &wildcity_twin::residency::Viewpoint| {
                let distance_m = bounds.distance_m(eye.position_m);
                let levels = entry.sections[section..].iter().take_while(|s| s.block == full.block);
                let small =
                    |error_m: f32| eye.focal_px * f64::from(error_m) <= profile.tau_px * distance_m;
                let drawn = levels.enumerate().filter(|(_, s)| small(s.error_m)).last();
                let is_near = profile.reach_m.is_none_or(|reach_m| distance_m <= reach_m);
                is_near.then(|| drawn.map_or(0, |(level, _)| level))
            };
            let drawn: std::collections::BTreeSet<_> = eyes.iter().filter_map(level).collect();
            needed.extend(drawn.into_iter().map(|level| wildcity_twin::residency::SectionRef {
                chunk,
                section: section + level,
            }));
        }
    }
    needed
}

#[test]
fn no_frame_anywhere_needs_more_than_the_worst() {
    let resident = unlimited().open("demo", None).unwrap();
    let mut random = Random(11);
    let lens = RigExtent { views: 2, focal_px: 70.0, least_focal_px: 40.0, radius_m: 1.7 };
    let worst_case_bytes = resident.worst_case_bytes(lens);
    let mut most_bytes = 0;
    for _ in 0..3_000 {
        let mut pose = demo().at(650.0 * random.unit() - 25.0);
        pose.position_m.x += 60.0 * random.unit() - 30.0;
        pose.position_m.y += 200.0 * random.unit() - 100.0;
        pose.position_m.z += 50.0 * random.unit() - 10.0;
        let needed = resident.demand(&eyes(&views(pose)), &PROFILE);
        most_bytes = most_bytes.max(bytes(&resident, &needed));
    }
    assert!(most_bytes <= worst_case_bytes, "{most_bytes} of {worst_case_bytes}");
    assert!(
        worst_case_bytes <= 2 * most_bytes,
        "{worst_case_bytes} is no bound of {most_bytes} to use"
    );
    assert!(worst_case_bytes < resident.total_bytes());
}
