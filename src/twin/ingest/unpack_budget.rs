//! Limits how much compressed data may expand to, so that a small file cannot exhaust the memory.

use crate::limits;

use super::IngestError;

/// Compressed bytes that were read of a scene, and bytes that they unpacked to.
#[derive(Debug, Default)]
pub(super) struct UnpackBudget {
    packed: u64,
    unpacked: u128,
}

impl UnpackBudget {
    /// Counts compressed bytes that were read.
    pub(super) fn read(&mut self, packed: u64) {
        self.packed = self.packed.saturating_add(packed);
    }

    /// Counts bytes that are about to be unpacked, before memory is allocated for them.
    ///
    /// # Errors
    /// [`IngestError::DecompressionBomb`].
    pub(super) fn unpack(
        &mut self,
        format: &'static str,
        place: &str,
        bytes: u128,
    ) -> Result<(), IngestError> {
        self.unpacked = self.unpacked.saturating_add(bytes);
        check(format, place, self.packed, self.unpacked)
    }
}

/// The most bytes that `packed` compressed bytes may unpack to.
pub(super) fn limit_bytes(packed: u64) -> u64 {
    packed.saturating_mul(limits::UNPACKED_PER_BYTE).saturating_add(limits::UNPACKED_FREE_BYTES)
}

/// Checks a size before memory is allocated for it.
///
/// # Errors
/// [`IngestError::DecompressionBomb`].
pub(super) fn check(
    format: &'static str,
    place: &str,
    packed: u64,
    unpacked: u128,
) -> Result<(), IngestError> {
    if unpacked > u128::from(limit_bytes(packed)) {
        return Err(IngestError::DecompressionBomb {
            format,
            place: place.into(),
            packed,
            unpacked,
        });
    }
    Ok(())
}
