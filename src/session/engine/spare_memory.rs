//! Memory of a dropped answer, kept for the next one. New memory is zeroed, which takes 0.1 ms per
//! 3 MB, although the renderer then overwrites every byte.

use std::fmt;

use parking_lot::Mutex;

use crate::limits;

/// One block of memory, at most [`limits::SPARE_ANSWER_BYTES`]. The budget for answers does not
/// count it.
#[derive(Default)]
pub(crate) struct SpareMemory(Mutex<Spare>);

#[derive(Default)]
struct Spare {
    words: Vec<u64>,
    /// Whether it did not fit when it was asked for.
    is_unfit: bool,
}

impl SpareMemory {
    /// Returns `count` words with any values: the spare ones if they are at least `count` and at
    /// most twice as many.
    pub(crate) fn take(&self, count: usize) -> Vec<u64> {
        let mut spare = self.0.lock();
        // An answer of less than half its size would hold memory that the budget has to count for
        // nothing.
        if !(count..=2 * count).contains(&spare.words.capacity()) {
            spare.is_unfit = true;
            return vec![0; count];
        }
        let mut words = std::mem::take(&mut spare.words);
        // `resize` may write zeros, which other sessions do not wait for.
        drop(spare);
        words.resize(count, 0);
        words
    }

    /// Keeps the words of a dropped answer. Of these and the words that are kept already, the
    /// larger block stays, unless the kept block was too small or too large for a request since.
    pub(crate) fn recycle(&self, mut words: Vec<u64>) {
        if words.capacity() * size_of::<u64>() <= limits::SPARE_ANSWER_BYTES {
            let mut spare = self.0.lock();
            if spare.is_unfit || words.capacity() > spare.words.capacity() {
                // What is replaced is freed at the end of the function, without the lock.
                std::mem::swap(&mut spare.words, &mut words);
                spare.is_unfit = false;
            }
        }
    }
}

impl fmt::Debug for SpareMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("SpareMemory").field(&self.0.lock().words.capacity()).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_serves_the_next_of_about_its_size() {
        let spare = SpareMemory::default();
        // Takes words, fills them, and gives them back. Whether they were the spare ones.
        let next = |count: usize| {
            let mut words = spare.take(count);
            assert_eq!(words.len(), count);
            let was_spare = words.contains(&9);
            words.fill(9);
            spare.recycle(words);
            was_spare
        };
        // A block of 1000 serves 500: it is not more than twice as large.
        assert_eq!([1000, 1000, 500, 1000].map(next), [false, true, true, true]);
        // Blocks that do not fit are replaced, even by smaller ones.
        assert_eq!([1001, 1001, 499, 499].map(next), [false, true, false, true]);
        let too_large = limits::SPARE_ANSWER_BYTES / size_of::<u64>() + 1;
        assert_eq!([too_large, too_large, 499].map(next), [false, false, true]);
    }

    #[test]
    fn two_at_once_do_not_share_it() {
        let spare = SpareMemory::default();
        spare.recycle(vec![9; 1000]);
        let first = spare.take(1000);
        let second = spare.take(1000);
        assert_eq!([&first[..], &second], [[9; 1000], [0; 1000]]);
        // The larger of two returned blocks is kept.
        let spare = SpareMemory::default();
        spare.recycle(first);
        spare.recycle(vec![7; 10]);
        assert_eq!(spare.take(1000), [9; 1000]);
    }
}
