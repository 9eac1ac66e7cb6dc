//! Decoding of the values of one field, a few lane groups at a time.
//!
//! A part is decoded tile by tile and not field by field: a tile of all columns stays in the cache
//! of a core, whereas the columns of a whole part are 6 MB at degree 1, and every column touches
//! each of its pages.
//!
//! The loops are compiled for each instruction set. This requires that the closures of quantised
//! fields are inlined: with AVX-512, a Q32 part takes 11 ns per Gaussian instead of 18.

use std::f32::consts::SQRT_2;
use std::ops::Range;

use half::f16;

use super::codec::{Code, Grid, Measure};
use crate::chunk::LANES;

/// One field of a part, ready to be decoded.
#[derive(Debug)]
pub(super) struct FieldDecoder<'a> {
    code: Code,
    measure: Measure,
    /// The stored columns. All have `count` values.
    columns: Vec<StoredColumn<'a>>,
    /// Grid of quantised fields.
    grid: Option<Grid>,
    /// The value of each code, where that is cheaper than to compute it for each Gaussian; else
    /// empty.
    table: Vec<f32>,
}

/// The byte planes of one stored column, the lowest bytes first.
#[derive(Clone, Copy, Debug)]
struct StoredColumn<'a> {
    planes: &'a [u8],
    count: usize,
}

impl<'a> FieldDecoder<'a> {
    /// `grid` and `planes` are the field's own bytes: [`Code::grid_bytes`], and `count` times the
    /// sum of [`Code::planes`].
    pub(super) fn new(
        code: Code,
        measure: Measure,
        columns: usize,
        [grid, mut planes]: [&'a [u8]; 2],
        count: usize,
    ) -> Self {
        // The planes of a column follow each other; splitting them off in order gives each column
        // its own.
        let split = code.planes(columns).into_iter().map(|bytes| {
            let (own, rest) = planes.split_at(bytes * count);
            planes = rest;
            StoredColumn { planes: own, count }
        });
        let stored = split.collect();
        let grid = matches!(code, Code::Steps(_) | Code::Binary(_)).then(|| Grid::read(grid));
        let curved = matches!(measure, Measure::Logarithm | Measure::Opacity);
        let table = match (code, grid) {
            // With more values than codes, the same transcendental would be computed repeatedly.
            (Code::Steps(bits), Some(grid)) if curved && columns * count > 1 << bits => {
                (0..1 << bits).map(|code| measure.value(grid.at(code))).collect()
            }
            _ => Vec::new(),
        };
        Self { code, measure, columns: stored, grid, table }
    }

    /// Passes the values of some lane groups to `put`: index of the lane group, column within the
    /// field, values. Lanes after the last Gaussian hold unspecified values.
    #[inline(always)]
    pub(super) fn decode(
        &self,
        groups: Range<usize>,
        mut put: impl FnMut(usize, usize, [f32; LANES]),
    ) {
        let measure = self.measure;
        match (self.code, self.grid) {
            (Code::Float, _) => {
                self.each::<4>(groups, |group, column, codes| {
                    put(group, column, map_lanes(codes, f32::from_bits));
                });
            }
            (Code::Half, _) => {
                let half = |code| measure.value(f16::from_bits(code as u16).to_f32());
                self.each::<2>(groups, |group, column, codes| {
                    put(group, column, map_lanes(codes, half));
                });
            }
            (Code::Rotation(bits), _) => {
                let [a, b, c] = [0, 1, 2].map(|k: usize| self.columns[k]);
                for group in groups {
                    // The number of bytes is a constant in each arm, so that the loads are
                    // unrolled.
                    let codes = match bits {
                        // The index of the largest component makes the first code two bits longer.
                        ..=6 => [a.codes::<1>(group), b.codes::<1>(group), c.codes::<1>(group)],
                        7..=8 => [a.codes::<2>(group), b.codes::<1>(group), c.codes::<1>(group)],
                        _ => [a.codes::<2>(group), b.codes::<2>(group), c.codes::<2>(group)],
                    };
                    for (column, values) in from_smallest_three(codes, bits).into_iter().enumerate()
                    {
                        put(group, column, values);
                    }
                }
            }
            (Code::Steps(bits) | Code::Binary(bits), Some(grid)) => match bits.div_ceil(8) {
                1 => self.quantised::<1>(groups, grid, put),
                2 => self.quantised::<2>(groups, grid, put),
                _ => self.quantised::<3>(groups, grid, put),
            },
            (Code::Steps(_) | Code::Binary(_), None) => {
                unreachable!("quantised fields have a grid")
            }
        }
    }

    /// Passes the values of a quantised field to `put`.
    #[inline(always)]
    fn quantised<const BYTES: usize>(
        &self,
        groups: Range<usize>,
        grid: Grid,
        mut put: impl FnMut(usize, usize, [f32; LANES]),
    ) {
        // The table has 2^bits entries; the mask spares the bounds check.
        let all = self.table.len().saturating_sub(1);
        self.each::<BYTES>(
            groups,
            #[inline(always)]
            |group, column, codes| {
                let values = if self.table.is_empty() {
                    map_lanes(
                        codes,
                        #[inline(always)]
                        |code| self.measure.value(grid.at(code)),
                    )
                } else {
                    map_lanes(
                        codes,
                        #[inline(always)]
                        |code| self.table[code as usize & all],
                    )
                };
                put(group, column, values);
            },
        );
    }

    /// Passes the codes of some lane groups to `each`, column by column.
    #[inline(always)]
    fn each<const BYTES: usize>(
        &self,
        groups: Range<usize>,
        mut each: impl FnMut(usize, usize, [u32; LANES]),
    ) {
        for (index, column) in self.columns.iter().enumerate() {
            for group in groups.clone() {
                each(group, index, column.codes::<BYTES>(group));
            }
        }
    }
}

impl StoredColumn<'_> {
    /// The codes of a lane group, padded with zeros.
    #[inline(always)]
    fn codes<const BYTES: usize>(self, group: usize) -> [u32; LANES] {
        let start = group * LANES;
        let end = self.count.min(start + LANES);
        let mut codes = [0; LANES];
        for byte in 0..BYTES {
            let own = &self.planes[byte * self.count..][start..end];
            // A slice of a fixed length, so that the compiler makes one load of it.
            let mut lanes = [0; LANES];
            match <&[u8; LANES]>::try_from(own) {
                Ok(own) => lanes = *own,
                Err(_) => lanes[..own.len()].copy_from_slice(own),
            }
            for (code, lane) in codes.iter_mut().zip(lanes) {
                *code |= u32::from(lane) << (8 * byte);
            }
        }
        codes
    }
}

/// The value of each code. `map` of an array of 16 remains a call, and moves the array through
/// memory.
#[inline(always)]
fn map_lanes(codes: [u32; LANES], value: impl Fn(u32) -> f32) -> [f32; LANES] {
    let mut values = [0.0; LANES];
    for (to, code) in values.iter_mut().zip(codes) {
        *to = value(code);
    }
    values
}

/// Quaternions (w, x, y, z) of `smallest_three` codes.
#[inline(always)]
fn from_smallest_three(codes: [[u32; LANES]; 3], bits: u32) -> [[f32; LANES]; 4] {
    let half = ((1_u32 << (bits - 1)) - 1) as f32;
    let step = 1.0 / (SQRT_2 * half);
    let mut quats = [[0.0; LANES]; 4];
    for lane in 0..LANES {
        let largest = codes[0][lane] >> bits & 3;
        let first = codes[0][lane] & ((1 << bits) - 1);
        let [a, b, c] =
            [first, codes[1][lane], codes[2][lane]].map(|code| (code as f32 - half) * step);
        // The largest follows from the unit length. Rounding may make the sum of the others exceed
        // 1 by a little.
        let d = (1.0 - a * a - b * b - c * c).max(0.0).sqrt();
        // Selections and not branches, so that all lanes are computed at once.
        quats[0][lane] = if largest == 0 { d } else { a };
        quats[1][lane] = match largest {
            0 => a,
            1 => d,
            _ => b,
        };
        quats[2][lane] = match largest {
            0 | 1 => b,
            2 => d,
            _ => c,
        };
        quats[3][lane] = if largest == 3 { d } else { c };
    }
    quats
}
