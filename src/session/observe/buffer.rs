//! The bytes of an observation.

use crate::engine::answer_budget::{AnswerBudget, BudgetShare};
use crate::error::SessionError;

/// Bytes at an address that is a multiple of 8, counted against the budget for answers.
#[derive(Debug)]
pub struct ObservationBuffer {
    words: Vec<u64>,
    len: usize,
    /// Bytes that are reserved at the front.
    header: usize,
    /// Where the message begins: what of the reserved bytes is not needed comes before.
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
        let share = budget.reserve(len as u64)?;
        Ok(Self { words: budget.words(len.div_ceil(8)), len, header, start: 0, share })
    }

    /// The message: the header, its length prefix included, and the tensors.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[self.start..self.len]
    }

    /// Makes the message begin with a header of `bytes`, its length prefix included, and returns them.
    /// `None` if not so many are reserved.
    pub fn header_mut(&mut self, bytes: usize) -> Option<&mut [u8]> {
        let header = self.header;
        self.start = header.checked_sub(bytes)?;
        let start = self.start;
        Some(&mut self.bytes_mut()[start..header])
    }

    /// All bytes, from the first that is reserved for the header.
    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.words)[..self.len]
    }

    /// Appends copies of `parts`, one after the other.
    pub(crate) fn append(
        &mut self,
        budget: &AnswerBudget,
        parts: &[&[u8]],
    ) -> Result<(), SessionError> {
        let mut start = self.len;
        let len = start + parts.iter().map(|part| part.len()).sum::<usize>();
        self.share.merge(budget.reserve((len - start) as u64)?);
        // Exactly: `Vec` would otherwise reserve up to twice as much, which the budget would not count.
        self.words.reserve_exact(len.div_ceil(8) - self.words.len());
        self.words.resize(len.div_ceil(8), 0);
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
        self.share.keep(std::mem::take(&mut self.words));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits;

    #[test]
    fn the_budget_counts_all_memory() {
        let budget = AnswerBudget::default();
        let mut buffer = ObservationBuffer::new(&budget, 80_000, 16).unwrap();
        buffer.append(&budget, &[&[1; 5], &[2; 11]]).unwrap();
        assert_eq!(buffer.bytes().len(), 80_016);
        assert_eq!(buffer.words.capacity() * 8, 80_016);
        assert_eq!(buffer.bytes()[80_004..80_006], [1, 2]);
    }

    #[test]
    fn the_memory_of_an_answer_serves_the_next_of_about_its_size() {
        let budget = AnswerBudget::default();
        let mut next = |len: usize| {
            let mut buffer = ObservationBuffer::new(&budget, len, 16).unwrap();
            assert_eq!(buffer.bytes().len(), len);
            let is_used = buffer.bytes().contains(&9);
            buffer.bytes_mut().fill(9);
            is_used
        };
        assert_eq!([80_000, 80_000, 72_000, 80_000].map(&mut next), [false, true, true, true]);
        // Larger ones, and much smaller ones, get memory of their own.
        assert_eq!([80_008, 60_000, 60_000].map(&mut next), [false, false, true]);
        assert_eq!([limits::SPARE_ANSWER_BYTES + 8; 2].map(&mut next), [false, false]);
        // Two at once.
        let both = [1000; 2].map(|len| ObservationBuffer::new(&budget, len, 16).unwrap());
        assert_ne!(both[0].bytes().as_ptr(), both[1].bytes().as_ptr());
    }

    #[test]
    fn the_message_begins_with_a_header_of_its_own_size() {
        let mut buffer = ObservationBuffer::new(&AnswerBudget::default(), 20, 16).unwrap();
        assert!(buffer.header_mut(17).is_none());
        buffer.header_mut(8).unwrap().fill(7);
        assert_eq!(buffer.bytes(), [7, 7, 7, 7, 7, 7, 7, 7, 0, 0, 0, 0]);
    }
}
