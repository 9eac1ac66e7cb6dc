//! The bytes of an observation.

use crate::engine::{AnswerBudget, BudgetShare};
use crate::error::SessionError;

/// Bytes at an address that is a multiple of 8, counted against the budget for answers.
#[derive(Debug)]
pub struct ObservationBuffer {
    words: Vec<u64>,
    len: usize,
    header: usize,
    hold: BudgetShare,
}

impl ObservationBuffer {
    /// `len` zeros, the first `header` of which are the header's.
    pub(crate) fn zeroed(
        answers: &AnswerBudget,
        len: usize,
        header: usize,
    ) -> Result<Self, SessionError> {
        let hold = answers.hold(len as u64)?;
        Ok(Self { words: vec![0; len.div_ceil(8)], len, header, hold })
    }

    /// The header's room, its length prefix included, and everything behind it.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.len]
    }

    /// The header's room, its length prefix included.
    pub fn header_mut(&mut self) -> &mut [u8] {
        let header = self.header;
        &mut self.bytes_mut()[..header]
    }

    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.words)[..self.len]
    }

    /// Makes room behind and copies parts there, one after the other.
    pub(crate) fn append(
        &mut self,
        answers: &AnswerBudget,
        parts: &[&[u8]],
    ) -> Result<(), SessionError> {
        let mut start = self.len;
        let len = start + parts.iter().map(|part| part.len()).sum::<usize>();
        let more = answers.hold((len - start) as u64)?;
        self.hold.join(more);
        // Exactly: growing by half again would take memory that no budget knows of.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_what_the_budget_knows_of() {
        let answers = AnswerBudget::default();
        let mut buffer = ObservationBuffer::zeroed(&answers, 80_000, 16).unwrap();
        buffer.append(&answers, &[&[1; 5], &[2; 11]]).unwrap();
        assert_eq!(buffer.bytes().len(), 80_016);
        assert_eq!(buffer.words.capacity() * 8, 80_016);
        assert_eq!(buffer.bytes()[80_004..80_006], [1, 2]);
    }
}
