//! A section that cannot be read stops only the frames that need it, and only for as long as it
//! cannot be read.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use wildcity_twin::residency::{
    Cache, PinnedScene, ResidencyError, Resident, SceneRequest, SectionRef, Stats,
};

use crate::source::{Fault, Faulty, Place};
use crate::streaming::{PROFILE, TEST_TIMEOUT, demo, eyes, pixels, unlimited, views};

/// A cache whose source can be broken, and a section that a frame at 300 m needs and one at 0 m
/// does not.
struct Broken {
    source: Arc<Faulty>,
    cache: Cache,
    resident: Arc<Resident>,
    place: Place,
}

fn broken(fault: Fault) -> Broken {
    let source = Arc::new(Faulty::new(demo().catalog()));
    let cache = Cache::with_source(demo().catalog(), source.clone(), None);
    let resident = cache.open("demo", None).unwrap();
    let at = |station_m| resident.demand(&eyes(&views(demo().at(station_m))), &PROFILE);
    let near = at(0.0);
    let far = at(300.0);
    let only_far: Vec<_> = far.into_iter().filter(|n| !near.contains(n)).collect();
    let SectionRef { chunk, section } = only_far[only_far.len() / 2];
    let chunk = &resident.version.manifest.chunks[chunk];
    let section = &chunk.sections[section];
    let place = (chunk.cell, section.block, section.level);
    source.break_section(place, fault);
    Broken { source, cache, resident, place }
}

impl Broken {
    fn frame(&self, station_m: f64) -> Result<PinnedScene, ResidencyError> {
        self.resident.scene(&eyes(&views(demo().at(station_m))), &PROFILE)
    }

    fn ask(&self, station_m: f64) -> (SceneRequest, Receiver<Result<PinnedScene, ResidencyError>>) {
        let (tell, told) = channel();
        let eyes = eyes(&views(demo().at(station_m)));
        let done = Box::new(move |pinned| {
            let _ = tell.send(pinned);
        });
        (self.resident.request(&eyes, &PROFILE, done).unwrap(), told)
    }

    fn assert_draws(&self, station_m: f64) {
        let all = unlimited().open("demo", None).unwrap();
        let pose = demo().at(station_m);
        let truth = all.scene(&eyes(&views(pose)), &PROFILE).unwrap();
        assert_eq!(pixels(&self.frame(station_m).unwrap(), pose), pixels(&truth, pose));
    }
}

#[test]
fn a_bad_section_is_retried_counted_and_named_in_the_error() {
    let failures = [
        (Fault::Unreadable, "the disk is away"),
        (Fault::Damaged, "a bit was flipped"),
        (Fault::Crash, "crashed"),
    ];
    for (fault, cause) in failures {
        let count = |stats: &Stats| match fault {
            Fault::Unreadable => stats.failed_unreadable,
            Fault::Damaged => stats.failed_damaged,
            Fault::Crash | Fault::Hangs => stats.failed_crashed,
        };
        let broken = broken(fault);
        broken.assert_draws(0.0);
        let error = broken.frame(300.0).unwrap_err();
        let (cell, block, level) = broken.place;
        match &error {
            ResidencyError::Load { twin, cell: c, block: b, level: l, attempts, cause: said } => {
                assert_eq!((twin.as_str(), *c, *b, *l), ("demo", cell, block, level));
                assert_eq!(*attempts, wildcity_twin::limits::LOAD_ATTEMPTS);
                assert!(said.contains(cause), "{said}");
            }
            other => panic!("{other}"),
        }
        let attempts = u64::from(wildcity_twin::limits::LOAD_ATTEMPTS);
        let stats = broken.cache.stats();
        assert_eq!((count(&stats), stats.retries), (attempts, attempts - 1), "{stats:?}");
        // Other frames are drawn, and every frame that needs the section tries it again.
        broken.assert_draws(0.0);
        assert!(broken.frame(300.0).is_err());
        assert_eq!(broken.source.reads(broken.place), 2 * wildcity_twin::limits::LOAD_ATTEMPTS);
        broken.source.heal();
        broken.assert_draws(300.0);
        let stats = broken.cache.stats();
        assert_eq!(count(&stats), 2 * attempts);
        assert!(stats.held_bytes <= stats.limit_bytes);
    }
}

#[test]
fn a_section_that_fails_once_only_delays_the_frame() {
    let broken = broken(Fault::Unreadable);
    let (_ticket, told) = broken.ask(300.0);
    broken.source.await_read(broken.place);
    broken.source.heal();
    assert!(told.recv_timeout(TEST_TIMEOUT).unwrap().is_ok());
    assert!(broken.cache.stats().retries >= 1);
}

#[test]
fn a_section_that_hangs_delays_only_frames_that_need_it() {
    let broken = broken(Fault::Hangs);
    let (request, told) = broken.ask(300.0);
    broken.source.await_read(broken.place);
    broken.assert_draws(0.0);
    assert!(told.recv_timeout(Duration::from_millis(50)).is_err(), "the section is not loaded");
    match request.timeout_error() {
        ResidencyError::TimedOut { twin, missing, needed, waited } => {
            assert_eq!(twin, "demo");
            assert!((1..needed).contains(&missing), "{missing} of {needed}");
            assert!(waited >= Duration::from_millis(50), "{waited:?}");
        }
        other => panic!("{other}"),
    }
    drop(request);
    assert_eq!(broken.cache.stats().waits_given_up, 1);
    // The load continues: the next frame does not start it again.
    let (_ticket, told) = broken.ask(300.0);
    broken.source.heal();
    assert!(told.recv_timeout(TEST_TIMEOUT).unwrap().is_ok());
    assert_eq!(broken.source.reads(broken.place), 1);
    broken.assert_draws(300.0);
}
