//! Which sections are in memory: plain bookkeeping, without threads and without a clock.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use wildcity_scene::Chunk;

/// What the content of a section depends on, hashed: versions that share a section share its memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Key(pub(super) [u8; 16]);

/// Name of a section in the table, for as long as a version that has it is open.
pub(super) type SlotId = u32;

/// No section: the end of the list.
const NONE: SlotId = SlotId::MAX;

/// Sections by what they are, those in memory in the order in which they were last wanted.
///
/// A section may be dropped if the table alone holds it (a frame's scene holds what it draws), and
/// nobody with an older right waits for it.
#[derive(Debug)]
pub(super) struct SectionTable {
    limit_bytes: u64,
    held_bytes: u64,
    held_sections: u64,
    ids: HashMap<Key, SlotId>,
    slots: Vec<Slot>,
    vacant: Vec<SlotId>,
    oldest: SlotId,
    newest: SlotId,
    /// Frames that wait for others beside a section, by their numbers, rising.
    waiting: BTreeMap<SlotId, Vec<u64>>,
}

#[derive(Debug)]
struct Slot {
    key: Key,
    bytes: u64,
    state: State,
    /// Open versions that have it.
    versions: u32,
    /// When it was last wanted, in requests since the start.
    stamp: u64,
    older: SlotId,
    newer: SlotId,
}

#[derive(Debug)]
enum State {
    Absent,
    Loading,
    Loaded(Arc<Chunk>),
}

/// Whose load it is, and so what it may push out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Requester {
    /// A frame that waits: everything but what older frames wait for. So the oldest frame always gets
    /// on, and no two can block each other.
    Frame(u64),
    /// Nobody waits yet: only what has not been wanted since a request of this number.
    Prefetch(u64),
}

impl SectionTable {
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self {
            limit_bytes,
            held_bytes: 0,
            held_sections: 0,
            ids: HashMap::new(),
            slots: Vec::new(),
            vacant: Vec::new(),
            oldest: NONE,
            newest: NONE,
            waiting: BTreeMap::new(),
        }
    }

    /// The name of a section that a version has, once per version.
    pub(super) fn register(&mut self, key: Key, bytes: u64) -> SlotId {
        if let Some(&id) = self.ids.get(&key) {
            self.slots[id as usize].versions += 1;
            return id;
        }
        let (state, versions, stamp) = (State::Absent, 1, 0);
        let slot = Slot { key, bytes, state, versions, stamp, older: NONE, newer: NONE };
        let id = match self.vacant.pop() {
            Some(id) => {
                self.slots[id as usize] = slot;
                id
            }
            None => {
                self.slots.push(slot);
                (self.slots.len() - 1) as SlotId
            }
        };
        self.ids.insert(key, id);
        id
    }

    /// A version that has it was closed. What is in memory stays until its room is needed: the next
    /// version may have it, too.
    pub(super) fn unregister(&mut self, id: SlotId) {
        self.slots[id as usize].versions -= 1;
        self.release_if_unused(id);
    }

    /// The section, if it is in memory.
    pub(super) fn get(&self, id: SlotId) -> Option<&Arc<Chunk>> {
        match &self.slots[id as usize].state {
            State::Loaded(chunk) => Some(chunk),
            State::Absent | State::Loading => None,
        }
    }

    /// Whether it is neither in memory nor on its way.
    pub(super) fn is_absent(&self, id: SlotId) -> bool {
        matches!(self.slots[id as usize].state, State::Absent)
    }

    /// What it takes, in bytes.
    pub(super) fn bytes(&self, id: SlotId) -> u64 {
        self.slots[id as usize].bytes
    }

    /// Notes that it is wanted now: the last to be dropped.
    pub(super) fn touch(&mut self, id: SlotId, stamp: u64) {
        self.slots[id as usize].stamp = stamp;
        if self.get(id).is_some() {
            self.unlink(id);
            self.link_newest(id);
        }
    }

    /// A frame waits until this section and others are there together.
    pub(super) fn add_waiter(&mut self, id: SlotId, frame: u64) {
        self.waiting.entry(id).or_default().push(frame);
    }

    /// It waits no more.
    pub(super) fn remove_waiter(&mut self, id: SlotId, frame: u64) {
        if let Some(frames) = self.waiting.get_mut(&id) {
            frames.retain(|&other| other != frame);
            if frames.is_empty() {
                self.waiting.remove(&id);
            }
        }
    }

    /// The frames that wait for it, the oldest first.
    pub(super) fn waiters(&self, id: SlotId) -> &[u64] {
        self.waiting.get(&id).map_or(&[], Vec::as_slice)
    }

    /// Takes the room of a section that is to be loaded, and returns what was dropped for it. If there
    /// is not enough that may be dropped, nothing is, and nothing is taken.
    pub(super) fn reserve(&mut self, id: SlotId, requester: Requester) -> Option<Vec<SlotId>> {
        let bytes = self.slots[id as usize].bytes;
        let free_bytes = self.limit_bytes - self.held_bytes;
        let mut victims = Vec::new();
        let (mut gained_bytes, mut next) = (0, self.oldest);
        while free_bytes + gained_bytes < bytes {
            if next == NONE {
                return None;
            }
            let slot = &self.slots[next as usize];
            if let Requester::Prefetch(since) = requester
                && slot.stamp >= since
            {
                return None;
            }
            if self.may_evict(next, requester) {
                gained_bytes += slot.bytes;
                victims.push(next);
            }
            next = slot.newer;
        }
        victims.iter().for_each(|&victim| self.evict(victim));
        self.slots[id as usize].state = State::Loading;
        self.held_bytes += bytes;
        Some(victims)
    }

    /// A section has arrived. That counts as being wanted: the list stays in order of stamps.
    pub(super) fn loaded(&mut self, id: SlotId, chunk: Arc<Chunk>, stamp: u64) {
        let slot = &mut self.slots[id as usize];
        (slot.state, slot.stamp) = (State::Loaded(chunk), stamp);
        self.held_sections += 1;
        self.link_newest(id);
    }

    /// A section has not arrived.
    pub(super) fn load_failed(&mut self, id: SlotId) {
        let slot = &mut self.slots[id as usize];
        slot.state = State::Absent;
        self.held_bytes -= slot.bytes;
        self.release_if_unused(id);
    }

    /// Bytes of memory in use, what is being loaded included.
    pub(super) fn held_bytes(&self) -> u64 {
        self.held_bytes
    }

    /// Bytes of memory there are.
    pub(super) fn limit_bytes(&self) -> u64 {
        self.limit_bytes
    }

    /// Sections in memory.
    pub(super) fn held_sections(&self) -> u64 {
        self.held_sections
    }

    fn may_evict(&self, id: SlotId, requester: Requester) -> bool {
        let State::Loaded(chunk) = &self.slots[id as usize].state else { return false };
        let oldest_waiting = self.waiters(id).first();
        let spared = match requester {
            Requester::Frame(frame) => oldest_waiting.is_some_and(|&waiting| waiting <= frame),
            Requester::Prefetch(_) => oldest_waiting.is_some(),
        };
        Arc::strong_count(chunk) == 1 && !spared
    }

    fn evict(&mut self, id: SlotId) {
        self.unlink(id);
        let slot = &mut self.slots[id as usize];
        slot.state = State::Absent;
        self.held_bytes -= slot.bytes;
        self.held_sections -= 1;
        self.release_if_unused(id);
    }

    /// Absent sections of versions that nobody has open are not worth a name.
    fn release_if_unused(&mut self, id: SlotId) {
        let Slot { key, state, versions, .. } = &self.slots[id as usize];
        if *versions == 0 && matches!(state, State::Absent) {
            self.ids.remove(key);
            self.vacant.push(id);
        }
    }

    fn unlink(&mut self, id: SlotId) {
        let Slot { older, newer, .. } = self.slots[id as usize];
        match older {
            NONE => self.oldest = newer,
            older => self.slots[older as usize].newer = newer,
        }
        match newer {
            NONE => self.newest = older,
            newer => self.slots[newer as usize].older = older,
        }
    }

    fn link_newest(&mut self, id: SlotId) {
        let before = std::mem::replace(&mut self.newest, id);
        match before {
            NONE => self.oldest = id,
            before => self.slots[before as usize].newer = id,
        }
        let slot = &mut self.slots[id as usize];
        (slot.older, slot.newer) = (before, NONE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    impl SectionTable {
        /// What must hold at any time; `pinned` is what frames hold.
        fn check(&self, pinned: &[(SlotId, Arc<Chunk>)]) {
            let taken = |slot: &&Slot| !matches!(slot.state, State::Absent);
            let bytes: u64 = self.slots.iter().filter(taken).map(|slot| slot.bytes).sum();
            assert_eq!(bytes, self.held_bytes);
            assert!(bytes <= self.limit_bytes, "{bytes} of {}", self.limit_bytes);
            let (mut listed, mut next, mut before) = (Vec::new(), self.oldest, NONE);
            while next != NONE {
                let slot = &self.slots[next as usize];
                assert_eq!(slot.older, before);
                let stamp = |id: SlotId| self.slots[id as usize].stamp;
                assert!(before == NONE || stamp(before) <= slot.stamp, "in order of stamps");
                listed.push(next);
                (before, next) = (next, slot.newer);
            }
            assert_eq!(before, self.newest);
            listed.sort_unstable();
            let here = |id: &SlotId| matches!(self.slots[*id as usize].state, State::Loaded(_));
            let held: Vec<SlotId> = (0..self.slots.len() as SlotId).filter(here).collect();
            assert_eq!(listed, held, "the list is of what is here");
            assert_eq!(held.len() as u64, self.held_sections);
            for (id, chunk) in pinned {
                let same = self.get(*id).is_some_and(|here| Arc::ptr_eq(here, chunk));
                assert!(same, "section {id} was dropped while a frame held it");
            }
            for (key, id) in self.ids.iter().collect::<BTreeMap<_, _>>() {
                assert_eq!(self.slots[*id as usize].key, *key);
            }
            assert_eq!(self.ids.len() + self.vacant.len(), self.slots.len());
        }
    }

    /// Numbers that look random: Knuth's MMIX generator.
    struct Random(u64);

    impl Random {
        fn below(&mut self, limit: usize) -> usize {
            self.0 = self
                .0
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 33) as usize % limit
        }
    }

    fn key(number: usize) -> Key {
        let mut key = [0; 16];
        key[..8].copy_from_slice(&(number as u64).to_le_bytes());
        Key(key)
    }

    fn chunk() -> Arc<Chunk> {
        Arc::new(Chunk::new([0, 0], DVec3::ZERO, 0, 0))
    }

    #[test]
    fn whatever_happens_the_books_are_right_and_what_is_held_stays() {
        for seed in 1..=50 {
            let mut random = Random(seed);
            let sizes: Vec<u64> = (0..40).map(|_| 1 + random.below(50) as u64).collect();
            let mut table = SectionTable::new(200 + random.below(300) as u64);
            let names = |table: &mut SectionTable| -> Vec<SlotId> {
                let all = sizes.iter().enumerate();
                all.map(|(number, &bytes)| table.register(key(number), bytes)).collect()
            };
            let mut versions = vec![names(&mut table)];
            let mut pinned: Vec<(SlotId, Arc<Chunk>)> = Vec::new();
            let mut loading: Vec<SlotId> = Vec::new();
            let mut evicted = 0;
            for now in 1..=2_000_u64 {
                let id = versions[0][random.below(sizes.len())];
                match random.below(8) {
                    0 => table.touch(id, now),
                    1..=3 if table.is_absent(id) => {
                        let requester = match random.below(2) {
                            0 => Requester::Frame(now),
                            _ => Requester::Prefetch(now.saturating_sub(random.below(500) as u64)),
                        };
                        table.touch(id, now);
                        let before = table.held_bytes();
                        match table.reserve(id, requester) {
                            Some(dropped) => {
                                evicted += dropped.len();
                                loading.push(id);
                            }
                            None => assert_eq!(table.held_bytes(), before, "nothing was dropped"),
                        }
                    }
                    4 | 5 if !loading.is_empty() => {
                        let id = loading.swap_remove(random.below(loading.len()));
                        if random.below(4) > 0 {
                            table.loaded(id, chunk(), now);
                        } else {
                            table.load_failed(id);
                        }
                    }
                    6 => {
                        if let Some(chunk) = table.get(id).cloned() {
                            pinned.push((id, chunk));
                        }
                        if pinned.len() > 4 {
                            pinned.swap_remove(random.below(pinned.len()));
                        }
                    }
                    7 if random.below(20) == 0 => {
                        // Another version with the same sections, and one of them is closed.
                        versions.push(names(&mut table));
                        let closed = versions.remove(random.below(2));
                        closed.into_iter().for_each(|id| table.unregister(id));
                    }
                    _ => {}
                }
                table.check(&pinned);
            }
            assert!(evicted > 20, "{evicted}");
        }
    }

    /// A table with room for three sections of 10 bytes, all here, and a fourth.
    fn full() -> (SectionTable, [SlotId; 4]) {
        let mut table = SectionTable::new(30);
        let ids = [0, 1, 2, 3].map(|number| table.register(key(number), 10));
        for (stamp, &id) in (1..).zip(&ids[..3]) {
            table.touch(id, stamp);
            assert_eq!(table.reserve(id, Requester::Frame(stamp)), Some(vec![]));
            table.loaded(id, chunk(), stamp);
        }
        (table, ids)
    }

    #[test]
    fn what_was_wanted_longest_ago_goes_first() {
        let (mut table, ids) = full();
        table.touch(ids[0], 4);
        assert_eq!(table.reserve(ids[3], Requester::Frame(5)), Some(vec![ids[1]]));
    }

    #[test]
    fn a_prefetch_pushes_out_nothing_that_was_wanted_lately() {
        let (mut table, ids) = full();
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(1)), None);
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(2)), Some(vec![ids[0]]));
    }

    #[test]
    fn what_a_frame_waits_for_is_spared_by_all_but_older_frames() {
        let (mut table, ids) = full();
        ids[..3].iter().for_each(|&id| table.add_waiter(id, 7));
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(100)), None);
        assert_eq!(table.reserve(ids[3], Requester::Frame(8)), None);
        assert_eq!(table.reserve(ids[3], Requester::Frame(7)), None, "not even by itself");
        table.remove_waiter(ids[2], 7);
        assert_eq!(table.reserve(ids[3], Requester::Frame(8)), Some(vec![ids[2]]));
        table.load_failed(ids[3]);
        assert_eq!(table.reserve(ids[3], Requester::Frame(6)), Some(vec![]), "there is room now");
        assert_eq!(table.reserve(ids[2], Requester::Frame(6)), Some(vec![ids[0]]));
    }

    #[test]
    fn sections_that_no_version_has_and_nobody_holds_lose_their_names() {
        let (mut table, ids) = full();
        ids.into_iter().for_each(|id| table.unregister(id));
        assert_eq!((table.ids.len(), table.held_sections()), (3, 3), "memory stays for the next");
        let again = table.register(key(1), 10);
        assert_eq!(again, ids[1]);
        let new = table.register(key(9), 30);
        assert_eq!(table.reserve(new, Requester::Frame(9)), Some(vec![ids[0], ids[1], ids[2]]));
        table.unregister(again);
        assert_eq!(table.ids.len(), 1);
        table.check(&[]);
    }
}
