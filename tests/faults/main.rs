//! Simulated faults: thousands of histories of commits, leases, garbage collections and rollbacks on a disk that
//! fails, with a clock that jumps, in a process that is killed between any two writes. After each history nothing that
//! was acknowledged is lost, no version is mixed, nothing in use is removed, and the store goes on working.
//!
//! A history follows from its seed alone. A failure prints the seed and the shortest history that still fails; `SEED=n
//! cargo test -p wildcity-twin --test faults one_history` runs one, and `HISTORIES=n ... many_histories` any number.

mod disk;
mod history;
mod random;
mod world;

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use disk::Plant;
use history::{Failure, History};

/// Histories in the gate.
const HISTORIES: u64 = 10_000;

/// Histories within which a planted fault must be found.
const HISTORIES_TO_FIND: u64 = 1_000;

fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}, not a number")))
}

/// Runs histories of the seeds from 1 on, on all cores. Returns the first failure, shrunk.
fn run(histories: u64, plant: Option<Plant>) -> Option<Failure> {
    let next = AtomicU64::new(1);
    let failed = AtomicU64::new(u64::MAX);
    let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed > histories || failed.load(Ordering::Relaxed) < seed {
                        return;
                    }
                    if History::of(seed).run(plant).is_err() {
                        failed.fetch_min(seed, Ordering::Relaxed);
                    }
                }
            });
        }
    });
    let seed = failed.into_inner();
    (seed < u64::MAX).then(|| History::of(seed).shrunk(plant))
}

#[test]
fn many_histories() {
    let histories = number("HISTORIES").unwrap_or(HISTORIES);
    let begun = Instant::now();
    if let Some(failure) = run(histories, None) {
        panic!("{failure}");
    }
    let took = begun.elapsed();
    eprintln!("{histories} histories in {took:.1?}");
}

#[test]
fn one_history() {
    let seed = number("SEED").unwrap_or(1);
    if History::of(seed).run(None).is_err() {
        panic!("{}", History::of(seed).shrunk(None));
    }
}

/// The simulation finds what it is made for: each planted fault of the store's use of the disk.
#[test]
fn planted_faults_are_found() {
    for plant in [Plant::MissingSync, Plant::RecordBeforeObjects, Plant::LeakedLease] {
        let failure = run(HISTORIES_TO_FIND, Some(plant));
        let failure = failure.unwrap_or_else(|| panic!("{plant:?} is not found"));
        assert!(failure.history.operations.len() <= 6, "{plant:?} is not shrunk: {failure}");
    }
}
