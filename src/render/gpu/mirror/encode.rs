//! Encoding of a cluster of Gaussians on the device.
//!
//! A cluster is a line of header, then structure-of-arrays blocks of 32 Gaussians. A line has 32
//! words (128 B, which a warp reads in one transaction), one word of each Gaussian of the block.
//! The words of a Gaussian are: mean (3 x f32), scale (3 x f32), opacity (f32), a quaternion in 64
//! bits, and colours as 16-bit fractions of the cluster's largest value, two per word. That is 60 B
//! per Gaussian at SH degree 1, and 0.5 B for the header of a full cluster.
//!
//! A cluster takes as many blocks as it has Gaussians for. Levels of detail have sections of a few
//! hundred Gaussians; if each cluster took the size of a full one of 256, they would take 81 B per
//! Gaussian instead of 63.
//!
//! The classes of a chunk that has some follow the blocks of each cluster, a byte for each
//! Gaussian. The header says how many lines after it they begin; 0 without classes.

use std::ops::Range;

use crate::gpu::layout::{GEOMETRY_WORDS, SOA_BLOCK};
use wildcity_scene::chunk::{CLUSTER, column};
use wildcity_scene::{Chunk, sh};

/// Bytes of a line.
pub(super) const LINE_BYTES: u64 = 4 * SOA_BLOCK as u64;

/// Base-2 logarithm of the opacity of a Gaussian that must never be visible. WGSL implementations
/// may assume that no number is infinite, so minus infinity is not uploaded.
const INVISIBLE: f32 = -1e30;

/// Most lines of a cluster: a header, 8 blocks of 33 lines at SH degree 3, and classes.
pub(super) const MAX_LINES: u32 =
    1 + (CLUSTER as u32 / SOA_BLOCK) * 33 + class_lines(CLUSTER) as u32;

/// Number of lines of each cluster of a chunk, in order.
pub(super) fn lines(chunk: &Chunk) -> impl Iterator<Item = u32> {
    let words = words(chunk.sh_degree());
    let counts = (0..chunk.len()).step_by(CLUSTER).map(|first| (chunk.len() - first).min(CLUSTER));
    let has_classes = chunk.classes().is_some();
    counts.map(move |count| {
        let of_classes = if has_classes { class_lines(count) } else { 0 };
        (1 + count.div_ceil(SOA_BLOCK as usize) * words + of_classes) as u32
    })
}

/// Lines of the classes of a cluster of `count` Gaussians.
const fn class_lines(count: usize) -> usize {
    count.div_ceil(LINE_BYTES as usize)
}

/// Words of a Gaussian of an SH degree.
fn words(sh_degree: u8) -> usize {
    GEOMETRY_WORDS as usize + (3 * sh::coefficients(sh_degree)).div_ceil(2)
}

/// Encodes cluster `index` of a chunk into its lines, which must be zero.
pub(super) fn encode(chunk: &Chunk, index: usize, lines: &mut [u32]) {
    const BLOCK: usize = SOA_BLOCK as usize;
    let values = 3 * sh::coefficients(chunk.sh_degree());
    let (header, blocks) = lines.split_at_mut(BLOCK);
    let first = index * CLUSTER;
    let count = (chunk.len() - first).min(CLUSTER);
    // The header: the scales of the colours (of the constant coefficients, and of all others), and
    // the number of Gaussians.
    let largest = |range: Range<usize>| {
        let of = |i| range.clone().map(move |c| chunk.value(first + i, column::SH + c).abs());
        // Fractions of a largest value of 0 would be NaN.
        (0..count).flat_map(of).fold(0.0, f32::max).max(f32::MIN_POSITIVE)
    };
    let scales = [largest(0..3), largest(3..values)];
    header[..2].copy_from_slice(&scales.map(f32::to_bits));
    header[2] = count as u32;
    if let Some(classes) = chunk.classes() {
        let lines = count.div_ceil(BLOCK) * words(chunk.sh_degree());
        header[3] = 1 + lines as u32;
        let words = &mut blocks[lines * BLOCK..];
        for (i, class) in classes[first..first + count].iter().enumerate() {
            words[i / 4] |= u32::from(class.value()) << (8 * (i % 4));
        }
    }
    let blocks = blocks.chunks_exact_mut(BLOCK * words(chunk.sh_degree()));
    for (index, words) in (0..count).step_by(BLOCK).zip(blocks) {
        for i in 0..(count - index).min(BLOCK) {
            let value = |column| chunk.value(first + index + i, column);
            let mut set = |word: usize, bits| words[BLOCK * word + i] = bits;
            for axis in 0..3 {
                set(axis, value(column::MEAN + axis).to_bits());
                set(3 + axis, value(column::SCALE + axis).to_bits());
            }
            set(6, value(column::LOG2_OPACITY).max(INVISIBLE).to_bits());
            let [low, high] = quat_bits([0, 1, 2, 3].map(|k| value(column::QUAT + k)));
            set(7, low);
            set(8, high);
            let fraction = |j: usize| {
                let fraction = value(column::SH + j) / scales[usize::from(j >= 3)];
                // Signed, in two's complement.
                (fraction * 32_767.0).round() as i16 as u16
            };
            for j in (0..values).step_by(2) {
                let low = u32::from(fraction(j));
                // At even degrees the number of values is odd.
                let high = if j + 1 < values { u32::from(fraction(j + 1)) } else { 0 };
                set(GEOMETRY_WORDS as usize + j / 2, low | high << 16);
            }
        }
    }
}

/// The index of a quaternion's largest component, and its sign: q and -q are the same rotation, so
/// that the device has the one whose largest component is positive.
pub(in crate::gpu) fn largest_component(wxyz: [f32; 4]) -> (usize, f32) {
    let mut index = 0;
    for k in 1..4 {
        if wxyz[k].abs() > wxyz[index].abs() {
            index = k;
        }
    }
    (index, wxyz[index].signum())
}

/// Encodes a unit quaternion in 62 bits: the index of the largest component, and the other three,
/// whose absolute values are at most √½, in 20 bits each.
///
/// Components are off by at most 7e-7: the end of a needle of 10,000 px moves by less than 0.01 px.
/// With 16 bits for each of the four components it would move by 0.2 px.
fn quat_bits(wxyz: [f32; 4]) -> [u32; 2] {
    let (index, sign) = largest_component(wxyz);
    let sign = f64::from(sign);
    let steps = |value: f32| {
        // √½ becomes 1, and -√½ becomes 0.
        let fraction = sign * f64::from(value) * std::f64::consts::SQRT_2 * 0.5 + 0.5;
        (fraction.clamp(0.0, 1.0) * 1_048_575.0).round() as u64
    };
    let small = (0..4).filter(|&k| k != index).map(|k| steps(wxyz[k]));
    let bits = small.enumerate().fold((index as u64) << 60, |bits, (k, s)| bits | s << (20 * k));
    [bits as u32, (bits >> 32) as u32]
}
