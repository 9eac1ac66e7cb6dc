//! The memory of an answer that is gone, for the next one. New memory is zeroed, which takes 0.1 ms per 3 MB, and the renderer
//! writes every byte of it again.

use std::fmt;

use parking_lot::Mutex;

use crate::limits;

/// One block of memory, at most [`limits::SPARE_ANSWER_BYTES`]. The budget for answers does not count it.
#[derive(Default)]
pub(crate) struct SpareMemory(Mutex<Vec<u64>>);

impl SpareMemory {
    /// `count` words of any values: the spare ones if they are enough and not more than twice as many.
    pub(crate) fn take(&self, count: usize) -> Vec<u64> {
        let mut spare = self.0.lock();
        if !(count..=2 * count).contains(&spare.capacity()) {
            return vec![0; count];
        }
        let mut words = std::mem::take(&mut *spare);
        drop(spare);
        words.resize(count, 0);
        words
    }

    /// Keeps the words of an answer that is gone, unless those that are kept already are more.
    pub(crate) fn recycle(&self, mut words: Vec<u64>) {
        if words.capacity() * size_of::<u64>() <= limits::SPARE_ANSWER_BYTES {
            let mut spare = self.0.lock();
            if words.capacity() > spare.capacity() {
                std::mem::swap(&mut *spare, &mut words);
            }
        }
    }
}

impl fmt::Debug for SpareMemory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("SpareMemory").field(&self.0.lock().capacity()).finish()
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
        assert_eq!([1000, 1000, 500, 1000].map(next), [false, true, true, true]);
        // One of another size does not replace it, and a larger one does.
        assert_eq!([499, 1000, 1001, 1001].map(next), [false, true, false, true]);
        let too_large = limits::SPARE_ANSWER_BYTES / size_of::<u64>() + 1;
        assert_eq!([too_large, too_large, 1001].map(next), [false, false, true]);
    }

    #[test]
    fn two_at_once_do_not_share_it() {
        let spare = SpareMemory::default();
        spare.recycle(vec![9; 1000]);
        let [first, second] = [spare.take(1000), spare.take(1000)];
        assert_eq!([first, second], [vec![9; 1000], vec![0; 1000]]);
    }
}
