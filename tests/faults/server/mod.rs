//! Simulated faults of the server: histories of uploads on a disk that fails, and of sessions over
//! connections that are cut. Requests go through the server's own router, and through connections
//! in memory.
//!
//! A history follows from its seed, except for the order in which threads run. A failure prints the
//! seed and the shortest history that still fails;
//! `SEED=n cargo test -p wildcity-server --lib one_history` runs one of each kind, and
//! `HISTORIES=n ... many_histories` any number, from the seed `FIRST_SEED` on.
//!
//! Not simulated: TLS, the kernel's sockets, and a client that does not read until the time-out for
//! it.

mod connections;
#[allow(dead_code, reason = "the simulation of the store uses another part of it")]
#[path = "../disk.rs"]
mod disk;
mod machine;
mod network;
#[path = "../random.rs"]
mod random;
#[allow(dead_code, reason = "the simulation of the store uses another part of it")]
#[path = "../reads.rs"]
mod reads;
#[path = "../../support/server.rs"]
mod support;
mod uploads;

use std::fmt::{Debug, Display};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use parking_lot::Mutex;

use disk::Plant;
use machine::Machine;

/// Histories of uploads in CI.
const UPLOAD_HISTORIES: u64 = 3_500;

/// Histories of connections in CI.
const CONNECTION_HISTORIES: u64 = 1_000;

/// Histories after which the progress is printed.
const HISTORIES_TO_TELL: u64 = 10_000;

/// Histories within which a planted fault must be found.
const HISTORIES_TO_FIND: u64 = 1_000;

/// The events of one simulation.
trait History: Clone + Display {
    /// A deliberate mistake in the program.
    type Plant: Copy + Debug + Sync;

    /// The history of a seed.
    fn from_seed(seed: u64) -> Self;

    /// Runs it.
    ///
    /// # Errors
    /// Says which promise is broken.
    fn run(&self, machine: &Machine, plant: Option<Self::Plant>) -> Result<(), String>;

    /// Histories with one operation or fault less.
    fn shorter(&self) -> Vec<Self>;
}

fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}, not a number")))
}

fn reason<H: History>(machine: &Machine, history: &H, plant: Option<H::Plant>) -> Option<String> {
    let run = catch_unwind(AssertUnwindSafe(|| history.run(machine, plant)));
    run.unwrap_or_else(|_| Err("it panicked".to_owned())).err()
}

/// A history that breaks a promise.
struct Failure<H> {
    history: H,
    said: String,
}

/// Runs histories of the seeds from `first` on, on all cores. Returns the first failure, shrunk.
fn run<H: History>(first: u64, histories: u64, plant: Option<H::Plant>) -> Option<Failure<H>> {
    let next = AtomicU64::new(first);
    let failed: Mutex<Option<(u64, String)>> = Mutex::new(None);
    let failed_before =
        |seed| failed.lock().as_ref().is_some_and(|(failed, _): &(u64, String)| *failed < seed);
    let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                let machine = Machine::new();
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= first + histories || failed_before(seed) {
                        return;
                    }
                    if let Some(said) = reason(&machine, &H::from_seed(seed), plant)
                        && !failed_before(seed)
                    {
                        *failed.lock() = Some((seed, said));
                    }
                    if seed.is_multiple_of(HISTORIES_TO_TELL) {
                        eprintln!("seed {seed} of {}", std::any::type_name::<H>());
                    }
                }
            });
        }
    });
    failed.into_inner().map(|(seed, said)| shrunk(H::from_seed(seed), said, plant))
}

/// Shortens a failing history by leaving out parts while it still fails. A history that fails only
/// if threads run in a certain order is not shortened.
fn shrunk<H: History>(mut history: H, mut said: String, plant: Option<H::Plant>) -> Failure<H> {
    let machine = Machine::new();
    loop {
        let mut candidates = history.shorter().into_iter();
        let smaller = candidates.find_map(|shorter| {
            let said = reason(&machine, &shorter, plant)?;
            Some((said, shorter))
        });
        let Some((why, shorter)) = smaller else { return Failure { history, said } };
        said = why;
        history = shorter;
    }
}

fn run_or_panic<H: History>(what: &str, histories: u64) {
    let begun = Instant::now();
    let histories = number("HISTORIES").unwrap_or(histories);
    let first = number("FIRST_SEED").unwrap_or(1);
    if let Some(Failure { history, said }) = run::<H>(first, histories, None) {
        panic!("{said}\n{history}");
    }
    let took = begun.elapsed();
    eprintln!("{histories} histories of {what} in {took:.1?}");
}

#[test]
fn many_histories_of_uploads() {
    run_or_panic::<uploads::Uploads>("uploads", UPLOAD_HISTORIES);
}

#[test]
fn many_histories_of_connections() {
    run_or_panic::<connections::Connections>("connections", CONNECTION_HISTORIES);
}

#[test]
fn one_history() {
    let seed = number("SEED").unwrap_or(1);
    let machine = Machine::new();
    run_one::<uploads::Uploads>(&machine, seed);
    run_one::<connections::Connections>(&machine, seed);
}

fn run_one<H: History>(machine: &Machine, seed: u64) {
    if let Some(said) = reason(machine, &H::from_seed(seed), None) {
        let Failure { history, said } = shrunk(H::from_seed(seed), said, None);
        panic!("{said}\n{history}");
    }
}

/// The simulation detects the mistakes that it is made for.
#[test]
fn planted_faults_are_found() {
    for plant in [Plant::UnsyncedFiles, Plant::AnnouncedCounted] {
        let failure = run::<uploads::Uploads>(1, HISTORIES_TO_FIND, Some(plant));
        let Failure { history, said } = failure.unwrap_or_else(|| panic!("{plant:?} is not found"));
        assert!(history.steps.len() <= 6, "{plant:?} is not shrunk: {said}\n{history}");
    }
    use connections::Plant::{DeadlineIgnored, PermitLeaked, ReservationForgotten, StepsTwice};
    for plant in [StepsTwice, PermitLeaked, ReservationForgotten, DeadlineIgnored] {
        let failure = run::<connections::Connections>(1, HISTORIES_TO_FIND, Some(plant));
        let Failure { history, said } = failure.unwrap_or_else(|| panic!("{plant:?} is not found"));
        eprintln!("{plant:?}: {said}\n{history}");
        assert!(history.parts() <= 4, "{plant:?} is not shrunk: {said}\n{history}");
    }
}
