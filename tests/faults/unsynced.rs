//! Unsynced writes of a process that was stopped or failed to sync: all later processes see them,
//! and a power cut may undo them. Each history has such a fault at each of the writes of one
//! operation, continues, and ends with a power cut.

use crate::disk::Fault;
use crate::history::{History, Operation, Step};
use crate::medium::Kind;
use crate::world::World;

/// More than the number of writes of any operation.
const WRITES: u64 = 64;

/// More writes than a rollback makes.
const ROLLBACK_WRITES: u64 = 24;

/// Power cuts of each history, because the surviving writes are random.
const CUTS: u64 = 4;

const PUSH: Operation = Operation::Push { cells: 1, content: 1 };
const OTHER_PUSH: Operation = Operation::Push { cells: 3, content: 2 };
const PREPARE: Operation = Operation::Prepare { cells: 4, content: 3 };
const ROLLBACK: Operation = Operation::Rollback { back: 1 };
const COLLECT: Operation = Operation::Collect { keep: 1, grace_s: 0 };

fn step(seed: u64, operation: Operation, fault: Option<(u64, Fault)>) -> Step {
    Step { seed, operation, process: 0, fault, bad_reads: None }
}

/// Runs operations, one of which has a fault after a number of writes, and cuts the power.
fn run(before: &[Operation], faulty: (Operation, u64, Fault), after: &[Step], seed: u64) {
    let mut operations: Vec<Step> = before.iter().map(|&one| step(seed, one, None)).collect();
    let (operation, writes, fault) = faulty;
    operations.push(step(seed, operation, Some((writes, fault))));
    operations.extend_from_slice(after);
    operations.push(step(seed, Operation::Stop(Fault::PowerCut), None));
    let history = History { seed, operations };
    if let Err(reason) = history.run(Kind::Disk, None) {
        panic!("{reason}: {history:?}");
    }
}

/// Checks that an operation makes fewer than [`WRITES`] writes: a fault after this number does not
/// happen.
fn check_writes(before: &[Operation], operation: Operation, writes: u64) {
    let mut world = World::new(Kind::Disk, None).unwrap();
    before.iter().for_each(|&one| world.run(&step(1, one, None)).unwrap());
    world.run(&step(1, operation, Some((writes, Fault::Kill)))).unwrap();
    assert_eq!(world.restarts(), 0, "{operation:?} makes more than {writes} writes: try more");
}

/// Lets each fault happen at each write of `faulty`.
fn check(before: &[Operation], faulty: Operation, after: &[Operation]) {
    check_writes(before, faulty, WRITES);
    for fault in [Fault::Full, Fault::Kill, Fault::PowerCut] {
        for writes in 0..WRITES {
            for seed in 1..=CUTS {
                let after: Vec<Step> = after.iter().map(|&one| step(seed, one, None)).collect();
                run(before, (faulty, writes, fault), &after, seed);
            }
        }
    }
}

#[test]
fn a_version_that_is_lost_takes_no_other_with_it() {
    check(&[PUSH], OTHER_PUSH, &[COLLECT, COLLECT]);
    check(&[PUSH, OTHER_PUSH], ROLLBACK, &[COLLECT, COLLECT]);
}

#[test]
fn no_version_relies_on_a_folder_that_is_lost() {
    check(&[], PUSH, &[OTHER_PUSH]);
}

#[test]
fn a_collected_version_stays_collected() {
    check(&[PUSH, OTHER_PUSH], COLLECT, &[COLLECT, COLLECT]);
    check(&[PUSH, OTHER_PUSH, COLLECT], COLLECT, &[COLLECT]);
    // Files of a killed commit are removed at the next start, together with all files that no
    // version names.
    check(&[PUSH, OTHER_PUSH, COLLECT, PREPARE], COLLECT, &[]);
}

/// The number after a version that is not durable is taken only once it is.
#[test]
fn the_log_has_no_gap() {
    // A rollback has few writes, so that all pairs of them can be tried.
    check_writes(&[PUSH, OTHER_PUSH], ROLLBACK, ROLLBACK_WRITES);
    for writes in 0..ROLLBACK_WRITES {
        for cut in 0..ROLLBACK_WRITES {
            for seed in 1..=3 * CUTS {
                let after = [step(seed, ROLLBACK, Some((cut, Fault::PowerCut)))];
                run(&[PUSH, OTHER_PUSH], (ROLLBACK, writes, Fault::Full), &after, seed);
            }
        }
    }
}
