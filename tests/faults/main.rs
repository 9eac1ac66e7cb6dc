//! Simulated faults: thousands of histories of commits, leases, garbage collections, rollbacks and
//! reads on a disk that fails, and in an object store that refuses requests and loses answers, with
//! a clock that jumps, in a process that is killed between any two writes. After each history no
//! acknowledged version is lost, no version is mixed, no data in use is removed, and the store
//! still works.
//!
//! Reads fail as well: with an error, an early end, wrong bits, or a delay of a minute. A failed
//! read causes an error of the operation that needed it, and never different content; after it, the
//! same read succeeds. Wrong bits are simulated only in objects: log records, leases and the state
//! of garbage collection have no digest.
//!
//! Two processes serve the twin in turns: one prepares a commit, opens versions or collects garbage
//! between two operations of the other. A kill ends both.
//!
//! Not simulated: two processes within one operation each, requests to the object store that are carried
//! out in another order than they began, the disk cache of remote twins, and wrong bits that stay.
//!
//! Uploads and connections are simulated in the package of the server, over the same disk:
//! `tests/faults/server`.
//!
//! A history follows only from its seed. A failure prints the seed and the shortest history that
//! still fails; `SEED=n cargo test -p wildcity-twin --test faults one_history` runs one on both,
//! and `HISTORIES=n ... many_histories` any number, from the seed `FIRST_SEED` on.

mod assets;
mod bucket;
#[allow(dead_code, reason = "the simulation of uploads uses another part of it")]
mod disk;
mod history;
mod medium;
mod random;
mod reads;
mod unsynced;
mod world;

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use disk::Plant;
use history::{Failure, History};
use medium::Kind;

/// Histories in CI, on a disk. With those of uploads and connections there are 10,000.
const HISTORIES: u64 = 4_000;

/// Histories in CI, in an object store, whose requests run on a separate thread.
const BUCKET_HISTORIES: u64 = 1_500;

/// Histories after which the progress is printed.
const HISTORIES_TO_TELL: u64 = 10_000;

/// Histories within which a planted fault must be found.
const HISTORIES_TO_FIND: u64 = 1_000;

fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}, not a number")))
}

/// Runs histories of the seeds from `first` on, on all cores. Returns the first failure, shrunk.
fn run(kind: Kind, first: u64, histories: u64, plant: Option<Plant>) -> Option<Failure> {
    let next = AtomicU64::new(first);
    let failed = AtomicU64::new(u64::MAX);
    let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= first + histories || failed.load(Ordering::Relaxed) < seed {
                        return;
                    }
                    if History::from_seed(seed).run(kind, plant).is_err() {
                        failed.fetch_min(seed, Ordering::Relaxed);
                    }
                    if seed.is_multiple_of(HISTORIES_TO_TELL) {
                        eprintln!("seed {seed} on a {kind:?}");
                    }
                }
            });
        }
    });
    let seed = failed.into_inner();
    (seed < u64::MAX).then(|| History::from_seed(seed).shrunk(kind, plant))
}

fn run_or_panic(kind: Kind, histories: u64) {
    let begun = Instant::now();
    let histories = number("HISTORIES").unwrap_or(histories);
    if let Some(failure) = run(kind, number("FIRST_SEED").unwrap_or(1), histories, None) {
        panic!("{failure}");
    }
    let took = begun.elapsed();
    eprintln!("{histories} histories on a {kind:?} in {took:.1?}");
}

#[test]
fn many_histories() {
    run_or_panic(Kind::Disk, HISTORIES);
}

#[test]
fn many_histories_in_an_object_store() {
    run_or_panic(Kind::Bucket, BUCKET_HISTORIES);
}

#[test]
fn one_history() {
    let seed = number("SEED").unwrap_or(1);
    for kind in [Kind::Disk, Kind::Bucket] {
        if History::from_seed(seed).run(kind, None).is_err() {
            panic!("{kind:?}, {}", History::from_seed(seed).shrunk(kind, None));
        }
    }
}

/// The simulation detects the mutations that it is made for: each planted fault of the store's use
/// of the disk, or of an object store.
#[test]
fn planted_faults_are_found() {
    let plants = [
        (Kind::Disk, Plant::MissingSync),
        (Kind::Disk, Plant::RecordBeforeObjects),
        (Kind::Disk, Plant::LeakedLease),
        (Kind::Disk, Plant::UnsyncedFiles),
        (Kind::Disk, Plant::FailedReadIsAbsent),
        (Kind::Bucket, Plant::FailedReadIsAbsent),
        (Kind::Bucket, Plant::RecordBeforeObjects),
        (Kind::Bucket, Plant::LeakedLease),
        (Kind::Bucket, Plant::RecordReplaced),
    ];
    for (kind, plant) in plants {
        let failure = run(kind, 1, HISTORIES_TO_FIND, Some(plant));
        let failure = failure.unwrap_or_else(|| panic!("{plant:?} on a {kind:?} is not found"));
        let operations = failure.history.operations.len();
        assert!(operations <= 6, "{plant:?} on a {kind:?} is not shrunk: {failure}");
    }
}
