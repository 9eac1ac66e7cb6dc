//! Limits how much compressed data may expand to, so that a small file cannot exhaust the memory.

use crate::limits;

use super::{IngestError, ReadLimits, StopFlag};

/// Compressed bytes that were read of a scene, and bytes that they unpacked to.
#[derive(Debug)]
pub(super) struct UnpackBudget {
    memory_bytes: u64,
    stop: StopFlag,
    packed: u64,
    unpacked: u128,
    /// Bytes beyond those of the compressed content, for what the caller asked for.
    asked_for: u64,
}

impl UnpackBudget {
    /// Nothing was read.
    pub(super) fn new(limits: &ReadLimits<'_>) -> Self {
        let ReadLimits { memory_bytes, stop, .. } = limits.clone();
        Self { memory_bytes, stop, packed: 0, unpacked: 0, asked_for: 0 }
    }

    /// Counts compressed bytes that were read.
    pub(super) fn read(&mut self, packed: u64) {
        self.packed = self.packed.saturating_add(packed);
    }

    /// Allows bytes that the caller of the reader asked for, and not the file.
    pub(super) fn allow(&mut self, bytes: u64) {
        self.asked_for = self.asked_for.saturating_add(bytes);
    }

    /// Counts bytes that are about to be unpacked, before memory is allocated for them.
    ///
    /// # Errors
    /// [`IngestError::DecompressionBomb`], [`IngestError::TooMuchMemory`],
    /// [`IngestError::Stopped`].
    pub(super) fn unpack(
        &mut self,
        format: &'static str,
        place: &str,
        bytes: u128,
    ) -> Result<(), IngestError> {
        self.check_stop()?;
        self.unpacked = self.unpacked.saturating_add(bytes);
        if self.unpacked > u128::from(self.limit_bytes()) {
            return Err(IngestError::DecompressionBomb {
                format,
                place: place.into(),
                packed: self.packed,
                unpacked: self.unpacked,
            });
        }
        if self.unpacked > u128::from(self.memory_bytes) {
            return Err(IngestError::TooMuchMemory {
                needed: self.unpacked,
                limit: self.memory_bytes,
            });
        }
        Ok(())
    }

    /// # Errors
    /// [`IngestError::Stopped`] if the reading is to stop.
    pub(super) fn check_stop(&self) -> Result<(), IngestError> {
        self.stop.check()
    }

    /// The most bytes that may still be unpacked.
    pub(super) fn left_bytes(&self) -> u64 {
        let most = self.limit_bytes().min(self.memory_bytes);
        most.saturating_sub(u64::try_from(self.unpacked).unwrap_or(u64::MAX))
    }

    fn limit_bytes(&self) -> u64 {
        limit_bytes(self.packed).saturating_add(self.asked_for)
    }
}

/// The most bytes that `packed` compressed bytes may unpack to.
pub(super) fn limit_bytes(packed: u64) -> u64 {
    packed.saturating_mul(limits::UNPACKED_PER_BYTE).saturating_add(limits::UNPACKED_FREE_BYTES)
}
