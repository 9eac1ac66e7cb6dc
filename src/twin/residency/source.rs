//! Where sections are read from.

use crate::store::{Catalog, StoreError, Version};
use wildcity_scene::Chunk;
use wildcity_scene::manifest::{ChunkEntry, Section};

/// Reads sections: a catalog, or a test's replacement that is slow or broken.
pub trait SectionSource: Send + Sync {
    /// Reads one section and decodes it into a chunk. Blocks the calling thread.
    ///
    /// # Errors
    /// The section cannot be read, or differs from what was committed.
    fn section(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
    ) -> Result<Chunk, StoreError>;
}

impl SectionSource for Catalog {
    fn section(
        &self,
        version: &Version,
        chunk: &ChunkEntry,
        section: &Section,
    ) -> Result<Chunk, StoreError> {
        Self::section(self, version, chunk, section)
    }
}
