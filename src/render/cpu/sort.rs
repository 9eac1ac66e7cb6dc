//! The order of a macro tile's splats: a radix sort of 28-bit depths, from the lowest digit.
//!
//! Every pass keeps the order of equal digits, so splats of equal depth keep the order of their
//! global ids.
//!
//! A depth key is the exact order of f32: the bits of positive floats rise with their values
//! ([`Cutoffs::sort_key`]). Depths are computed in f64 and rounded once, so that surfels of one
//! plane are not blended in the order of rounding errors (`project::pinhole::depth`).
//!
//! [`Cutoffs::sort_key`]: crate::layout::Cutoffs::sort_key

use crate::constants::DEPTH_BITS;

/// Bits of a digit: the 1,024 counters, and as many places to write to, fit the first two levels of
/// cache.
const DIGIT_BITS: u32 = DEPTH_BITS.div_ceil(PASSES);

/// Digits of a depth.
const PASSES: u32 = 3;

const DIGITS: usize = 1 << DIGIT_BITS;

/// Sorts keys with the depth in their upper half and an index, from 0 in this order, in the lower
/// half. `other` is scratch memory.
pub(super) fn sort_by_depth(keys: &mut Vec<u64>, other: &mut Vec<u64>) {
    // For fewer keys, counters cost more than comparisons.
    const FEW: usize = 256;
    if keys.len() < FEW {
        keys.sort_unstable();
        return;
    }
    // Three digits of the bits in which the depths differ.
    let first = keys[0];
    // Bits in which no key differs need no pass; neighbouring depths share their high bits.
    let differ = keys.iter().fold(0, |differ, key| differ | (key ^ first)) >> 32;
    let digit_bits = (u64::BITS - differ.leading_zeros()).div_ceil(PASSES).max(1);
    let digit = |key: u64, pass: u32| {
        // The second mask changes nothing, as a digit has at most 10 bits, and saves the
        // test of the bound.
        (key >> (32 + pass * digit_bits)) as usize & ((1 << digit_bits) - 1) & (DIGITS - 1)
    };
    // The counts of all three digits in one pass over the keys: 12 kB.
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
        // In order, and each to the next place of its digit: the pass is stable.
        for &key in &*keys {
            let cursor = &mut cursors[digit(key, pass)];
            other[*cursor as usize] = key;
            *cursor += 1;
        }
        // After an odd number of passes, too, the caller's `keys` has the result.
        std::mem::swap(keys, other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sorts depths that differ in no bit, in few and in all, in lists on both sides of the change
    /// of method.
    #[test]
    fn keys_are_sorted_by_depth_and_then_by_index() {
        // A linear congruential generator with the factor of Knuth's MMIX; its high bits are the
        // random ones.
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
