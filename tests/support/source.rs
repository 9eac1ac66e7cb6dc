//! A source of sections with configurable faults: sections that fail, are late or are damaged.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::collections::BTreeMap;
use std::io;
use std::sync::{Condvar, Mutex};
use std::time::Instant;

use wildcity_scene::Chunk;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_twin::residency::SectionSource;
use wildcity_twin::store::{Catalog, StoreError, Version};

use crate::streaming::TEST_TIMEOUT;

/// A section by cell, block and level.
pub(crate) type Place = ([i32; 2], u8, u8);

/// The fault of a section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Fault {
    /// It cannot be read.
    Unreadable,
    /// Its bytes differ from the committed ones.
    Damaged,
    /// Reading it panics.
    Crash,
    /// Reading it blocks until the fault is removed.
    Hangs,
}

/// A catalog with faults, which counts the reads of each section.
pub(crate) struct Faulty {
    catalog: Catalog,
    state: Mutex<State>,
    lifted: Condvar,
}

#[derive(Default)]
struct State {
    faults: BTreeMap<Place, Fault>,
    reads: BTreeMap<Place, u32>,
}

impl Faulty {
    pub(crate) fn new(catalog: Catalog) -> Self {
        Self { catalog, state: Mutex::default(), lifted: Condvar::new() }
    }

    pub(crate) fn break_section(&self, place: Place, fault: Fault) {
        self.state.lock().unwrap().faults.insert(place, fault);
    }

    pub(crate) fn heal(&self) {
        self.state.lock().unwrap().faults.clear();
        self.lifted.notify_all();
    }

    /// How often a section was read.
    pub(crate) fn reads(&self, place: Place) -> u32 {
        self.state.lock().unwrap().reads.get(&place).copied().unwrap_or(0)
    }

    /// Number of reads of all sections.
    pub(crate) fn all_reads(&self) -> u64 {
        self.state.lock().unwrap().reads.values().map(|&reads| u64::from(reads)).sum()
    }

    /// Number of reads of the section that was read most often.
    pub(crate) fn most_reads(&self) -> u32 {
        self.state.lock().unwrap().reads.values().copied().max().unwrap_or(0)
    }

    /// Waits until a section was asked for.
    pub(crate) fn await_read(&self, place: Place) {
        let began = Instant::now();
        while self.reads(place) == 0 {
            assert!(began.elapsed() < TEST_TIMEOUT, "{place:?} was never read");
            std::thread::yield_now();
        }
    }
}

impl SectionSource for Faulty {
    fn section(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
    ) -> Result<Chunk, StoreError> {
        let place = (chunk.cell, section.block, section.level);
        let mut state = self.state.lock().unwrap();
        *state.reads.entry(place).or_default() += 1;
        while state.faults.get(&place) == Some(&Fault::Hangs) {
            state = self.lifted.wait(state).unwrap();
        }
        let fault = state.faults.get(&place).copied();
        drop(state);
        let path = self.catalog.dir().to_owned();
        match fault {
            None | Some(Fault::Hangs) => self.catalog.section(version, chunk, section),
            Some(Fault::Crash) => panic!("this crash was asked for"),
            Some(Fault::Damaged) => {
                Err(StoreError::Damaged { path, reason: "a bit was flipped".into() })
            }
            Some(Fault::Unreadable) => {
                let cause = io::Error::other("the disk is away");
                Err(StoreError::Io { action: "read", path, cause })
            }
        }
    }
}
