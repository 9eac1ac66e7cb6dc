//! Sums over the macro tiles of each splat.

use std::ops::Range;

use rayon::prelude::*;

use super::Bins;
use crate::cpu::project::Projected;
use crate::gradient::{Partial, partial};

/// The sums of the splats of one segment, by their places.
pub(in crate::cpu) struct SegmentSums {
    first_place: usize,
    sums: Vec<Partial>,
}

impl SegmentSums {
    /// The sums of consecutive splats.
    pub(in crate::cpu) fn splats(&self, first_place: usize, len: usize) -> &[Partial] {
        let first = first_place - self.first_place;
        &self.sums[first..first + len]
    }
}

impl Bins {
    /// Adds up what the macro tiles of a view gave for each of their pairs, splat by splat, and
    /// hands the sums of each segment to `work`, with the numbers of its units. Results are in the
    /// order of the segments.
    ///
    /// Segments run in parallel. Each adds its macro tiles in order, so that no sum depends on the
    /// schedule.
    pub(in crate::cpu) fn gather<R: Send>(
        &self,
        view: usize,
        projected: &Projected,
        by_macro_tile: &[Vec<Partial>],
        work: impl Fn(Range<usize>, &SegmentSums) -> R + Sync,
    ) -> Vec<R> {
        let segments = self.view_segments(view);
        // Where each segment's pairs begin in each macro tile.
        let mut firsts = Vec::with_capacity(segments.len());
        let mut first = vec![0; by_macro_tile.len()];
        for segment in segments {
            firsts.push(first.clone());
            for (number, first) in first.iter_mut().enumerate() {
                // The pairs of a macro tile lie segment after segment.
                *first += segment.macro_tile(number).len();
            }
        }
        let sum = |(segment, firsts): (&super::Segment, Vec<usize>)| {
            let places = projected.places_between(segment.units.clone());
            let mut sums = vec![[0.0; partial::COUNT]; places.len()];
            for (number, first) in firsts.into_iter().enumerate() {
                let pairs = segment.macro_tile(number);
                for (pair, values) in pairs.iter().zip(&by_macro_tile[number][first..]) {
                    let sum = &mut sums[pair.place as usize - places.start];
                    for (sum, value) in sum.iter_mut().zip(values) {
                        *sum += value;
                    }
                }
            }
            work(segment.units.clone(), &SegmentSums { first_place: places.start, sums })
        };
        segments.par_iter().zip(firsts).with_max_len(1).map(sum).collect()
    }
}
