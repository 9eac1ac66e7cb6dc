//! The budget of bytes for answers, shared by all sessions.
//!
//! It covers the observations that are being made, sent, or kept for a repeated `seq`, the earlier
//! frames that later observations contain again, memory that is shared with clients, and the
//! overlays of the sessions' cameras. Without it, a few slow clients with large images could
//! exhaust the server's memory.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::spare_memory::SpareMemory;
use crate::error::SessionError;
use crate::limits;

/// Counts reserved bytes, at most [`limits::ANSWERS_BYTES`]. Clones share one count.
#[derive(Clone, Debug, Default)]
pub(crate) struct AnswerBudget(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    reserved: AtomicU64,
    spare: SpareMemory,
}

/// Reserved bytes of the budget. Dropping it returns them.
#[derive(Debug)]
pub struct BudgetShare {
    budget: AnswerBudget,
    bytes: u64,
}

impl AnswerBudget {
    /// Reserves bytes.
    ///
    /// # Errors
    /// [`SessionError::Busy`] if fewer are left.
    pub(crate) fn reserve(&self, bytes: u64) -> Result<BudgetShare, SessionError> {
        let limit = limits::ANSWERS_BYTES;
        // An overflow of the sum counts as too much.
        let within_limit = |used: u64| used.checked_add(bytes).filter(|&sum| sum <= limit);
        self.0
            // Relaxed, because no other data depends on the count.
            .reserved
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, within_limit)
            .map(|_| BudgetShare { budget: self.clone(), bytes })
            .map_err(|_| SessionError::Busy { what: "too many answers are kept" })
    }

    /// Memory for the next answer.
    pub(crate) fn spare(&self) -> &SpareMemory {
        &self.0.spare
    }

    /// Bytes that are reserved.
    pub(crate) fn reserved(&self) -> u64 {
        self.0.reserved.load(Ordering::Relaxed)
    }
}

impl BudgetShare {
    /// The budget that it is a share of.
    pub(crate) fn budget(&self) -> &AnswerBudget {
        &self.budget
    }

    /// Adds another share of the same budget to this one.
    pub fn merge(&mut self, mut other: Self) {
        // `other` is dropped with 0 bytes, so that it returns none.
        self.bytes += std::mem::take(&mut other.bytes);
    }
}

impl Drop for BudgetShare {
    fn drop(&mut self) {
        self.budget.0.reserved.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropped_shares_return_to_the_budget() {
        let budget = AnswerBudget::default();
        // A round would fail if the one before it had kept a byte.
        for _ in 0..3 {
            // Two halves of an odd limit leave one byte, so that 2 bytes are never left.
            let mut half = budget.reserve(limits::ANSWERS_BYTES / 2).unwrap();
            half.merge(budget.reserve(limits::ANSWERS_BYTES / 2).unwrap());
            assert!(matches!(budget.reserve(2), Err(SessionError::Busy { .. })));
        }
        assert!(budget.reserve(limits::ANSWERS_BYTES).is_ok());
        assert!(budget.reserve(limits::ANSWERS_BYTES + 1).is_err());
        assert!(budget.reserve(u64::MAX).is_err());
    }
}
