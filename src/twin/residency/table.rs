//! Which sections are in memory: bookkeeping without threads and without a clock.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use wildcity_scene::Chunk;

/// A hash of everything that a section's chunk depends on. Versions that have a section in common
/// share its memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Key(pub(super) [u8; 16]);

/// Index of a section's slot in the table, valid as long as a version that contains the section is
/// open.
pub(super) type SlotId = u32;

/// No slot: the end of the linked list.
const NONE: SlotId = SlotId::MAX;

/// Sections by key. Those in memory also form a linked list in the order of their last use.
///
/// A section may be evicted if the table holds its only `Arc` (a frame's scene holds an `Arc` of
/// each chunk that it draws), and no older frame waits for it.
#[derive(Debug)]
pub(super) struct SectionTable {
    limit_bytes: u64,
    held_bytes: u64,
    held_sections: u64,
    /// Bytes of the limit that are used for other things than sections: assets of actors.
    outside_bytes: u64,
    /// Bytes of the limit that are kept free for frames.
    frame_bytes: u64,
    ids: HashMap<Key, SlotId>,
    slots: Vec<Slot>,
    vacant: Vec<SlotId>,
    oldest: SlotId,
    newest: SlotId,
    /// For each section, the numbers of the incomplete frames that contain it, ascending.
    waiters: BTreeMap<SlotId, Vec<u64>>,
}

#[derive(Debug)]
struct Slot {
    key: Key,
    bytes: u64,
    state: State,
    /// Number of open versions that contain it.
    versions: u32,
    /// Number of the request that used it last.
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

/// The request that a load is for, which decides what the load may evict.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Requester {
    /// A frame that waits, by number. It may evict everything except what it waits for itself and
    /// what older frames wait for. So the oldest frame always makes progress, and no two frames can
    /// block each other.
    Frame(u64),
    /// A prefetch: no frame waits yet. It may evict only what was last used before the request of
    /// this number.
    Prefetch(u64),
}

impl SectionTable {
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self {
            limit_bytes,
            held_bytes: 0,
            held_sections: 0,
            outside_bytes: 0,
            frame_bytes: 0,
            ids: HashMap::new(),
            slots: Vec::new(),
            vacant: Vec::new(),
            oldest: NONE,
            newest: NONE,
            waiters: BTreeMap::new(),
        }
    }

    /// Returns the slot of a section, made if need be. Called once per open version that contains
    /// it.
    pub(super) fn register(&mut self, key: Key, bytes: u64) -> SlotId {
        if let Some(&id) = self.ids.get(&key) {
            self.slots[id as usize].versions += 1;
            return id;
        }
        let slot = Slot {
            key,
            bytes,
            state: State::Absent,
            versions: 1,
            stamp: 0,
            older: NONE,
            newer: NONE,
        };
        let id = match self.vacant.pop() {
            Some(id) => {
                self.slots[id as usize] = slot;
                id
            }
            None => {
                self.slots.push(slot);
                // At 64 B each, 2^32 slots would take 256 GiB, so that the cast loses nothing.
                (self.slots.len() - 1) as SlotId
            }
        };
        self.ids.insert(key, id);
        id
    }

    /// A version that contains it was closed. A section in memory stays until its memory is needed,
    /// because the next version may contain it, too.
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

    /// Whether the section is neither in memory nor being loaded.
    pub(super) fn is_absent(&self, id: SlotId) -> bool {
        matches!(self.slots[id as usize].state, State::Absent)
    }

    /// Bytes of memory that the section takes.
    pub(super) fn bytes(&self, id: SlotId) -> u64 {
        self.slots[id as usize].bytes
    }

    /// Marks the section as just used, so that it is evicted last.
    pub(super) fn touch(&mut self, id: SlotId, stamp: u64) {
        self.slots[id as usize].stamp = stamp;
        // A section that is being loaded is in no list; `loaded` links it with a later stamp.
        if self.get(id).is_some() {
            self.unlink(id);
            self.link_newest(id);
        }
    }

    /// A frame waits until this section and its others are in memory together.
    pub(super) fn add_waiter(&mut self, id: SlotId, frame: u64) {
        // Frames are numbered in the order of their requests, so that pushing keeps the list
        // ascending.
        self.waiters.entry(id).or_default().push(frame);
    }

    /// The frame no longer waits.
    pub(super) fn remove_waiter(&mut self, id: SlotId, frame: u64) {
        if let Some(frames) = self.waiters.get_mut(&id) {
            frames.retain(|&other| other != frame);
            // Sections for which no frame waits have no entry, so that the map stays as small as
            // the waiting frames.
            if frames.is_empty() {
                self.waiters.remove(&id);
            }
        }
    }

    /// The frames that wait for the section, the oldest first.
    pub(super) fn waiters(&self, id: SlotId) -> &[u64] {
        self.waiters.get(&id).map_or(&[], Vec::as_slice)
    }

    /// Reserves the memory of a section that is to be loaded, and returns the sections evicted for
    /// it. `None` if evicting everything permitted would not free enough memory; then nothing
    /// changes.
    pub(super) fn reserve(&mut self, id: SlotId, requester: Requester) -> Option<Vec<SlotId>> {
        let bytes = self.slots[id as usize].bytes;
        // In use, kept for frames, and wanted: the sum must not exceed the limit plus what eviction
        // frees.
        let wanted_bytes = self.held_bytes() + self.frame_bytes + bytes;
        let mut victims = Vec::new();
        let mut gained_bytes = 0;
        let mut next = self.oldest;
        // From the least recently used section to the most recently used one.
        while self.limit_bytes + gained_bytes < wanted_bytes {
            if next == NONE {
                return None;
            }
            let slot = &self.slots[next as usize];
            // The list is in order of stamps, so all that follow were used more recently.
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
        // Counted from here on, although the bytes are not read yet: no other load can take them.
        self.slots[id as usize].state = State::Loading;
        self.held_bytes += bytes;
        Some(victims)
    }

    /// A section was loaded. That counts as a use, so the list stays in order of stamps.
    pub(super) fn loaded(&mut self, id: SlotId, chunk: Arc<Chunk>, stamp: u64) {
        let slot = &mut self.slots[id as usize];
        slot.state = State::Loaded(chunk);
        // No stamp in the list is later, because stamps are numbers of requests.
        slot.stamp = stamp;
        self.held_sections += 1;
        self.link_newest(id);
    }

    /// A section could not be loaded.
    pub(super) fn load_failed(&mut self, id: SlotId) {
        let slot = &mut self.slots[id as usize];
        slot.state = State::Absent;
        self.held_bytes -= slot.bytes;
        // Its last version may have been closed while it was being read.
        self.release_if_unused(id);
    }

    /// Bytes of memory in use, including sections that are being loaded, and assets.
    pub(super) fn held_bytes(&self) -> u64 {
        self.held_bytes + self.outside_bytes
    }

    /// Bytes of memory that sections and assets may use.
    pub(super) fn limit_bytes(&self) -> u64 {
        self.limit_bytes
    }

    /// Bytes of memory that sections may use: what assets and frames leave of the limit.
    pub(super) fn limit_of_sections_bytes(&self) -> u64 {
        self.limit_bytes.saturating_sub(self.outside_bytes + self.frame_bytes)
    }

    /// Keeps `bytes` free for frames: sections that no frame draws or waits for are evicted.
    pub(super) fn set_frame_bytes(&mut self, bytes: u64) {
        self.frame_bytes = bytes;
        let mut next = self.oldest;
        // Best effort: what frames draw stays, and later loads wait until it is released.
        while self.held_bytes() + self.frame_bytes > self.limit_bytes && next != NONE {
            let newer = self.slots[next as usize].newer;
            // No prefetch has this number, so that no stamp protects a section; waiting frames
            // still do.
            if self.may_evict(next, Requester::Prefetch(u64::MAX)) {
                self.evict(next);
            }
            next = newer;
        }
    }

    /// An asset was loaded, which takes memory from the sections. They are evicted with the next
    /// load.
    pub(super) fn add_outside_bytes(&mut self, bytes: u64) {
        self.outside_bytes += bytes;
    }

    /// An asset was dropped.
    pub(super) fn remove_outside_bytes(&mut self, bytes: u64) {
        self.outside_bytes -= bytes;
    }

    /// Sections in memory.
    pub(super) fn held_sections(&self) -> u64 {
        self.held_sections
    }

    fn may_evict(&self, id: SlotId, requester: Requester) -> bool {
        let State::Loaded(chunk) = &self.slots[id as usize].state else { return false };
        let oldest_waiting = self.waiters(id).first();
        let is_protected = match requester {
            // `<=`, because a frame that evicts what it waits for itself would never be complete.
            Requester::Frame(frame) => oldest_waiting.is_some_and(|&waiting| waiting <= frame),
            Requester::Prefetch(_) => oldest_waiting.is_some(),
        };
        // The lock is held, and new `Arc`s come only from the table, so that a count of 1 cannot
        // rise.
        Arc::strong_count(chunk) == 1 && !is_protected
    }

    fn evict(&mut self, id: SlotId) {
        self.unlink(id);
        let slot = &mut self.slots[id as usize];
        slot.state = State::Absent;
        self.held_bytes -= slot.bytes;
        self.held_sections -= 1;
        // Its last version may have been closed while it was in memory.
        self.release_if_unused(id);
    }

    /// Frees the slot of a section that is absent and in no open version.
    fn release_if_unused(&mut self, id: SlotId) {
        let Slot { key, state, versions, .. } = &self.slots[id as usize];
        // A section that is being loaded keeps its slot, because the loader thread will report by
        // its number.
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
        slot.older = before;
        slot.newer = NONE;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    impl SectionTable {
        /// Checks the invariants; `pinned` is what frames hold.
        fn check(&self, pinned: &[(SlotId, Arc<Chunk>)]) {
            let taken = |slot: &&Slot| !matches!(slot.state, State::Absent);
            let bytes: u64 = self.slots.iter().filter(taken).map(|slot| slot.bytes).sum();
            assert_eq!(bytes, self.held_bytes);
            assert!(bytes <= self.limit_bytes, "{bytes} of {}", self.limit_bytes);
            let mut listed = Vec::new();
            let mut next = self.oldest;
            let mut before = NONE;
            while next != NONE {
                let slot = &self.slots[next as usize];
                assert_eq!(slot.older, before);
                let stamp = |id: SlotId| self.slots[id as usize].stamp;
                assert!(before == NONE || stamp(before) <= slot.stamp, "in order of stamps");
                listed.push(next);
                before = next;
                next = slot.newer;
            }
            assert_eq!(before, self.newest);
            listed.sort_unstable();
            let here = |id: &SlotId| matches!(self.slots[*id as usize].state, State::Loaded(_));
            let held: Vec<SlotId> = (0..self.slots.len() as SlotId).filter(here).collect();
            assert_eq!(listed, held, "the list contains the loaded sections");
            assert_eq!(held.len() as u64, self.held_sections);
            for (id, chunk) in pinned {
                let same = self.get(*id).is_some_and(|here| Arc::ptr_eq(here, chunk));
                assert!(same, "section {id} was evicted while a frame held it");
            }
            for (key, id) in self.ids.iter().collect::<BTreeMap<_, _>>() {
                assert_eq!(self.slots[*id as usize].key, *key);
            }
            assert_eq!(self.ids.len() + self.vacant.len(), self.slots.len());
        }
    }

    /// Pseudorandom numbers: Knuth's MMIX generator.
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
    fn random_operations_keep_the_invariants_and_never_evict_what_a_frame_holds() {
        for seed in 1..=50 {
            let mut random = Random(seed);
            // About 40 sections of 25 bytes are 1000 bytes, two to five times the limit, so that
            // eviction is frequent.
            let sizes: Vec<u64> = (0..40).map(|_| 1 + random.below(50) as u64).collect();
            let mut table = SectionTable::new(200 + random.below(300) as u64);
            let register_all = |table: &mut SectionTable| -> Vec<SlotId> {
                let all = sizes.iter().enumerate();
                all.map(|(number, &bytes)| table.register(key(number), bytes)).collect()
            };
            let mut versions = vec![register_all(&mut table)];
            let mut pinned: Vec<(SlotId, Arc<Chunk>)> = Vec::new();
            let mut loading: Vec<SlotId> = Vec::new();
            let mut evicted = 0;
            // `now` plays the number of the request, which is the stamp.
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
                            None => assert_eq!(table.held_bytes(), before, "nothing was evicted"),
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
                        // At most four are pinned: at up to 50 bytes each they fit into the least
                        // limit, 200.
                        if pinned.len() > 4 {
                            pinned.swap_remove(random.below(pinned.len()));
                        }
                    }
                    7 if random.below(20) == 0 => {
                        // Another version with the same sections, and one of them is closed.
                        versions.push(register_all(&mut table));
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

    /// A table with room for three sections of 10 bytes, all loaded, and a fourth that is absent.
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
    fn the_least_recently_used_section_is_evicted_first() {
        let (mut table, ids) = full();
        // Now the order of use is 1, 2, 0.
        table.touch(ids[0], 4);
        assert_eq!(table.reserve(ids[3], Requester::Frame(5)), Some(vec![ids[1]]));
    }

    #[test]
    fn a_prefetch_evicts_nothing_that_was_used_recently() {
        let (mut table, ids) = full();
        // All stamps are 1 to 3. A bound of 1 protects all, a bound of 2 all but the first.
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(1)), None);
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(2)), Some(vec![ids[0]]));
    }

    #[test]
    fn only_older_frames_evict_what_a_frame_waits_for() {
        let (mut table, ids) = full();
        ids[..3].iter().for_each(|&id| table.add_waiter(id, 7));
        assert_eq!(table.reserve(ids[3], Requester::Prefetch(100)), None);
        assert_eq!(table.reserve(ids[3], Requester::Frame(8)), None);
        assert_eq!(table.reserve(ids[3], Requester::Frame(7)), None, "nor by the frame itself");
        table.remove_waiter(ids[2], 7);
        assert_eq!(table.reserve(ids[3], Requester::Frame(8)), Some(vec![ids[2]]));
        table.load_failed(ids[3]);
        // The third section was evicted above and the load of the fourth failed: 20 of 30 bytes are
        // in use.
        assert_eq!(table.reserve(ids[3], Requester::Frame(6)), Some(vec![]), "there is room now");
        // Now it is full again. Frame 6 is older than 7, so that it may take the least recent one.
        assert_eq!(table.reserve(ids[2], Requester::Frame(6)), Some(vec![ids[0]]));
    }

    #[test]
    fn absent_sections_of_closed_versions_free_their_slots() {
        let (mut table, ids) = full();
        ids.into_iter().for_each(|id| table.unregister(id));
        assert_eq!(
            (table.ids.len(), table.held_sections()),
            (3, 3),
            "what is in memory stays for the next version"
        );
        let again = table.register(key(1), 10);
        assert_eq!(again, ids[1]);
        let new = table.register(key(9), 30);
        // The limit is 30 bytes, so that everything must go for it; section 1 keeps its slot,
        // because a version still has it.
        assert_eq!(table.reserve(new, Requester::Frame(9)), Some(vec![ids[0], ids[1], ids[2]]));
        table.unregister(again);
        assert_eq!(table.ids.len(), 1);
        table.check(&[]);
    }
}
