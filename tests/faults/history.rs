//! Histories: what is done, in what order, and what fails meanwhile.

use std::fmt;

use crate::disk::{Fault, Plant};
use crate::medium::Kind;
use crate::random::Random;
use crate::world::World;

/// One thing that is done.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Operation {
    /// Pushes some of the cells (a bit each), of a content.
    Push { cells: u8, content: u64 },
    /// Begins a push of some cells, which is published later.
    Prepare { cells: u8, content: u64 },
    /// Publishes what was prepared.
    PublishPrepared,
    /// Makes the version so many before the latest the latest.
    Rollback { back: u64 },
    /// Opens the version so many before the latest in a session.
    Open { back: u64 },
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
    /// Seeds the chances of this step, so that they do not depend on the steps before it.
    pub(crate) seed: u64,
    pub(crate) operation: Operation,
    /// The writes before the fault, and the fault.
    pub(crate) fault: Option<(u64, Fault)>,
}

/// What happens in one simulation.
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

impl History {
    /// The history of a seed.
    pub(crate) fn of(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let count = 3 + random.below(8);
        let operations = (0..count).map(|_| Step::random(&mut random)).collect();
        Self { seed, operations }
    }

    /// Runs it.
    ///
    /// # Errors
    /// Says which promise is broken.
    pub(crate) fn run(&self, kind: Kind, plant: Option<Plant>) -> Result<(), String> {
        let mut world = World::new(kind, plant)?;
        for (index, step) in self.operations.iter().enumerate() {
            world.run(step).map_err(|reason| format!("operation {index}: {reason}"))?;
        }
        world.finish().map_err(|reason| format!("at the end: {reason}"))
    }

    /// The shortest failing history that leaving out operations and faults of this one leads to.
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
            let calmer = (0..history.operations.len()).filter_map(|index| {
                let mut calmer = history.clone();
                calmer.operations[index].fault.take().map(|_| calmer)
            });
            let candidates: Vec<Self> = without.chain(calmer).collect();
            let found =
                candidates.into_iter().find_map(|shorter| Some((fails(&shorter)?, shorter)));
            let Some(smaller) = found else { return Failure { history, reason } };
            (reason, history) = smaller;
        }
    }
}

impl Step {
    fn random(random: &mut Random) -> Self {
        let cells = 1 + random.below(7) as u8;
        let content = 1 + random.below(6);
        let operation = match random.below(20) {
            0..8 => Operation::Push { cells, content },
            8 => Operation::Prepare { cells, content },
            9 | 10 => Operation::PublishPrepared,
            11 => Operation::Rollback { back: random.below(4) },
            12 | 13 => Operation::Open { back: random.below(3) },
            14 => Operation::Close,
            15 => Operation::Renew,
            16 | 17 => Operation::Collect {
                keep: 1 + random.below(2) as usize,
                grace_s: [0, 3_600][random.below(2) as usize],
            },
            18 => Operation::Jump { seconds: [-3_600, 3_600, 86_400][random.below(3) as usize] },
            _ => Operation::Stop([Fault::Kill, Fault::PowerCut][random.below(2) as usize]),
        };
        let faults = [Fault::Kill, Fault::PowerCut, Fault::PowerCut, Fault::Full];
        let fault = faults[random.below(4) as usize];
        let fault = random.once_in(3).then(|| (random.below(WRITES), fault));
        Self { seed: random.next(), operation, fault }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}: {}", self.history.seed, self.reason)?;
        for (index, Step { operation, fault, .. }) in self.history.operations.iter().enumerate() {
            write!(f, "  {index} {operation:?}")?;
            match fault {
                Some((writes, fault)) => writeln!(f, ", {fault:?} after {writes} writes")?,
                None => writeln!(f)?,
            }
        }
        Ok(())
    }
}
