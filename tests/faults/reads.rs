//! Reads that fail, that are slow, or that return the wrong bytes.

/// Fault of a read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReadFault {
    /// It fails.
    Error,
    /// It ends early.
    Short,
    /// Some bits are wrong. Only in files that have a digest.
    Flip,
    /// It takes a minute.
    Slow,
}

/// Content that a read returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Carries {
    /// Names and sizes.
    Names,
    /// The content of a file without a digest: log records, leases, the state of garbage
    /// collection, announcements of uploads.
    Content,
    /// The content of a file with a digest.
    Digested,
}

/// Successive reads that fail.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BadReads {
    /// Reads before the first of them.
    pub(crate) after: u64,
    pub(crate) fault: ReadFault,
    /// Number of successive failures.
    pub(crate) times: u64,
}

/// The reads of a disk or bucket.
#[derive(Debug, Default)]
pub(crate) struct Reads {
    /// The next failures.
    pub(crate) planned: Option<BadReads>,
    /// Number of reads that failed or were damaged.
    failed: u64,
}

impl Reads {
    /// Returns the fault of the next read. A slow read only waits for some microseconds.
    pub(crate) fn next(&mut self, carries: Carries, wait: impl FnOnce(i64)) -> Option<ReadFault> {
        match self.next_planned(carries)? {
            ReadFault::Slow => {
                wait(ReadFault::SLOW_US);
                None
            }
            fault => {
                self.failed += 1;
                Some(fault)
            }
        }
    }

    /// Number of reads that failed or were damaged since this was last called.
    pub(crate) fn take_failed(&mut self) -> u64 {
        std::mem::take(&mut self.failed)
    }

    fn next_planned(&mut self, carries: Carries) -> Option<ReadFault> {
        let reads = self.planned.as_mut()?;
        if reads.after > 0 {
            reads.after -= 1;
            return None;
        }
        let fault = reads.fault;
        let is_possible = match fault {
            ReadFault::Error | ReadFault::Slow => true,
            ReadFault::Short => carries != Carries::Names,
            ReadFault::Flip => carries == Carries::Digested,
        };
        if !is_possible {
            return None;
        }
        reads.times -= 1;
        if reads.times == 0 {
            self.planned = None;
        }
        Some(fault)
    }
}

impl ReadFault {
    /// How long a slow read takes.
    pub(crate) const SLOW_US: i64 = 60_000_000;

    /// Damaged bytes for a read.
    pub(crate) fn damaged(self, mut bytes: Vec<u8>) -> Vec<u8> {
        match self {
            Self::Error | Self::Slow => {}
            Self::Short => bytes.truncate(bytes.len() / 2),
            // Often enough that each section has a wrong bit.
            Self::Flip => bytes.iter_mut().step_by(16).for_each(|byte| *byte ^= 0x41),
        }
        bytes
    }
}
