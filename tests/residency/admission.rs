//! Admission: which sessions may open, and what an open session can rely on.

use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use wildcity_twin::residency::{
    Cache, FrameBytes, ResidencyError, RigExtent, SceneBytes, SectionRef,
};

use crate::scene_files::{Random, gaussians};
use crate::streaming::{PROFILE, TEST_TIMEOUT, commit, demo, eyes, pixels, unlimited, views};

const EXTENT: RigExtent =
    RigExtent { views: 2, focal_px: 70.0, least_focal_px: 40.0, radius_m: 1.7 };

#[test]
fn sessions_beyond_the_memory_are_refused_with_the_numbers() {
    let worst_case_bytes = unlimited().open("demo", None).unwrap().worst_case_bytes(EXTENT);
    let limit_bytes = 2 * worst_case_bytes + 1;
    let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
    let resident = cache.open("demo", None).unwrap();
    assert!(limit_bytes < resident.total_bytes(), "else there is room for everything");
    let held = [resident.reserve(EXTENT).unwrap(), resident.reserve(EXTENT).unwrap()];
    let refused = resident.reserve(EXTENT).unwrap_err();
    match &refused {
        ResidencyError::NoRoom { twin, needed_bytes, held_bytes, limit_bytes: limit } => {
            let said = (twin.as_str(), *needed_bytes, *held_bytes, *limit);
            assert_eq!(said, ("demo", worst_case_bytes, 2 * worst_case_bytes, limit_bytes));
        }
        other => panic!("{other}"),
    }
    assert!(refused.to_string().contains("--memory-gib"), "{refused}");
    assert_eq!(cache.stats().reserved_bytes, 2 * worst_case_bytes);
    drop(held);
    assert!(resident.reserve(EXTENT).is_ok(), "what is given back is there again");
    assert_eq!(cache.stats().reserved_bytes, 0);
}

/// The intermediate buffers of frames count once, their images for each session, and both are taken
/// from the sections in memory.
#[test]
fn frames_take_memory_from_the_sections() {
    let all = unlimited().open("demo", None).unwrap();
    let scene_bytes = all.worst_case_bytes_with(EXTENT, &PROFILE);
    let images = scene_bytes / 8;
    let limit_bytes = 4 * scene_bytes;
    let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
    let resident = cache.open("demo", None).unwrap();
    let reserve_frame = |frame| resident.reserve_with(EXTENT, &PROFILE, frame);
    let reserve = |stages| reserve_frame(FrameBytes { stages, images, ..FrameBytes::default() });
    for station_m in (0..10).map(|k| 60.0 * f64::from(k)) {
        drop(resident.scene(&eyes(&views(demo().at(station_m))), &PROFILE).unwrap());
    }
    assert!(cache.stats().held_bytes > scene_bytes, "{:?}", cache.stats());

    // A frame that takes everything that its scene leaves.
    let first = reserve(limit_bytes - scene_bytes - images).unwrap();
    assert_eq!(first.bytes(), limit_bytes);
    assert!(cache.stats().held_bytes <= scene_bytes, "{:?}", cache.stats());
    assert!(matches!(reserve(0), Err(ResidencyError::NoRoom { .. })));
    drop(first);

    let stages = scene_bytes / 2;
    let first = reserve(stages).unwrap();
    let mut second = reserve(stages / 2).unwrap();
    let scenes_bytes = (2 * scene_bytes).min(resident.total_bytes());
    assert_eq!(cache.stats().reserved_bytes, scenes_bytes + stages + 2 * images);
    let frame = second.frame();
    let scenes = SceneBytes { together: scene_bytes, by_view: None };
    second.exchange(resident.clone(), scenes, frame).unwrap();
    assert_eq!(second.frame(), frame);
    drop(first);
    assert_eq!(cache.stats().reserved_bytes, scene_bytes + stages / 2 + images);
    drop(second);

    // A small frame may be rendered while a large one is; two small or two large ones may not be
    // rendered at once.
    let frames = |is_large, beside| FrameBytes { stages, beside, is_large, images: 0 };
    let reserved = |sessions: u64, frames_bytes: u64| {
        let scenes_bytes = (sessions * scene_bytes).min(resident.total_bytes());
        assert_eq!(cache.stats().reserved_bytes, scenes_bytes + frames_bytes);
    };
    let small = [4, 8].map(|share| reserve_frame(frames(false, stages / share)).unwrap());
    reserved(2, stages);
    let large = reserve_frame(frames(true, 0)).unwrap();
    reserved(3, stages + stages / 4);
    let [quarter, eighth] = small;
    drop(quarter);
    reserved(2, stages + stages / 8);
    drop(eighth);
    let other = reserve_frame(frames(true, 0)).unwrap();
    reserved(2, stages);
    drop((large, other));
    assert_eq!(cache.stats().reserved_bytes, 0);
}

#[test]
fn an_exchanged_version_takes_the_memory_of_the_one_before() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = gaussians(20_000, 1, 600.0, 1);
    commit(dir.path(), "street", &scene);
    scene.sh[0] += 0.5;
    commit(dir.path(), "street", &scene);
    let catalog = wildcity_twin::store::Catalog::open(dir.path()).unwrap();
    let all = Cache::new(catalog.clone()).open("street", None).unwrap();
    let limit_bytes = all.worst_case_bytes(EXTENT) * 3 / 2;
    assert!(limit_bytes < all.total_bytes());
    let cache = Cache::limited(catalog, Some(limit_bytes));
    let [old, new] = [1, 2].map(|number| cache.open("street", Some(number)).unwrap());
    let mut reservation = old.reserve(EXTENT).unwrap();
    assert!(new.reserve(EXTENT).is_err(), "there is no room for both");
    let frame = FrameBytes::default();
    let scenes = |together| SceneBytes { together, by_view: None };
    reservation.exchange(new.clone(), scenes(new.worst_case_bytes(EXTENT)), frame).unwrap();
    // A refused exchange changes nothing.
    assert!(reservation.exchange(old, scenes(limit_bytes + 1), frame).is_err());
    assert!(Arc::ptr_eq(reservation.resident(), &new));
    assert_eq!(new.stats().reserved_bytes, reservation.bytes());
    drop(reservation);
    assert_eq!(cache.stats().reserved_bytes, 0);
}

/// A reservation is counted when it begins to be enough for one view at a time only, and not again
/// while it stays so.
#[test]
fn a_change_to_one_view_at_a_time_is_counted() {
    let all = unlimited().open("demo", None).unwrap();
    let together = all.worst_case_bytes(EXTENT);
    let by_view = all.worst_case_bytes(RigExtent { views: 1, ..EXTENT });
    assert!(by_view < together);
    let cache = Cache::limited(demo().catalog(), Some(together));
    let resident = cache.open("demo", None).unwrap();
    let scenes = |together| SceneBytes { together, by_view: Some(by_view) };
    let frame = FrameBytes::default();
    let mut reservation = resident.reserve_scenes(scenes(together), frame).unwrap();
    let mut exchanged = |bytes| {
        reservation.exchange(resident.clone(), scenes(bytes), frame).unwrap();
        (reservation.views_at_once() == 1, cache.stats().by_camera)
    };
    let changes = [together + 1, together + 1, together, together + 1].map(&mut exchanged);
    assert_eq!(changes, [(true, 1), (true, 1), (false, 1), (true, 2)]);
}

#[test]
fn a_twin_that_fits_as_a_whole_has_room_for_any_number_of_sessions() {
    let total_bytes = unlimited().open("demo", None).unwrap().total_bytes();
    let cache = Cache::limited(demo().catalog(), Some(total_bytes));
    let resident = cache.open("demo", None).unwrap();
    let held: Vec<_> = (0..100).map(|_| resident.reserve(EXTENT).unwrap()).collect();
    assert_eq!(cache.stats().reserved_bytes, total_bytes);
    drop(held);
}

#[test]
fn as_many_sessions_as_there_is_room_for_race_without_a_deadlock() {
    let all = unlimited().open("demo", None).unwrap();
    let limit_bytes = 3 * all.worst_case_bytes(EXTENT);
    let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
    let resident = cache.open("demo", None).unwrap();
    race(&resident, 3, true);
    let stats = cache.stats();
    assert!(stats.evictions > 0 && stats.held_bytes <= limit_bytes, "{stats:?}");
}

#[test]
fn frames_without_admission_are_drawn_one_after_the_other() {
    // Room for one worst frame, and eight threads that each draw another frame.
    let all = unlimited().open("demo", None).unwrap();
    let limit_bytes = all.worst_case_bytes(EXTENT);
    let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
    race(&cache.open("demo", None).unwrap(), 8, false);
    assert!(cache.stats().held_bytes <= limit_bytes);
}

/// The end of a frame that fills the memory wakes the load that waits for room, without polling.
#[test]
fn the_end_of_a_frame_makes_room_at_once() {
    let all = unlimited().open("demo", None).unwrap();
    let frame = |station_m: f64| eyes(&views(demo().at(station_m)));
    let bytes = |station_m: f64| -> u64 {
        let needed = all.demand(&frame(station_m), &PROFILE);
        let chunks = &all.version.manifest.chunks;
        let of =
            |n: &SectionRef| chunks[n.chunk].needed_bytes(1, &chunks[n.chunk].sections[n.section]);
        needed.iter().map(of).sum()
    };
    // Each of the two fits, but not both together.
    let limit_bytes = bytes(0.0).max(bytes(500.0)) + bytes(0.0) / 4;
    assert!(limit_bytes < bytes(0.0) + bytes(500.0));
    let cache = Cache::limited(demo().catalog(), Some(limit_bytes));
    let resident = cache.open("demo", None).unwrap();
    let waits = (0..5).map(|_| {
        let first = resident.scene(&frame(0.0), &PROFILE).unwrap();
        let (tell, told) = channel();
        let other = resident.clone();
        let eyes = frame(500.0);
        let before = cache.stats().waits;
        let waiting = std::thread::spawn(move || {
            let second = other.scene(&eyes, &PROFILE).unwrap();
            tell.send(Instant::now()).unwrap();
            drop(second);
        });
        while cache.stats().waits == before {
            std::thread::yield_now();
        }
        // Time for the loader to find that there is no room, and to sleep. (A loader that is late
        // finds room.)
        std::thread::sleep(wildcity_twin::limits::ROOM_POLL / 4);
        let dropped = Instant::now();
        drop(first);
        let waited = told.recv_timeout(TEST_TIMEOUT).unwrap() - dropped;
        waiting.join().unwrap();
        waited
    });
    let mut waits: Vec<Duration> = waits.collect();
    waits.sort();
    // Without a notice the loader would sleep for three quarters of that time. Other tests run
    // beside this one, and may delay a loader that was notified: four of the five count.
    assert!(waits[3] < wildcity_twin::limits::ROOM_POLL / 2, "{waits:?}");
}

/// Starts threads that each draw forty frames at different places.
fn race(resident: &Arc<wildcity_twin::residency::Resident>, threads: u64, admitted: bool) {
    let (tell, told) = channel();
    for thread in 0..threads {
        let resident = resident.clone();
        let tell = tell.clone();
        std::thread::spawn(move || {
            let _reservation = admitted.then(|| resident.reserve(EXTENT).unwrap());
            let mut random = Random(thread + 1);
            for _ in 0..40 {
                let pose = demo().at(600.0 * random.unit());
                let scene = resident.scene(&eyes(&views(pose)), &PROFILE).unwrap();
                let needed = resident.demand(&eyes(&views(pose)), &PROFILE);
                assert_eq!(scene.chunks.len(), needed.len());
                let stats = resident.stats();
                assert!(stats.held_bytes <= stats.limit_bytes, "{stats:?}");
                let _pixels = (random.unit() < 0.1).then(|| pixels(&scene, pose));
            }
            tell.send(thread).unwrap();
        });
    }
    drop(tell);
    let began = Instant::now();
    for _ in 0..threads {
        let left = (3 * TEST_TIMEOUT).saturating_sub(began.elapsed());
        told.recv_timeout(left).expect("a frame was never drawn");
    }
}
