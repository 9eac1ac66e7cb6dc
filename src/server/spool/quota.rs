//! Limits of the space that uploads use: of all tokens together, and of each.
//!
//! An upload uses space for the bytes that have arrived. While it is active, some more space is
//! reserved, so that accepted uploads seldom fail because the spool is full. If no bytes arrive for
//! minutes, the reservation ends: otherwise a token could prevent all others from uploading without
//! sending anything.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::config::SpoolLimits;
use crate::fault::Fault;
use crate::limits;

use super::upload::{RemovedFiles, Upload};
use super::{SpoolUsage, Uploads};

/// The limits of uploads, in all and per token.
#[derive(Clone, Debug)]
pub(super) struct Quota {
    all: SpoolUsage,
    token: SpoolUsage,
    /// Limits in bytes of tokens that have their own limit, by name.
    own_bytes: BTreeMap<String, u64>,
}

/// The space that an upload is going to use.
#[derive(Clone, Copy)]
struct Demand<'a> {
    upload: &'a Upload,
    bytes: u64,
}

impl Quota {
    /// The limits of a spool for `tokens` tokens. `own_bytes` has the limits of tokens that have
    /// their own limit, in bytes.
    pub(super) fn new(
        limits: SpoolLimits,
        tokens: usize,
        own_bytes: BTreeMap<String, u64>,
    ) -> Self {
        let all = SpoolUsage { uploads: limits.uploads, bytes: limits.bytes };
        // A single token may use all space.
        let share = if tokens > 1 { limits::TOKEN_SHARE } else { 1 };
        let bytes = limits.token_bytes.unwrap_or(all.bytes / share).min(all.bytes);
        // Rounded up, so that a limit of one upload is not a limit of none.
        let uploads = all.uploads.div_ceil(share as usize);
        Self { all, token: SpoolUsage { uploads, bytes }, own_bytes }
    }

    /// Limits of the uploads of a token.
    fn token_usage(&self, owner: &str) -> SpoolUsage {
        let own = self.own_bytes.get(owner).copied();
        SpoolUsage { bytes: own.unwrap_or(self.token.bytes).min(self.all.bytes), ..self.token }
    }

    /// Removes uploads until a new one fits.
    ///
    /// # Errors
    /// [`Fault::StorageFull`].
    pub(super) fn make_room_for_new(
        &self,
        uploads: &mut Uploads,
        upload: &Upload,
        removed: &mut Vec<RemovedFiles>,
    ) -> Result<(), Fault> {
        // Refuse an upload that can never fit before it is sent.
        let size = upload.announced().size;
        let most = self.token_usage(upload.owner()).bytes;
        if size > most {
            let reason = format!(
                "{size} bytes, and the uploads of this token may have {most}: send it in parts, or ask the operator \
                 for a larger limit (upload_bytes of the token, or --token-spool-gib)"
            );
            return Err(Fault::StorageFull { reason });
        }
        // An announcement alone reserves 16 MiB at most, and not its whole size.
        let bytes = size.min(limits::RESERVED_BYTES);
        self.make_room(uploads, Demand { upload, bytes }, removed)
    }

    /// Removes uploads until more bytes of one fit.
    ///
    /// # Errors
    /// [`Fault::StorageFull`].
    pub(super) fn make_room_for_more(
        &self,
        uploads: &mut Uploads,
        upload: &Upload,
        more_bytes: u64,
        removed: &mut Vec<RemovedFiles>,
    ) -> Result<(), Fault> {
        // Not less than what the upload counts for already, or its reservation would shrink by
        // asking.
        let bytes = upload.offset().saturating_add(more_bytes).max(upload_bytes(upload));
        self.make_room(uploads, Demand { upload, bytes }, removed)
    }

    fn make_room(
        &self,
        uploads: &mut Uploads,
        demand: Demand<'_>,
        removed: &mut Vec<RemovedFiles>,
    ) -> Result<(), Fault> {
        let owner = demand.upload.owner();
        let token = self.token_usage(owner);
        // Each turn removes one upload or returns, so this ends after as many turns as there are
        // uploads.
        loop {
            let others = || uploads.values().filter(|known| known.stem() != demand.upload.stem());
            let own = usage(others().filter(|known| known.owner() == owner));
            let all = usage(others());
            let is_own_full = !token.fits(own, demand.bytes);
            if !is_own_full && self.all.fits(all, demand.bytes) {
                return Ok(());
            }
            // Remove the token's own uploads first, and no others if the token's own quota is
            // exceeded.
            let is_removable = |known: &&Arc<Upload>| {
                is_removable(known, owner) && (!is_own_full || known.owner() == owner)
            };
            let first = others()
                .filter(is_removable)
                // In this order: own before others', empty before others, oldest first.
                .min_by_key(|known| (known.owner() != owner, known.offset() > 0, known.used_us()));
            let Some(stem) = first.map(|known| known.stem().to_owned()) else {
                let (whose, kept, most) = if is_own_full {
                    ("this token keeps", own, token)
                } else {
                    ("the server keeps", all, self.all)
                };
                let reason = format!(
                    "{whose} {} uploads of {} bytes, of at most {} uploads and {} bytes; push what is \
                     uploaded, or wait",
                    kept.uploads, kept.bytes, most.uploads, most.bytes
                );
                return Err(Fault::StorageFull { reason });
            };
            if let Some(upload) = uploads.remove(&stem) {
                removed.push(upload.set_aside());
            }
        }
    }
}

impl SpoolUsage {
    /// Whether one more upload of `bytes` bytes fits.
    fn fits(self, used: Self, bytes: u64) -> bool {
        // A sum that does not fit a u64 fits no disk.
        let sum = used.bytes.checked_add(bytes);
        used.uploads < self.uploads && sum.is_some_and(|sum| sum <= self.bytes)
    }
}

/// Space that uploads use.
pub(super) fn usage<'a>(uploads: impl Iterator<Item = &'a Arc<Upload>>) -> SpoolUsage {
    uploads.fold(SpoolUsage::default(), |sum, upload| SpoolUsage {
        uploads: sum.uploads + 1,
        bytes: sum.bytes.saturating_add(upload_bytes(upload)),
    })
}

/// Bytes that an upload takes: those that have arrived, and those that are reserved.
fn upload_bytes(upload: &Upload) -> u64 {
    let held = upload.offset();
    let is_active = upload.idle() < limits::RESERVED_FOR;
    let reserved = if is_active && !upload.is_complete() { limits::RESERVED_BYTES } else { 0 };
    // More than its size never arrives, so that the last reservation shrinks with the rest.
    held.saturating_add(reserved).min(upload.announced().size)
}

/// Whether an upload may be removed to make space for an upload of `owner`. It must not be in use,
/// and must be complete or have been idle for a while. A complete upload of another token must have
/// been idle as well, because its push may follow soon.
fn is_removable(upload: &Arc<Upload>, owner: &str) -> bool {
    // The map has one reference; a connection or a push that uses it has another one.
    if Arc::strong_count(upload) > 1 {
        return false;
    }
    let is_own_complete = upload.is_complete() && upload.owner() == owner;
    let is_empty = !upload.is_complete() && upload.offset() == 0;
    let wait = if is_empty { limits::RESERVED_FOR } else { limits::KEPT_FOR };
    is_own_complete || upload.idle() >= wait
}
