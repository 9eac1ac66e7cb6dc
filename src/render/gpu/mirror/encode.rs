//! What a cluster of Gaussians is on the device.
//!
//! A line of header, and then strips of 32 Gaussians, word after word, 32 side by side: mean and scale
//! (f32 x 3 each), opacity (f32), a quaternion in 64 bits, and colour as two 16-bit fractions per word
//! of the cluster's largest value: 60 B per Gaussian at degree 1, and 0.5 B of header in a full
//! cluster. A line is 32 words, what a warp reads at once.

use std::ops::Range;

use crate::gpu::layout::{GEOMETRY_WORDS, STRIP};
use wildcity_scene::chunk::{CLUSTER, column};
use wildcity_scene::{Chunk, sh};

/// Bytes of a line.
pub(super) const LINE_BYTES: u64 = 4 * STRIP as u64;

/// Opacity of what must never be seen, as a base-2 logarithm. WGSL may assume that no number is
/// infinite, so minus infinity does not travel.
const INVISIBLE: f32 = -1e30;

/// Most lines of a cluster: a header, and 8 strips of 33 words at SH degree 3.
pub(super) const MOST_LINES: u32 = 1 + (CLUSTER as u32 / STRIP) * 33;

/// Lines of each cluster of a chunk, in order.
pub(super) fn lines(chunk: &Chunk) -> impl Iterator<Item = u32> {
    let words = words(chunk.sh_degree());
    let counts = (0..chunk.len()).step_by(CLUSTER).map(|first| (chunk.len() - first).min(CLUSTER));
    counts.map(move |count| 1 + (count.div_ceil(STRIP as usize) * words) as u32)
}

/// Words of a Gaussian of a degree.
fn words(sh_degree: u8) -> usize {
    GEOMETRY_WORDS as usize + (3 * sh::coefficients(sh_degree)).div_ceil(2)
}

/// Encodes cluster `index` of a chunk into its lines, which are zero.
pub(super) fn encode(chunk: &Chunk, index: usize, lines: &mut [u32]) {
    const STRIP_WORDS: usize = STRIP as usize;
    let values = 3 * sh::coefficients(chunk.sh_degree());
    let (header, strips) = lines.split_at_mut(STRIP_WORDS);
    let first = index * CLUSTER;
    let count = (chunk.len() - first).min(CLUSTER);
    let largest = |range: Range<usize>| {
        let of = |i| range.clone().map(move |c| chunk.value(first + i, column::SH + c).abs());
        (0..count).flat_map(of).fold(0.0, f32::max).max(f32::MIN_POSITIVE)
    };
    let scales = [largest(0..3), largest(3..values)];
    header[..2].copy_from_slice(&scales.map(f32::to_bits));
    header[2] = count as u32;
    let strips = strips.chunks_exact_mut(STRIP_WORDS * words(chunk.sh_degree()));
    for (index, words) in (0..count).step_by(STRIP_WORDS).zip(strips) {
        for i in 0..(count - index).min(STRIP_WORDS) {
            let value = |column| chunk.value(first + index + i, column);
            let mut set = |word: usize, bits| words[STRIP_WORDS * word + i] = bits;
            for axis in 0..3 {
                set(axis, value(column::MEAN + axis).to_bits());
                set(3 + axis, value(column::SCALE + axis).to_bits());
            }
            set(6, value(column::LOG2_OPACITY).max(INVISIBLE).to_bits());
            let [low, high] = quat_bits([0, 1, 2, 3].map(|k| value(column::QUAT + k)));
            set(7, low);
            set(8, high);
            let fraction = |j: usize| {
                let share = value(column::SH + j) / scales[usize::from(j >= 3)];
                (share * 32_767.0).round() as i16 as u16
            };
            for j in (0..values).step_by(2) {
                let low = u32::from(fraction(j));
                let high = if j + 1 < values { u32::from(fraction(j + 1)) } else { 0 };
                set(GEOMETRY_WORDS as usize + j / 2, low | high << 16);
            }
        }
    }
}

/// A unit quaternion in 62 bits: which component is the largest, and the other three, at most √½,
/// in 20 bits each. Off by at most 7e-7: a needle of 10,000 px moves by less than 0.01 px. (With
/// 16 bits for each of four it would move by 0.2 px.)
fn quat_bits(wxyz: [f32; 4]) -> [u32; 2] {
    let mut index = 0;
    for k in 1..4 {
        if wxyz[k].abs() > wxyz[index].abs() {
            index = k;
        }
    }
    // q and -q are one rotation, so the largest can be made positive.
    let sign = f64::from(wxyz[index].signum());
    let steps = |value: f32| {
        let share = sign * f64::from(value) * std::f64::consts::SQRT_2 * 0.5 + 0.5;
        (share.clamp(0.0, 1.0) * 1_048_575.0).round() as u64
    };
    let small = (0..4).filter(|&k| k != index).map(|k| steps(wxyz[k]));
    let bits = small.enumerate().fold((index as u64) << 60, |bits, (k, s)| bits | s << (20 * k));
    [bits as u32, (bits >> 32) as u32]
}
