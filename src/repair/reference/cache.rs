//! References in memory, up to a number of bytes. Eviction is least recently used.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use super::Reference;

/// Default size of the cache, in bytes: 80 images of 1440 x 928 px.
pub const DEFAULT_BYTES: u64 = 512 << 20;

/// A hash of everything that a reference depends on.
pub type ReferenceKey = [u8; 32];

/// References that sessions share. A reference that is in use stays in memory until its last user
/// drops it.
#[derive(Debug)]
pub struct ReferenceCache {
    limit_bytes: u64,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    entries: HashMap<ReferenceKey, Entry>,
    bytes: u64,
    clock: u64,
}

#[derive(Debug)]
struct Entry {
    reference: Arc<Reference>,
    used: u64,
}

impl Default for ReferenceCache {
    fn default() -> Self {
        Self::new(DEFAULT_BYTES)
    }
}

impl ReferenceCache {
    /// A cache of at most `limit_bytes`.
    pub fn new(limit_bytes: u64) -> Self {
        Self { limit_bytes, state: Mutex::default() }
    }

    /// A reference, if it is in memory.
    pub fn get(&self, key: &ReferenceKey) -> Option<Arc<Reference>> {
        let mut state = self.state.lock();
        state.clock += 1;
        let used = state.clock;
        let entry = state.entries.get_mut(key)?;
        entry.used = used;
        Some(Arc::clone(&entry.reference))
    }

    /// Keeps a reference, and evicts others until all fit. A reference larger than the cache is not
    /// kept.
    pub fn insert(&self, key: ReferenceKey, reference: Arc<Reference>) {
        let bytes = reference.bytes();
        // It would evict everything, and then itself.
        if bytes > self.limit_bytes {
            return;
        }
        let mut state = self.state.lock();
        state.clock += 1;
        let used = state.clock;
        // Two sessions may have made the same reference at the same time.
        if let Some(before) = state.entries.insert(key, Entry { reference, used }) {
            state.bytes -= before.reference.bytes();
        }
        state.bytes += bytes;
        while state.bytes > self.limit_bytes {
            // Linear in the number of entries, which is about 80 at the default size. The entry
            // just inserted has the latest use, and so goes last.
            let oldest = state.entries.iter().min_by_key(|(_, entry)| entry.used);
            let Some(key) = oldest.map(|(key, _)| *key) else { break };
            let removed = state.entries.remove(&key).map_or(0, |entry| entry.reference.bytes());
            state.bytes -= removed;
        }
    }

    /// References in memory, and their bytes.
    pub fn held(&self) -> (usize, u64) {
        let state = self.state.lock();
        (state.entries.len(), state.bytes)
    }
}
