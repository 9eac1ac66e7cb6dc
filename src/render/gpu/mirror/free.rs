//! Which lines of a page are free.

use std::ops::Range;

/// Free lines as ranges, rising; no two adjoin.
#[derive(Debug)]
pub(super) struct Free(Vec<Range<u32>>);

impl Free {
    /// All of a page.
    pub(super) fn all(lines: u32) -> Self {
        let mut free = Self(Vec::new());
        free.give_back(0..lines);
        free
    }

    /// Takes so many consecutive lines, the first that there are.
    pub(super) fn take(&mut self, lines: u32) -> Option<Range<u32>> {
        let index = self.0.iter().position(|range| range.end - range.start >= lines)?;
        let range = &mut self.0[index];
        let taken = range.start..range.start + lines;
        range.start = taken.end;
        if range.start == range.end {
            self.0.remove(index);
        }
        Some(taken)
    }

    /// Gives lines back that were taken.
    pub(super) fn give_back(&mut self, lines: Range<u32>) {
        let place = self.0.partition_point(|free| free.start < lines.start);
        self.0.insert(place, lines);
        // It may adjoin the one after it, and then the one before it.
        for second in [place + 1, place] {
            if let [.., before, next] = self.0.get_mut(..=second).unwrap_or_default()
                && before.end == next.start
            {
                before.end = next.end;
                self.0.remove(second);
            }
        }
    }

    /// Whether all of a page of so many lines is free.
    pub(super) fn is_all(&self, lines: u32) -> bool {
        self.0.first() == Some(&(0..lines))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_given_out_once_and_adjoin_again_in_whatever_order_they_come_back() {
        let mut random = 9_u32;
        let mut next = |below: usize| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 8) as usize % below
        };
        let mut free = Free::all(1_000);
        let mut taken: Vec<Range<u32>> = Vec::new();
        for _ in 0..5_000 {
            if next(2) == 0 {
                let wanted = 1 + next(60) as u32;
                if let Some(range) = free.take(wanted) {
                    assert_eq!(range.len(), wanted as usize);
                    let apart =
                        |other: &Range<u32>| range.end <= other.start || other.end <= range.start;
                    assert!(range.end <= 1_000 && taken.iter().all(apart), "{range:?} {taken:?}");
                    taken.push(range);
                }
            } else if !taken.is_empty() {
                free.give_back(taken.swap_remove(next(taken.len())));
            }
            let ranges = &free.0;
            assert!(ranges.is_sorted_by(|a, b| a.end < b.start), "{ranges:?}");
            let lines: usize = ranges.iter().chain(&taken).map(ExactSizeIterator::len).sum();
            assert_eq!(lines, 1_000);
            assert_eq!(free.is_all(1_000), taken.is_empty());
        }
        for range in taken {
            free.give_back(range);
        }
        assert!(free.is_all(1_000));
        assert_eq!(free.take(1_001), None);
    }
}
