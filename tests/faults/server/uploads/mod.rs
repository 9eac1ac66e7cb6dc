//! Histories of uploads: two tokens begin, send, cut off, continue and delete uploads, while the
//! process is killed, the power fails, the disk is full, reads fail, are slow, end early or have
//! wrong bits, and the clock jumps.

mod world;

use std::fmt;

use self::world::World;
use super::disk::{Fault, Plant};
use super::machine::Machine;
use super::random::Random;
use super::reads::{BadReads, ReadFault};

/// The names of the tokens.
const OWNERS: [&str; 2] = ["a", "b"];

/// Sizes of the files that are uploaded, in bytes.
const SIZES: [u64; 4] = [0, 40, 100, 160];

/// How long an upload is kept, in seconds.
const AGE_S: i64 = 86_400;

/// Writes of a request, about.
const WRITES: u64 = 8;

/// One of the files of one of the tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Name {
    owner: usize,
    file: usize,
}

#[derive(Clone, Copy, Debug)]
enum Operation {
    Begin(Name),
    /// Sends up to so many of the missing bytes, cut off after so many bytes of the request if it
    /// is cut.
    Append {
        name: Name,
        bytes: u64,
        cut: Option<u64>,
    },
    /// Sends two parts for the same offset at once, of up to so many of the missing bytes.
    AppendTwice {
        name: Name,
        bytes: [u64; 2],
    },
    /// Sends bytes for another offset than the upload's.
    WrongOffset(Name),
    Delete(Name),
    /// Deletes and continues another token's upload.
    Foreign(Name),
    /// Removes uploads that are too old.
    Expire,
    /// Changes the time of day.
    Jump {
        seconds: i64,
    },
    /// Lets time pass.
    Wait {
        seconds: i64,
    },
    /// Ends the process between two requests.
    Stop(Fault),
}

/// An operation, and the faults during it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    seed: u64,
    operation: Operation,
    fault: Option<(u64, Fault)>,
    bad_reads: Option<BadReads>,
}

/// A history of uploads.
#[derive(Clone)]
pub(super) struct Uploads {
    seed: u64,
    pub(super) steps: Vec<Step>,
}

impl super::History for Uploads {
    type Plant = Plant;

    fn from_seed(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let count = 4 + random.below(12);
        let steps = (0..count).map(|_| Step::random(&mut random)).collect();
        Self { seed, steps }
    }

    fn run(&self, machine: &Machine, plant: Option<Plant>) -> Result<(), String> {
        machine.runtime.block_on(async {
            let mut world = World::new(machine, plant)?;
            for (index, step) in self.steps.iter().enumerate() {
                let done = world.run(step).await;
                done.map_err(|reason| format!("operation {index}: {reason}"))?;
            }
            world.finish().await.map_err(|reason| format!("at the end: {reason}"))
        })
    }

    fn shorter(&self) -> Vec<Self> {
        let without_step = (0..self.steps.len()).map(|index| {
            let mut shorter = self.clone();
            shorter.steps.remove(index);
            shorter
        });
        let without_fault = (0..self.steps.len()).filter_map(|index| {
            let mut without_fault = self.clone();
            let Step { fault, bad_reads, .. } = &mut without_fault.steps[index];
            let had_fault = fault.take().is_some() || bad_reads.take().is_some();
            had_fault.then_some(without_fault)
        });
        without_step.chain(without_fault).collect()
    }
}

impl fmt::Display for Uploads {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}", self.seed)?;
        for (index, Step { operation, fault, bad_reads, .. }) in self.steps.iter().enumerate() {
            writeln!(f, "  {index} {operation:?}, fault {fault:?}, reads {bad_reads:?}")?;
        }
        Ok(())
    }
}

impl Step {
    fn random(random: &mut Random) -> Self {
        let name = Name { owner: random.below(2) as usize, file: random.below(4) as usize };
        let bytes = random.below(SIZES[name.file] + 2);
        let bytes = if random.once_in(2) { SIZES[name.file] } else { bytes };
        let operation = match random.below(26) {
            0..7 => Operation::Begin(name),
            7..15 => {
                // A request has about 200 bytes before its body.
                let cut = random.once_in(3).then(|| random.below(400));
                Operation::Append { name, bytes, cut }
            }
            15 => Operation::WrongOffset(name),
            16 | 17 => Operation::Delete(name),
            18 => Operation::Foreign(name),
            19 => Operation::Expire,
            20 => Operation::Jump { seconds: [-3_600, 3_600, AGE_S][random.below(3) as usize] },
            21 => Operation::Wait { seconds: [60, 130, 700][random.below(3) as usize] },
            22 | 23 => {
                Operation::AppendTwice { name, bytes: [bytes, random.below(SIZES[name.file] + 2)] }
            }
            _ => Operation::Stop([Fault::Kill, Fault::PowerCut][random.below(2) as usize]),
        };
        let faults = [Fault::Kill, Fault::PowerCut, Fault::PowerCut, Fault::Full];
        let fault = faults[random.below(4) as usize];
        // With two simultaneous requests, it is unknown which one meets a fault.
        let is_sure = !matches!(operation, Operation::AppendTwice { .. });
        let fault = (is_sure && random.once_in(3)).then(|| (random.below(WRITES), fault));
        let faults = [ReadFault::Error, ReadFault::Short, ReadFault::Flip, ReadFault::Slow];
        let bad = faults[random.below(4) as usize];
        let bad_reads = BadReads { after: 0, fault: bad, times: 1 };
        let bad_reads = Some(bad_reads).filter(|_| is_sure && fault.is_none() && random.once_in(4));
        Self { seed: random.next(), operation, fault, bad_reads }
    }
}

impl Operation {
    /// The upload that it changes.
    fn name(self) -> Option<Name> {
        match self {
            Self::Begin(name) | Self::Append { name, .. } | Self::AppendTwice { name, .. } => {
                Some(name)
            }
            _ => None,
        }
    }
}
