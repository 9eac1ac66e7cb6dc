//! Where sections come from.

use crate::store::{Catalog, StoreError, Version};
use wildcity_scene::Chunk;
use wildcity_scene::manifest::{ChunkEntry, Section};

/// Something that reads sections: a catalog, or a test's idea of one that is slow or broken.
pub trait SectionSource: Send + Sync {
    /// Reads one section, activated. Blocks.
    ///
    /// # Errors
    /// It cannot be read, or is not what was committed.
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
