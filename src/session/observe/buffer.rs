//! The bytes of an observation.

use crate::engine::answer_budget::{AnswerBudget, BudgetShare};
use crate::error::SessionError;

/// Bytes of a word: the buffer's address is a multiple of them.
const WORD_BYTES: usize = size_of::<u64>();

/// Bytes at an address that is a multiple of 8, counted against the budget for answers.
#[derive(Debug)]
pub struct ObservationBuffer {
    words: Vec<u64>,
    len: usize,
    /// Bytes that are reserved at the front.
    header: usize,
    /// Start of the message. Reserved bytes that the header does not need come before it.
    start: usize,
    share: BudgetShare,
}

impl ObservationBuffer {
    /// `len` bytes of any values, of which the first `header` are reserved for the header.
    pub(crate) fn new(
        budget: &AnswerBudget,
        len: usize,
        header: usize,
    ) -> Result<Self, SessionError> {
        let count = len.div_ceil(WORD_BYTES);
        // The budget first: memory that it does not cover is never allocated.
        let mut share = budget.reserve((count * WORD_BYTES) as u64)?;
        let mut words = budget.spare().take(count);
        // The spare words may be more than the budget has left.
        match budget.reserve(((words.capacity() - count) * WORD_BYTES) as u64) {
            Ok(more) => share.merge(more),
            Err(_) => words = vec![0; count],
        }
        Ok(Self { words, len, header, start: header, share })
    }

    /// The message: the header, its length prefix included, and the tensors. Without a header only
    /// the tensors.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[self.start..self.len]
    }

    /// Makes the message begin with a header of `bytes`, its length prefix included, and returns
    /// them. `None` if fewer are reserved.
    pub fn header_mut(&mut self, bytes: usize) -> Option<&mut [u8]> {
        let header = self.header;
        // The header ends where the tensors begin, whatever its length is.
        self.start = header.checked_sub(bytes)?;
        let start = self.start;
        Some(&mut self.bytes_mut()[start..header])
    }

    /// All bytes, from the first that is reserved for the header.
    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.words)[..self.len]
    }

    /// Appends copies of `parts`, one after the other.
    pub(crate) fn append(&mut self, parts: &[&[u8]]) -> Result<(), SessionError> {
        let mut start = self.len;
        let len = start + parts.iter().map(|part| part.len()).sum::<usize>();
        let count = len.div_ceil(WORD_BYTES);
        // The capacity that the words have is counted already.
        let more = count.saturating_sub(self.words.capacity());
        self.share.merge(self.share.budget().reserve((more * WORD_BYTES) as u64)?);
        // Exactly: `Vec` would otherwise reserve up to twice as much, which the budget would not
        // count.
        // `len` only grew, so that `count` is at least the number of words.
        self.words.reserve_exact(count - self.words.len());
        self.words.resize(count, 0);
        self.len = len;
        for part in parts {
            self.bytes_mut()[start..start + part.len()].copy_from_slice(part);
            start += part.len();
        }
        Ok(())
    }
}

impl Drop for ObservationBuffer {
    fn drop(&mut self) {
        // The share goes back to the budget right after this: spare memory is not part of it.
        self.share.budget().spare().recycle(std::mem::take(&mut self.words));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_budget_counts_all_memory() {
        let budget = AnswerBudget::default();
        for appended in [16, 40, 8] {
            // The second and third have the memory of those before them.
            let mut buffer = ObservationBuffer::new(&budget, 80_000, 16).unwrap();
            // Five bytes and the others, so that a part ends within a word.
            buffer.append(&[&[1; 5], &vec![2; appended - 5]]).unwrap();
            assert_eq!(buffer.bytes().len(), 80_000 - 16 + appended);
            // The last byte of the first part, and the first one of the second.
            assert_eq!(buffer.bytes()[80_000 - 16 + 4..][..2], [1, 2]);
            assert_eq!(budget.reserved(), (WORD_BYTES * buffer.words.capacity()) as u64);
        }
        assert_eq!(budget.reserved(), 0);
    }

    #[test]
    fn the_message_begins_with_a_header_of_its_own_size() {
        let mut buffer = ObservationBuffer::new(&AnswerBudget::default(), 20, 16).unwrap();
        assert_eq!(buffer.bytes(), [0; 4]);
        assert!(buffer.header_mut(17).is_none());
        buffer.header_mut(8).unwrap().fill(7);
        assert_eq!(buffer.bytes(), [7, 7, 7, 7, 7, 7, 7, 7, 0, 0, 0, 0]);
    }
}
