//! Allocation of a page's lines: first fit, with free neighbours merged.

use std::ops::Range;

/// The free lines of a page as ranges in increasing order, of which no two are adjacent.
#[derive(Debug)]
pub(super) struct FreeLines(Vec<Range<u32>>);

impl FreeLines {
    /// All lines of a page.
    pub(super) fn all(lines: u32) -> Self {
        let mut free = Self(Vec::new());
        free.free(0..lines);
        free
    }

    /// Allocates the first free range of consecutive lines; `None` if no range has that length.
    pub(super) fn allocate(&mut self, lines: u32) -> Option<Range<u32>> {
        let index = self.0.iter().position(|range| range.end - range.start >= lines)?;
        let range = &mut self.0[index];
        let allocated = range.start..range.start + lines;
        range.start = allocated.end;
        if range.start == range.end {
            self.0.remove(index);
        }
        Some(allocated)
    }

    /// Frees lines that were allocated.
    pub(super) fn free(&mut self, lines: Range<u32>) {
        let index = self.0.partition_point(|free| free.start < lines.start);
        self.0.insert(index, lines);
        // Merge it with the range after it, then with the range before it, if they are adjacent.
        for second in [index + 1, index] {
            if let [.., before, next] = self.0.get_mut(..=second).unwrap_or_default()
                && before.end == next.start
            {
                before.end = next.end;
                self.0.remove(second);
            }
        }
    }

    /// Whether all lines of a page with `lines` lines are free.
    pub(super) fn is_all(&self, lines: u32) -> bool {
        self.0.first() == Some(&(0..lines))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_allocated_once_and_merge_in_whatever_order_they_are_freed() {
        let mut random = 9_u32;
        let mut next = |below: usize| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 8) as usize % below
        };
        let mut free = FreeLines::all(1_000);
        let mut allocated: Vec<Range<u32>> = Vec::new();
        for _ in 0..5_000 {
            if next(2) == 0 {
                let wanted = 1 + next(60) as u32;
                if let Some(range) = free.allocate(wanted) {
                    assert_eq!(range.len(), wanted as usize);
                    let apart =
                        |other: &Range<u32>| range.end <= other.start || other.end <= range.start;
                    assert!(
                        range.end <= 1_000 && allocated.iter().all(apart),
                        "{range:?} {allocated:?}"
                    );
                    allocated.push(range);
                }
            } else if !allocated.is_empty() {
                free.free(allocated.swap_remove(next(allocated.len())));
            }
            let ranges = &free.0;
            assert!(ranges.is_sorted_by(|a, b| a.end < b.start), "{ranges:?}");
            let lines: usize = ranges.iter().chain(&allocated).map(ExactSizeIterator::len).sum();
            assert_eq!(lines, 1_000);
            assert_eq!(free.is_all(1_000), allocated.is_empty());
        }
        for range in allocated {
            free.free(range);
        }
        assert!(free.is_all(1_000));
        assert_eq!(free.allocate(1_001), None);
    }
}
