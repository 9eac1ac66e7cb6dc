//! Record formats: how the fields of a Gaussian are encoded for storage.
//!
//! A record format is a table of fields: which columns, how many bits, and on which scale. One
//! codec processes the table. A part of a section, up to [`PART_GAUSSIANS`] Gaussians, begins with
//! the grids of its quantised fields (index of the first step as i32 and the step as f32,
//! little-endian, in the order of the table). Byte planes follow: for each column, first the lowest
//! byte of all values, then the next. Slowly changing bytes end up side by side, where zstd
//! compresses them. No two values share a byte, so decoding needs no shifts: the 32 bytes of a Q32
//! record become 47 whole bytes, of which 19 remain on disk, since zstd finds the empty high bits.
//!
//! Ranges are those of the part's own values. Every grid consists of multiples of its step, so zero
//! is always on it: grey colours, colours that do not depend on the direction, and surfaces flat on
//! the ground keep these properties exactly. The steps of means are powers of two, so that
//! neighbouring blocks share their grid. Opacity is stored linearly and not as a logarithm, because
//! alpha is linear in it. SH coefficients are stored as signed square roots, so that one
//! coefficient of 3 does not reduce the resolution of a thousand near 0.

mod codec;
mod decoder;
mod round_trip;

use std::ops::Range;

use fearless_simd::{Level, dispatch, prelude::*};
use serde::{Deserialize, Serialize};

use super::chunk::{Chunk, LANES, Lanes, column, columns};
use super::pages::LanePages;
use super::sh;

use codec::{Code, Measure};
use decoder::FieldDecoder;

pub use round_trip::{RoundTrip, round_trip};

/// Largest number of Gaussians that share ranges, a multiple of a cluster. Before compression,
/// 65,536 Gaussians at degree 3 are 7.9 MB as Q32 and 15 MB as F32.
pub const PART_GAUSSIANS: usize = 1 << 16;

/// Lane groups that are decoded at a time: 47 kB at degree 1 and 121 kB at degree 3, within the
/// second-level cache.
const TILE_GROUPS: usize = 32;

/// How the Gaussians of a twin are encoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RecordFormat {
    /// The activated f32 values that the renderer reads, without loss: 92 bytes at degree 1.
    F32,
    /// Means in f32, everything else in f16: 52 bytes at degree 1.
    H52,
    /// 32 bytes at degree 1.
    #[default]
    Q32,
    /// 24 bytes at degree 1.
    Q24,
}

/// One field: consecutive columns of a chunk that are encoded alike.
#[derive(Clone, Copy, Debug)]
struct Field {
    name: &'static str,
    column: usize,
    columns: usize,
    measure: Measure,
    code: Code,
}

/// Numbers of values per field that were out of range and clamped.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Clamped(Vec<(&'static str, u64)>);

impl RecordFormat {
    /// All formats, the most exact first.
    pub const ALL: [Self; 4] = [Self::F32, Self::H52, Self::Q32, Self::Q24];

    /// The name in options and manifests.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::H52 => "h52",
            Self::Q32 => "q32",
            Self::Q24 => "q24",
        }
    }

    /// The table of fields. The last four columns are the bits per Gaussian at degrees 0 to 3:
    ///
    /// | | centre | rotation | scale | opacity | DC | SH1 | SH2 | SH3 | 0 | 1 | 2 | 3 |
    /// |---|---|---|---|---|---|---|---|---|---|---|---|---|
    /// | F32 | 3x32 | 4x32 | 3x32 | 32 | 3x32 | 9x32 | 15x32 | 21x32 | 448 | 736 | 1216 | 1888 |
    /// | H52 | 3x32 | 4x16 | 3x16 | 16 | 3x16 | 9x16 | 15x16 | 21x16 | 272 | 416 | 656 | 992 |
    /// | Q32 | 3x23 | 2+3x10 | 3x10 | 10 | 3x11 | 9x9 | 15x8 | 21x8 | 174 | 255 | 375 | 543 |
    /// | Q24 | 3x20 | 2+3x8 | 3x8 | 7 | 3x7 | 9x6 | 15x5 | 21x5 | 138 | 192 | 267 | 372 |
    ///
    /// Bits are spent where they affect an image most: each field by itself has 60 dB or more.
    /// Means get the most, since the first visible artefact are surfels of one plane that change
    /// their order in depth: with 20 bits (15 µm) instead of 23, the demo street had 61 dB, all of
    /// it from surfels of one facade. The three more bits per axis are taken from the colour. A
    /// record has no bits for a level of detail or for flags, since both are those of its section.
    fn fields(self, sh_degree: u8) -> Vec<Field> {
        let ([x, y, z], scale, quat, opacity, dc, bands) = match self {
            Self::F32 => (
                [Code::Float; 3],
                Code::Float,
                Code::Float,
                Code::Float,
                Code::Float,
                [Code::Float; 3],
            ),
            Self::H52 => {
                ([Code::Float; 3], Code::Half, Code::Half, Code::Half, Code::Half, [Code::Half; 3])
            }
            Self::Q32 => (
                [Code::Binary(23); 3],
                Code::Steps(10),
                Code::Rotation(10),
                Code::Steps(10),
                Code::Steps(11),
                [Code::Steps(9), Code::Steps(8), Code::Steps(8)],
            ),
            Self::Q24 => (
                [Code::Binary(20); 3],
                Code::Steps(8),
                Code::Rotation(8),
                Code::Steps(7),
                Code::Steps(7),
                [Code::Steps(6), Code::Steps(5), Code::Steps(5)],
            ),
        };
        // F32 is lossless. The other formats quantise on scales that are perceptually even.
        let exact = self == Self::F32;
        let measure = |measure| if exact { Measure::Plain } else { measure };
        let field =
            |name, column, columns, measure, code| Field { name, column, columns, measure, code };
        let mut fields = vec![
            field("x", column::MEAN, 1, Measure::Plain, x),
            field("y", column::MEAN + 1, 1, Measure::Plain, y),
            field("z", column::MEAN + 2, 1, Measure::Plain, z),
            field("scale", column::SCALE, 3, measure(Measure::Logarithm), scale),
            field("rotation", column::QUAT, 4, Measure::Plain, quat),
            field("opacity", column::LOG2_OPACITY, 1, measure(Measure::Opacity), opacity),
            field("colour", column::SH, 3, Measure::Plain, dc),
        ];
        let names = ["SH degree 1", "SH degree 2", "SH degree 3"];
        for degree in 1..=usize::from(sh_degree) {
            // A band begins after all coefficients of the lower degrees, and has 2 degree + 1 of
            // them in three channels.
            let column = column::SH + 3 * sh::coefficients(degree as u8 - 1);
            let columns = 3 * (2 * degree + 1);
            let band = measure(Measure::Root);
            fields.push(field(names[degree - 1], column, columns, band, bands[degree - 1]));
        }
        fields
    }

    /// Bits per Gaussian, before compression.
    pub fn bits(self, sh_degree: u8) -> usize {
        self.fields(sh_degree).iter().map(|field| field.code.bits(field.columns)).sum()
    }

    /// Bytes of a part of `count` Gaussians, before compression.
    pub fn part_bytes(self, sh_degree: u8, count: usize) -> usize {
        let bytes = |field: &Field| {
            field.code.grid_bytes() + count * field.code.planes(field.columns).iter().sum::<usize>()
        };
        self.fields(sh_degree).iter().map(bytes).sum()
    }

    /// Encodes a range of a chunk's Gaussians as one part, and adds clamped values to `clamped`.
    ///
    /// # Panics
    /// If the range does not begin at a lane group or ends after the chunk.
    pub fn encode(self, chunk: &Chunk, run: Range<usize>, clamped: &mut Clamped) -> Vec<u8> {
        // Lane groups of a part begin at lane 0, so that a reader can append part after part.
        assert!(run.start.is_multiple_of(LANES) && run.end <= chunk.len(), "{run:?}");
        let fields = self.fields(chunk.sh_degree());
        let mut grids = Vec::new();
        let mut planes = Vec::new();
        for field in &fields {
            let values = |column: usize| {
                let column = field.column + column;
                run.clone().map(move |index| chunk.value(index, column))
            };
            let count =
                field.code.encode(field.measure, field.columns, &values, &mut grids, &mut planes);
            clamped.add(field.name, count);
        }
        // Grids are at the front, so that a decoder has them before the planes.
        grids.append(&mut planes);
        grids
    }

    /// Decodes a part of `count` Gaussians, and appends their lanes: column by column of each lane
    /// group, [`columns`]`(sh_degree)` of them.
    ///
    /// # Errors
    /// The size of the part is wrong; then nothing is appended.
    pub fn decode(
        self,
        part: &[u8],
        sh_degree: u8,
        count: usize,
        lanes: &mut LanePages,
    ) -> Result<(), String> {
        self.decode_with(Level::new(), part, sh_degree, count, lanes)
    }

    /// As [`RecordFormat::decode`], with the instructions of a level; the values do not depend on
    /// it.
    fn decode_with(
        self,
        level: Level,
        part: &[u8],
        sh_degree: u8,
        count: usize,
        lanes: &mut LanePages,
    ) -> Result<(), String> {
        // The size follows from format, degree and count: after this check no split below can fail.
        let wanted = self.part_bytes(sh_degree, count);
        if part.len() != wanted {
            return Err(format!("{count} Gaussians take {wanted} bytes, not {}", part.len()));
        }
        let fields = self.fields(sh_degree);
        let (mut grids, mut planes) =
            part.split_at(fields.iter().map(|field| field.code.grid_bytes()).sum());
        let mut decoders = Vec::with_capacity(fields.len());
        for Field { column, columns, measure, code, .. } in fields {
            let (grid, other_grids) = grids.split_at(code.grid_bytes());
            let bytes = count * code.planes(columns).iter().sum::<usize>();
            let (own, other_planes) = planes.split_at(bytes);
            decoders.push((column, FieldDecoder::new(code, measure, columns, [grid, own], count)));
            grids = other_grids;
            planes = other_planes;
        }
        let width = columns(sh_degree);
        let groups = count.div_ceil(LANES);
        lanes.expect(groups);
        // One tile, used again for all: its lanes beyond the last Gaussian hold values of the tile
        // before, and the chunk empties them.
        let mut tile = vec![Lanes([0.0; LANES]); groups.min(TILE_GROUPS) * width];
        // Tile by tile; within a tile, field by field. Each decoder writes its columns of every
        // lane group.
        for start in (0..groups).step_by(TILE_GROUPS) {
            let end = groups.min(start + TILE_GROUPS);
            for (column, decoder) in &decoders {
                dispatch!(level, simd => simd.vectorize(
                    #[inline(always)]
                    || decoder.decode(
                        start..end,
                        #[inline(always)]
                        |group, k, values| tile[(group - start) * width + column + k].0 = values,
                    )
                ));
            }
            lanes.extend_from_slice(&tile[..(end - start) * width]);
        }
        Ok(())
    }
}

impl std::str::FromStr for RecordFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let known = || Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|record| record.name() == text);
        found.ok_or_else(|| format!("there is no record {text:?}; the records are {}", known()))
    }
}

impl std::fmt::Display for RecordFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl Clamped {
    fn add(&mut self, field: &'static str, count: u64) {
        match self.0.iter_mut().find(|(name, _)| *name == field) {
            Some((_, sum)) => *sum += count,
            None => self.0.push((field, count)),
        }
    }

    /// Adds the clamped values of another part.
    pub fn merge(&mut self, other: &Self) {
        other.0.iter().for_each(|&(field, count)| self.add(field, count));
    }

    /// The field with the most clamped values, and their number.
    pub fn worst(&self) -> Option<(&'static str, u64)> {
        self.0.iter().copied().max_by_key(|&(_, count)| count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec3, Quat};

    use crate::chunk::ActivatedGaussian;

    /// 1,000 Gaussians, so that the last lane group is not full.
    #[test]
    fn decoded_values_do_not_depend_on_the_vectors_of_the_processor() {
        let count = 1_000;
        let mut chunk = Chunk::new([0, 0], DVec3::ZERO, 1, count);
        for i in 0..count {
            let share = |k: usize| (i * k % 1_009) as f32 / 1_009.0;
            let turned = Quat::from_xyzw(share(3), share(5) - 0.5, share(7), 0.6 + share(11));
            let quat = turned.normalize();
            let sh: Vec<f32> = (0..12).map(|k| share(13 + k) - 0.5).collect();
            chunk.push_activated(&ActivatedGaussian {
                mean_m: [30.0 * share(37), 30.0 * share(101), -share(467)],
                scale_m: [0.1 + share(911), 0.1 + share(13), 0.01],
                quat_wxyz: [quat.w, quat.x, quat.y, quat.z],
                log2_opacity: -4.0 * share(17),
                sh: &sh,
            });
        }
        for format in RecordFormat::ALL {
            let part = format.encode(&chunk, 0..count, &mut Clamped::default());
            let [best, least] = [Level::new(), Level::baseline()].map(|level| {
                let mut lanes = LanePages::new(columns(1), None);
                format.decode_with(level, &part, 1, count, &mut lanes).unwrap();
                Chunk::from_lanes([0, 0], DVec3::ZERO, 1, count, lanes)
            });
            for (index, column) in (0..count).flat_map(|i| (0..columns(1)).map(move |c| (i, c))) {
                // Bits and not values, so that -0 and 0 differ and NaN equals itself.
                let values = [&best, &least].map(|chunk| chunk.value(index, column).to_bits());
                assert_eq!(values[0], values[1], "{format}: {index}, column {column}");
            }
        }
    }
}
