//! Histories: a sequence of operations, and the faults during them.

use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::disk::{Fault, Plant};
use crate::medium::Kind;
use crate::random::Random;
use crate::reads::{BadReads, ReadFault};
use crate::world::World;

/// One thing that is done.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Operation {
    /// Pushes some of the cells (a bit each), of a content.
    Push { cells: u8, content: u64 },
    /// Begins a push of some cells, which is published later.
    Prepare { cells: u8, content: u64 },
    /// Publishes the prepared commit.
    PublishPrepared,
    /// Rolls back by `back` versions.
    Rollback { back: u64 },
    /// Opens the version that is `back` versions before the latest in a session.
    Open { back: u64 },
    /// Reads all of the version that is `back` versions before the latest.
    Read { back: u64 },
    /// Renews the leases of all sessions.
    Renew,
    /// Closes the oldest session.
    Close,
    /// Collects garbage.
    Collect { keep: usize, grace_s: u64 },
    /// Lets the clock jump.
    Jump { seconds: i64 },
    /// Kills the process, or cuts the power, between two operations.
    Stop(Fault),
}

/// An operation, and a fault at one of its writes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step {
    /// Seeds the chances of this step, so that they do not depend on earlier steps.
    pub(crate) seed: u64,
    pub(crate) operation: Operation,
    /// Which of the two processes carries it out.
    pub(crate) process: u8,
    /// The writes before the fault, and the fault.
    pub(crate) fault: Option<(u64, Fault)>,
    /// Reads that fail, in a step without another fault.
    pub(crate) bad_reads: Option<BadReads>,
}

/// The events of one simulation.
#[derive(Clone, Debug)]
pub(crate) struct History {
    pub(crate) seed: u64,
    pub(crate) operations: Vec<Step>,
}

/// A history that breaks a promise.
#[derive(Clone, Debug)]
pub(crate) struct Failure {
    pub(crate) history: History,
    /// Which promise.
    pub(crate) reason: String,
}

/// Writes of a push of three cells, about: a fault after more does not happen.
const WRITES: u64 = 60;

/// Reads of a push, about.
const READS: u64 = 40;

/// Approximate number of reads of a version: the latest is looked up, then the version, and then
/// its sections are read.
const SECTION_READS: u64 = 16;

/// Reads of a garbage collection that removes objects, about: it looks at each object twice.
const COLLECTION_READS: u64 = 120;

impl History {
    /// The history of a seed.
    pub(crate) fn from_seed(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let count = 3 + random.below(8);
        // Garbage is removed only by the second collection, so that some histories have many.
        let collects = random.once_in(4);
        let operations = (0..count).map(|_| Step::random(&mut random, collects)).collect();
        Self { seed, operations }
    }

    /// Runs it.
    ///
    /// # Errors
    /// Says which promise is broken.
    pub(crate) fn run(&self, kind: Kind, plant: Option<Plant>) -> Result<(), String> {
        let run = AssertUnwindSafe(|| self.run_steps(kind, plant));
        catch_unwind(run).unwrap_or_else(|_| Err("the store panicked".to_owned()))
    }

    fn run_steps(&self, kind: Kind, plant: Option<Plant>) -> Result<(), String> {
        let mut world = World::new(kind, plant)?;
        for (index, step) in self.operations.iter().enumerate() {
            world.run(step).map_err(|reason| format!("operation {index}: {reason}"))?;
        }
        world.finish().map_err(|reason| format!("at the end: {reason}"))
    }

    /// Shortens a failing history by leaving out operations and faults while it still fails.
    pub(crate) fn shrunk(self, kind: Kind, plant: Option<Plant>) -> Failure {
        let fails = |history: &Self| history.run(kind, plant).err();
        let mut reason = fails(&self).expect("it fails");
        let mut history = self;
        loop {
            let without = (0..history.operations.len()).map(|index| {
                let mut shorter = history.clone();
                shorter.operations.remove(index);
                shorter
            });
            let without_fault = (0..history.operations.len()).filter_map(|index| {
                let mut without_fault = history.clone();
                let Step { fault, bad_reads, .. } = &mut without_fault.operations[index];
                let had_fault = fault.take().is_some() || bad_reads.take().is_some();
                had_fault.then_some(without_fault)
            });
            let candidates: Vec<Self> = without.chain(without_fault).collect();
            let found =
                candidates.into_iter().find_map(|shorter| Some((fails(&shorter)?, shorter)));
            let Some(smaller) = found else { return Failure { history, reason } };
            (reason, history) = smaller;
        }
    }
}

impl Step {
    fn random(random: &mut Random, collects: bool) -> Self {
        let cells = 1 + random.below(7) as u8;
        let content = 1 + random.below(6);
        let kinds = if collects { 32 } else { 22 };
        let operation = match random.below(kinds) {
            20 | 21 => Operation::Read { back: random.below(3) },
            0..8 => Operation::Push { cells, content },
            8 => Operation::Prepare { cells, content },
            9 | 10 => Operation::PublishPrepared,
            11 => Operation::Rollback { back: random.below(4) },
            12 | 13 => Operation::Open { back: random.below(3) },
            14 => Operation::Close,
            15 => Operation::Renew,
            16 | 17 | 22.. => Operation::Collect {
                keep: 1 + random.below(2) as usize,
                grace_s: [0, 3_600][random.below(2) as usize],
            },
            18 => Operation::Jump { seconds: [-3_600, 3_600, 86_400][random.below(3) as usize] },
            _ => Operation::Stop([Fault::Kill, Fault::PowerCut][random.below(2) as usize]),
        };
        let faults = [Fault::Kill, Fault::PowerCut, Fault::PowerCut, Fault::Full];
        let fault = faults[random.below(4) as usize];
        let fault = random.once_in(3).then(|| (random.below(WRITES), fault));
        let reads = match operation {
            Operation::Read { .. } => SECTION_READS,
            Operation::Collect { .. } => COLLECTION_READS,
            _ => READS,
        };
        let bad_reads = BadReads::random(random, reads);
        let one_in = if collects { 2 } else { 3 };
        let bad_reads = Some(bad_reads).filter(|_| fault.is_none() && random.once_in(one_in));
        let process = u8::from(random.once_in(3));
        Self { seed: random.next(), operation, process, fault, bad_reads }
    }
}

impl BadReads {
    fn random(random: &mut Random, reads: u64) -> Self {
        let faults = [ReadFault::Error, ReadFault::Short, ReadFault::Flip, ReadFault::Slow];
        Self {
            after: random.below(reads),
            fault: faults[random.below(4) as usize],
            times: 1 + random.below(3),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}: {}", self.history.seed, self.reason)?;
        for (index, step) in self.history.operations.iter().enumerate() {
            write!(f, "  {index} process {} {:?}", step.process, step.operation)?;
            if let Some((writes, fault)) = step.fault {
                write!(f, ", {fault:?} after {writes} writes")?;
            }
            if let Some(BadReads { after, fault, times }) = step.bad_reads {
                write!(f, ", {times} reads after {after} are {fault:?}")?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}
