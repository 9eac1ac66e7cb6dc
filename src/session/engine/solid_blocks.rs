//! The solid Gaussians of blocks of twins, which all sessions share.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use wildcity_sim::contact::Solids;
use wildcity_twin::residency::ReadingBytes;

/// A section by the hash of its bytes and the place of its origin: its bytes are relative to that.
pub(crate) type SectionKey = ([u8; 32], [u64; 3]);

/// Solid Gaussians of sections, so that versions share what they have in common. Drops the
/// blocks that were not used for the longest time, and reads them again when an ego comes near.
#[derive(Debug)]
pub(crate) struct SolidBlocks {
    limit_bytes: usize,
    held: Mutex<Held>,
    /// Of its own, so that what sessions draw does not wait for what they may touch.
    pub(crate) reading: ReadingBytes,
}

#[derive(Debug, Default)]
struct Held {
    blocks: HashMap<SectionKey, HeldBlock>,
    bytes: usize,
    /// Number of lookups so far.
    uses: u64,
}

#[derive(Debug)]
struct HeldBlock {
    solids: Arc<Solids>,
    last_use: u64,
}

impl SolidBlocks {
    pub(crate) fn new(limit_bytes: usize) -> Self {
        Self { limit_bytes, held: Mutex::default(), reading: ReadingBytes::default() }
    }

    /// The block of a section, if it is in memory.
    pub(crate) fn get(&self, section: &SectionKey) -> Option<Arc<Solids>> {
        let mut held = self.held.lock();
        held.uses += 1;
        let now = held.uses;
        let block = held.blocks.get_mut(section)?;
        block.last_use = now;
        Some(block.solids.clone())
    }

    /// Keeps the block of a section.
    pub(crate) fn insert(&self, section: SectionKey, solids: Arc<Solids>) {
        let mut held = self.held.lock();
        held.uses += 1;
        let block = HeldBlock { last_use: held.uses, solids };
        // Added before what it replaces is subtracted, so that the sum never falls below zero.
        held.bytes += held_bytes(&block);
        if let Some(replaced) = held.blocks.insert(section, block) {
            held.bytes -= held_bytes(&replaced);
        }
        // The last block stays even if it alone is above the limit: its reader uses it now.
        while held.bytes > self.limit_bytes && held.blocks.len() > 1 {
            // A search of all blocks, but only where one was read, which takes longer.
            let oldest = held.blocks.iter().min_by_key(|(_, block)| block.last_use);
            let Some(oldest) = oldest.map(|(section, _)| *section) else { break };
            if let Some(dropped) = held.blocks.remove(&oldest) {
                held.bytes -= held_bytes(&dropped);
            }
        }
    }
}

/// Memory of a block and of its place in the table, in bytes.
fn held_bytes(block: &HeldBlock) -> usize {
    // A key and a block have 72 bytes, and up to half of a hash table is empty.
    block.solids.bytes() + 128
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use wildcity_sim::contact::SolidPoint;

    fn solids(count: u32) -> Arc<Solids> {
        let point = |i: u32| SolidPoint {
            mean_m: DVec3::new(0.2 * f64::from(i) + 0.05, 0.05, 1.05),
            sigma_m: DVec3::splat(0.1),
            opacity: 1.0,
        };
        Arc::new(Solids::new((0..count).map(point)))
    }

    fn key(section: u8) -> SectionKey {
        ([section; 32], [0; 3])
    }

    #[test]
    fn the_blocks_that_were_not_used_are_dropped() {
        let one = solids(100);
        let blocks = SolidBlocks::new(3 * (one.bytes() + 128));
        for section in 0..3 {
            blocks.insert(key(section), one.clone());
        }
        // Now 1 is the oldest, so that it makes room for 3.
        assert!(blocks.get(&key(0)).is_some());
        blocks.insert(key(3), one.clone());
        assert!(blocks.get(&key(1)).is_none(), "used before all others");
        for section in [0, 2, 3] {
            assert!(blocks.get(&key(section)).is_some(), "{section}");
        }
        // The same section again takes no more memory; one that is larger than the limit stays
        // until the next.
        blocks.insert(key(3), one.clone());
        assert!(blocks.get(&key(0)).is_some());
        blocks.insert(key(4), solids(1000));
        assert!(blocks.get(&key(4)).is_some());
        blocks.insert(key(5), one);
        assert!(blocks.get(&key(4)).is_none());
        assert!(blocks.get(&key(5)).is_some());
        // The same bytes elsewhere are other solids.
        assert!(blocks.get(&([5; 32], [0, 0, 1])).is_none());
    }
}
