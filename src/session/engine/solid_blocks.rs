//! The solid Gaussians of blocks of twins, which all sessions share.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use wildcity_sim::contact::Solids;

/// Solid Gaussians of sections by the hash of the section, so that versions share what they have in common. Drops the
/// blocks that were not used for the longest time, and reads them again when an ego comes near.
#[derive(Debug)]
pub(crate) struct SolidBlocks {
    limit_bytes: usize,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    blocks: HashMap<[u8; 32], HeldBlock>,
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
        Self { limit_bytes, held: Mutex::default() }
    }

    /// The block of a section, if it is in memory.
    pub(crate) fn get(&self, section: &[u8; 32]) -> Option<Arc<Solids>> {
        let mut held = self.held.lock();
        held.uses += 1;
        let now = held.uses;
        let block = held.blocks.get_mut(section)?;
        block.last_use = now;
        Some(block.solids.clone())
    }

    /// Keeps the block of a section.
    pub(crate) fn insert(&self, section: [u8; 32], solids: Arc<Solids>) {
        let mut held = self.held.lock();
        held.uses += 1;
        let block = HeldBlock { last_use: held.uses, solids };
        held.bytes += bytes_of(&block);
        if let Some(replaced) = held.blocks.insert(section, block) {
            held.bytes -= bytes_of(&replaced);
        }
        while held.bytes > self.limit_bytes && held.blocks.len() > 1 {
            let oldest = held.blocks.iter().min_by_key(|(_, block)| block.last_use);
            let Some(oldest) = oldest.map(|(section, _)| *section) else { break };
            if let Some(dropped) = held.blocks.remove(&oldest) {
                held.bytes -= bytes_of(&dropped);
            }
        }
    }
}

/// Memory of a block and of its place in the table, in bytes.
fn bytes_of(block: &HeldBlock) -> usize {
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

    #[test]
    fn the_blocks_that_were_not_used_are_dropped() {
        let one = solids(100);
        let blocks = SolidBlocks::new(3 * (one.bytes() + 128));
        for section in 0..3 {
            blocks.insert([section; 32], one.clone());
        }
        assert!(blocks.get(&[0; 32]).is_some());
        blocks.insert([3; 32], one.clone());
        assert!(blocks.get(&[1; 32]).is_none(), "used before all others");
        for section in [0, 2, 3] {
            assert!(blocks.get(&[section; 32]).is_some(), "{section}");
        }
        // The same section again takes no more memory; one that is larger than the limit stays until the next.
        blocks.insert([3; 32], one.clone());
        assert!(blocks.get(&[0; 32]).is_some());
        blocks.insert([4; 32], solids(1000));
        assert!(blocks.get(&[4; 32]).is_some());
        blocks.insert([5; 32], one);
        assert!(blocks.get(&[4; 32]).is_none());
        assert!(blocks.get(&[5; 32]).is_some());
    }
}
