//! How much may come of how little: the limit of everything compressed.

use crate::limits;

use super::IngestError;

/// What a scene has unpacked so far of how much.
#[derive(Debug, Default)]
pub(super) struct UnpackBudget {
    packed: u64,
    unpacked: u128,
}

impl UnpackBudget {
    /// So many more compressed bytes were read.
    pub(super) fn read(&mut self, packed: u64) {
        self.packed = self.packed.saturating_add(packed);
    }

    /// Asks for room for so many more bytes, before there is any.
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

/// Bytes that so many compressed ones may unpack to.
pub(super) fn limit_bytes(packed: u64) -> u64 {
    packed.saturating_mul(limits::UNPACKED_PER_BYTE).saturating_add(limits::UNPACKED_FREE_BYTES)
}

/// Refuses what unpacks to more, before memory is asked for.
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
