//! How much memory twins may take together.

use std::fs::File;
use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::config;
use crate::scene::{Chunk, Manifest};

use super::ResidencyError;

/// Bytes that twins in memory may take, and what is taken.
#[derive(Debug)]
pub(super) struct Budget {
    limit_bytes: u64,
    held_bytes: Arc<AtomicU64>,
}

/// A part of the budget, given back when dropped.
#[derive(Debug)]
pub(super) struct Room {
    held_bytes: Arc<AtomicU64>,
    bytes: u64,
}

impl Budget {
    /// So many bytes, or three quarters of the machine's memory.
    pub(super) fn new(limit_bytes: Option<u64>) -> Self {
        let limit_bytes = limit_bytes.unwrap_or_else(|| {
            physical_bytes().map_or(config::RESIDENT_BYTES, |physical| physical / 4 * 3)
        });
        Self { limit_bytes, held_bytes: Arc::default() }
    }

    /// Takes what a version will hold, before any of it is loaded.
    ///
    /// # Errors
    /// [`ResidencyError::NoRoom`] with the numbers.
    pub(super) fn take(&self, manifest: &Manifest) -> Result<Room, ResidencyError> {
        let chunks = manifest.chunks.iter();
        let bytes: u64 = chunks
            .flat_map(|chunk| &chunk.sections)
            .map(|section| Chunk::bytes_of(manifest.sh_degree, section.count.into()))
            .fold(0, u64::saturating_add);
        let fits = |held: u64| held.checked_add(bytes).filter(|sum| *sum <= self.limit_bytes);
        match self.held_bytes.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(_) => Ok(Room { held_bytes: self.held_bytes.clone(), bytes }),
            Err(held_bytes) => Err(ResidencyError::NoRoom {
                twin: manifest.twin.clone(),
                needed_bytes: bytes,
                held_bytes,
                limit_bytes: self.limit_bytes,
            }),
        }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.held_bytes.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Memory of the machine; none where /proc does not say.
fn physical_bytes() -> Option<u64> {
    let mut text = String::new();
    File::open("/proc/meminfo").ok()?.take(4096).read_to_string(&mut text).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib << 10)
}
