//! Orders of splats: of one macro tile by depth ([`sort_by_depth`]), and of all views by (view, depth, global id), which
//! is the output of stage sort for another backend.
//!
//! **A radix sort of 28-bit depths, from the lowest digit.** Splats are projected in order of (view, global id), so each
//! view has its own range of places already. Every pass keeps the order of equal digits, so equal depths keep the order of
//! ids. Keys are cut into segments that run in parallel; a prefix sum over (digit, segment) gives each segment its own
//! places, so the result does not depend on the schedule. Keys are written through relaxed atomics, which compile to plain
//! stores, so that no `unsafe` is needed.
//!
//! A depth key is the exact order of f32: the bits of positive floats rise with their values
//! ([`Cutoffs::sort_key`]). Depths are computed in f64 and rounded once, so that surfels of one plane are not
//! blended in the order of rounding errors (`project::pinhole::depth`).

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::project::{Projected, Unit};
use crate::constants::DEPTH_BITS;
use crate::layout::Cutoffs;

/// Bits of a digit: 1,024 counters of a segment and as many places to write to fit the first two levels of cache.
const DIGIT_BITS: u32 = DEPTH_BITS.div_ceil(PASSES);

/// An odd number, so that the last pass writes to [`Sorted::keys`].
const PASSES: u32 = 3;

const DIGITS: usize = 1 << DIGIT_BITS;

/// Keys of a segment, at least, unless its view has fewer: enough to outweigh its counters.
const SEGMENT: usize = 1 << 14;

/// The order of a frame's splats.
#[derive(Debug, Default)]
pub(super) struct Sorted {
    /// View after view, from the nearest: [`Cutoffs::sort_key`] (32 bits), then the place in the projection (32 bits).
    keys: Vec<AtomicU64>,
    /// The source of the first pass and the last; as many.
    other: Vec<AtomicU64>,
    /// Number of keys that belong to this frame; the rest is spare room.
    used: usize,
    segments: Vec<Segment>,
}

/// Consecutive keys of one view.
#[derive(Debug)]
struct Segment {
    view: usize,
    /// Its units in the projection.
    units: Range<usize>,
    /// Its keys.
    keys: Range<usize>,
    /// For each digit: first the number of keys, then the place of the next one.
    cursors: Box<[u32; DIGITS]>,
}

impl Sorted {
    /// Sorts all splats of a projection.
    pub(super) fn sort(&mut self, projected: &Projected, cutoffs: &Cutoffs) {
        self.used = projected.len();
        for buffer in [&mut self.keys, &mut self.other] {
            if buffer.len() < self.used {
                buffer.reserve_exact(self.used - buffer.len());
                buffer.resize_with(self.used, AtomicU64::default);
            }
        }
        self.cut(projected.units());

        // The unsorted keys.
        let other = &self.other;
        self.segments.par_iter().for_each(|Segment { units, keys, .. }| {
            let mut unsorted = other[keys.clone()].iter();
            for unit in &projected.units()[units.clone()] {
                for ((place, splat), key) in projected.unit(unit).zip(&mut unsorted) {
                    let sort_key = cutoffs.sort_key(unit.view, splat.depth_m);
                    key.store(u64::from(sort_key) << 32 | u64::from(place), Relaxed);
                }
            }
        });

        for pass in 0..PASSES {
            let (from, to) = match pass % 2 {
                0 => (&self.other, &self.keys),
                _ => (&self.keys, &self.other),
            };
            let shift = 32 + pass * DIGIT_BITS;
            let bits = DIGIT_BITS.min(DEPTH_BITS - pass * DIGIT_BITS);
            let digit = |key: u64| (key >> shift) as usize & ((1 << bits) - 1) & (DIGITS - 1);
            self.segments.par_iter_mut().for_each(|segment| segment.count(from, digit));
            allocate(&mut self.segments);
            self.segments.par_iter_mut().for_each(|segment| segment.scatter(from, to, digit));
        }
    }

    /// Places in the projection of all views' splats, in order.
    pub(super) fn places(&self) -> impl Iterator<Item = u32> {
        self.keys[..self.used].iter().map(|key| key.load(Relaxed) as u32)
    }

    /// Cuts the units of a projection into segments.
    fn cut(&mut self, units: &[Unit]) {
        let mut spare = std::mem::take(&mut self.segments).into_iter();
        let mut end = 0;
        for (index, unit) in units.iter().enumerate() {
            let start = end;
            end += unit.len;
            match self.segments.last_mut() {
                Some(last) if last.view == unit.view && last.keys.len() < SEGMENT => {
                    last.units.end = index + 1;
                    last.keys.end = end;
                }
                _ => {
                    let kept = spare.next().map(|segment| segment.cursors);
                    self.segments.push(Segment {
                        view: unit.view,
                        units: index..index + 1,
                        keys: start..end,
                        cursors: kept.unwrap_or_else(|| Box::new([0; DIGITS])),
                    });
                }
            }
        }
    }
}

/// Sorts keys with the depth in their upper half and an index, from 0 in this order, in the lower half. `other` is scratch
/// memory.
pub(super) fn sort_by_depth(keys: &mut Vec<u64>, other: &mut Vec<u64>) {
    // Below, counters cost more than comparisons.
    const FEW: usize = 256;
    if keys.len() < FEW {
        keys.sort_unstable();
        return;
    }
    // Three digits of the bits in which the depths differ.
    let first = keys[0];
    let differ = keys.iter().fold(0, |differ, key| differ | (key ^ first)) >> 32;
    let digit_bits = (u64::BITS - differ.leading_zeros()).div_ceil(PASSES).max(1);
    let digit = |key: u64, pass: u32| {
        (key >> (32 + pass * digit_bits)) as usize & ((1 << digit_bits) - 1) & (DIGITS - 1)
    };
    let mut cursors = [[0_u32; DIGITS]; PASSES as usize];
    for &key in &*keys {
        for (cursors, pass) in cursors.iter_mut().zip(0..) {
            cursors[digit(key, pass)] += 1;
        }
    }
    other.resize(keys.len(), 0);
    for (cursors, pass) in cursors.iter_mut().zip(0..) {
        let mut end = 0;
        for cursor in &mut cursors[..1 << digit_bits] {
            let start = end;
            end += *cursor;
            *cursor = start;
        }
        for &key in &*keys {
            let cursor = &mut cursors[digit(key, pass)];
            other[*cursor as usize] = key;
            *cursor += 1;
        }
        std::mem::swap(keys, other);
    }
}

impl Segment {
    /// Counts the keys of each digit.
    fn count(&mut self, from: &[AtomicU64], digit: impl Fn(u64) -> usize) {
        self.cursors.fill(0);
        for key in &from[self.keys.clone()] {
            self.cursors[digit(key.load(Relaxed))] += 1;
        }
    }

    /// Writes the keys to the places that the cursors give.
    fn scatter(&mut self, from: &[AtomicU64], to: &[AtomicU64], digit: impl Fn(u64) -> usize) {
        for key in &from[self.keys.clone()] {
            let key = key.load(Relaxed);
            let cursor = &mut self.cursors[digit(key)];
            to[*cursor as usize].store(key, Relaxed);
            *cursor += 1;
        }
    }
}

/// Turns counts into places by an exclusive prefix sum: view by view, within a view digit by digit, and within a digit
/// segment by segment.
fn allocate(segments: &mut [Segment]) {
    for of_view in segments.chunk_by_mut(|a, b| a.view == b.view) {
        let mut next = of_view[0].keys.start as u32;
        for digit in 0..DIGITS {
            for segment in &mut *of_view {
                let count = segment.cursors[digit];
                segment.cursors[digit] = next;
                next += count;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of depths that differ in no bit, in few and in all, in lists on both sides of the change of method.
    #[test]
    fn keys_are_sorted_by_depth_and_then_by_index() {
        let mut state = 1_u64;
        for count in [0, 1, 255, 256, 1_000, 40_000] {
            for depth_bits in [0, 1, 2, 11, 27, DEPTH_BITS] {
                let mut keys: Vec<u64> = (0..count)
                    .map(|index| {
                        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                        ((state >> 33) & ((1 << depth_bits) - 1)) << 32 | index
                    })
                    .collect();
                let mut sorted = keys.clone();
                sorted.sort_unstable();
                sort_by_depth(&mut keys, &mut vec![7; 3]);
                assert!(keys == sorted, "{count} keys of {depth_bits} bits");
            }
        }
    }
}
