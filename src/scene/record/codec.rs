//! Encoding of the values of one field to bytes. `decoder` has the way back.

use half::f16;

/// The encoding of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Code {
    /// The bits of each f32, without loss.
    Float,
    /// Each value rounded to f16.
    Half,
    /// This many bits: a multiple of a step, from the part's smallest value to its largest.
    Steps(u32),
    /// As `Steps`, with a step that is a power of two, so that neighbouring blocks share their
    /// grid.
    Binary(u32),
    /// A unit quaternion as its three smallest components with this many bits each, and the index
    /// of the largest (the "smallest three" encoding).
    Rotation(u32),
}

/// The transform of a value before it is quantised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Measure {
    Plain,
    /// `ln(value + THIN_M)`: for scales, where ratios matter, down to a size that no camera
    /// resolves.
    Logarithm,
    /// `2^value`: for opacities, which a chunk holds as base-2 logarithms. Linear, since alpha is
    /// linear in it; up to the part's largest and not up to 1, since merged Gaussians may be above
    /// 1.
    Opacity,
    /// The signed square root: for SH coefficients, most of which are near zero.
    Root,
}

/// 10 µm, added to scales before the logarithm. Trainers flatten surfels to 1e-9 m and less, which
/// would use up most of the range of a logarithm: even with a lower limit of exp(-12) m, 22 % of
/// the scales of one capture (the skull) were clamped.
const THIN_M: f32 = 1e-5;

/// The grid of a part: value = (first + k) step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grid {
    first: i32,
    step: f32,
}

impl Measure {
    /// Range of transformed values that a grid may span; values outside are clamped. Scales up to
    /// 2.9 km; opacities up to 64, while merged Gaussians reach about 10; coefficients up to 16,
    /// while colours are about 1; untransformed values up to 1e9, beyond the 1e8 m that import
    /// accepts for means.
    fn range(self) -> [f32; 2] {
        match self {
            Self::Plain => [-1e9, 1e9],
            Self::Logarithm => [-11.6, 8.0],
            Self::Opacity => [0.0, 64.0],
            Self::Root => [-4.0, 4.0],
        }
    }

    fn apply(self, value: f32) -> f32 {
        match self {
            Self::Plain => value,
            Self::Logarithm => (value + THIN_M).ln(),
            Self::Opacity => value.exp2(),
            // The square root spends the codes on small values; the sign is kept, and zero stays
            // zero.
            Self::Root => value.abs().sqrt().copysign(value),
        }
    }

    /// The value of a transformed one.
    #[inline(always)]
    pub(super) fn value(self, measure: f32) -> f32 {
        match self {
            Self::Plain => measure,
            // Rounding near a scale of 0 may give a tiny negative number.
            Self::Logarithm => (measure.exp() - THIN_M).max(0.0),
            Self::Opacity => measure.log2(),
            Self::Root => measure * measure.abs(),
        }
    }
}

impl Code {
    /// Bits that the columns of a field take of a Gaussian.
    pub(super) fn bits(self, columns: usize) -> usize {
        match self {
            Self::Float => 32 * columns,
            Self::Half => 16 * columns,
            Self::Steps(bits) | Self::Binary(bits) => bits as usize * columns,
            Self::Rotation(bits) => 2 + 3 * bits as usize,
        }
    }

    /// Bytes per value of each stored column.
    pub(super) fn planes(self, columns: usize) -> Vec<usize> {
        // Whole bytes, because zstd compresses the empty high bits of a plane of their own.
        let bytes = |bits: u32| bits.div_ceil(8) as usize;
        match self {
            Self::Float => vec![4; columns],
            Self::Half => vec![2; columns],
            Self::Steps(bits) | Self::Binary(bits) => vec![bytes(bits); columns],
            // The first code also has the index of the largest component, two bits more.
            Self::Rotation(bits) => vec![bytes(bits + 2), bytes(bits), bytes(bits)],
        }
    }

    /// Bytes of a part's grid.
    pub(super) fn grid_bytes(self) -> usize {
        match self {
            Self::Steps(_) | Self::Binary(_) => 8,
            Self::Float | Self::Half | Self::Rotation(_) => 0,
        }
    }

    /// Appends the part's grid and byte planes. Returns the number of clamped values.
    pub(super) fn encode<V: Iterator<Item = f32>>(
        self,
        measure: Measure,
        columns: usize,
        values: &dyn Fn(usize) -> V,
        grids: &mut Vec<u8>,
        planes: &mut Vec<u8>,
    ) -> u64 {
        // Codes without a grid are written here, and return; what follows is quantisation alone.
        let (bits, binary) = match self {
            Self::Float => {
                for column in 0..columns {
                    let codes: Vec<u32> = values(column).map(f32::to_bits).collect();
                    write_planes(planes, &codes, 4);
                }
                return 0;
            }
            Self::Half => {
                for column in 0..columns {
                    let half = |value| u32::from(f16::from_f32(measure.apply(value)).to_bits());
                    let codes: Vec<u32> = values(column).map(half).collect();
                    write_planes(planes, &codes, 2);
                }
                return 0;
            }
            Self::Rotation(bits) => {
                // Four columns are read side by side, because a code depends on all components.
                let [w, x, y, z] = [0, 1, 2, 3].map(values);
                let quats = w.zip(x).zip(y.zip(z)).map(|((w, x), (y, z))| [w, x, y, z]);
                let codes: Vec<[u32; 3]> = quats.map(|q| smallest_three(q, bits)).collect();
                for (k, bytes) in self.planes(columns).into_iter().enumerate() {
                    let column: Vec<u32> = codes.iter().map(|code| code[k]).collect();
                    write_planes(planes, &column, bytes);
                }
                return 0;
            }
            Self::Steps(bits) => (bits, false),
            Self::Binary(bits) => (bits, true),
        };
        let [low, high] = measure.range();
        let mut clamped = 0;
        // All columns of the field share a grid, so that they are measured together before any code
        // is computed.
        let measured: Vec<f32> = (0..columns)
            .flat_map(values)
            .map(|value| {
                let measured = measure.apply(value);
                let within = measured.clamp(low, high);
                clamped += u64::from(within != measured);
                within
            })
            .collect();
        let grid = Grid::over(&measured, bits, binary);
        grids.extend(grid.first.to_le_bytes());
        grids.extend(grid.step.to_le_bytes());
        let codes: Vec<u32> = measured.iter().map(|&value| grid.code(value, bits)).collect();
        // `measured` has the columns one after the other, each of the same length. `max` is for a
        // part without Gaussians, whose chunk length would be 0.
        for column in codes.chunks(codes.len().div_ceil(columns).max(1)) {
            write_planes(planes, column, bits.div_ceil(8) as usize);
        }
        clamped
    }
}

impl Grid {
    /// The finest grid that covers all values with the numbers 0 to 2^bits - 1.
    ///
    /// The grid consists of multiples of its step, so that zero is on it: its start is rounded down
    /// to a multiple, which uses one of the steps. A step of 2^-30 of the largest value is finer
    /// than f32.
    fn over(values: &[f32], bits: u32, binary: bool) -> Self {
        let fold = |from: f64, pick: fn(f64, f64) -> f64| {
            values.iter().fold(from, |all, &value| pick(all, f64::from(value)))
        };
        let low = fold(f64::INFINITY, f64::min);
        let high = fold(f64::NEG_INFINITY, f64::max);
        // 2^bits numbers are 2^bits - 1 steps, of which one is used up by rounding the start down.
        let steps = f64::from((1_u32 << bits) - 2);
        let finest = low.abs().max(high.abs()) / f64::from(1 << 30);
        // The step is the range by the steps, but not so fine that `first` would leave i32: |low| /
        // step is at most 2^30.
        let step = ((high - low) / steps).max(finest);
        let spans = step > 1e-30;
        if !spans {
            // All values are zero, or there are none.
            return Self { first: 0, step: 1.0 };
        }
        // Rounded up, so that the last number still reaches the largest value.
        let step =
            if binary { step.log2().ceil().exp2() as f32 } else { (step * (1.0 + 1e-6)) as f32 };
        Self { first: (low / f64::from(step)).floor() as i32, step }
    }

    fn code(self, value: f32, bits: u32) -> u32 {
        let number = (f64::from(value) / f64::from(self.step)).round() - f64::from(self.first);
        number.clamp(0.0, f64::from((1_u32 << bits) - 1)) as u32
    }

    /// The value of a code.
    #[inline(always)]
    pub(super) fn at(self, code: u32) -> f32 {
        // Wrapping, because a damaged file may have any grid: a wrong value, but no panic.
        self.first.wrapping_add(code as i32) as f32 * self.step
    }

    /// Reads a grid as [`Code::encode`] wrote it: 8 bytes.
    pub(super) fn read(bytes: &[u8]) -> Self {
        let word = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        Self { first: i32::from_le_bytes(word(0)), step: f32::from_le_bytes(word(4)) }
    }
}

/// Encodes a unit quaternion as its three smallest components, each of magnitude at most 1/√2, with
/// zero in the middle of the range. The index of the largest component is in the upper bits of the
/// first code. A quaternion and its negative are the same rotation, so the sign is chosen to make
/// the largest component positive.
fn smallest_three(quat: [f32; 4], bits: u32) -> [u32; 3] {
    let largest = (0..4).max_by(|&a, &b| quat[a].abs().total_cmp(&quat[b].abs())).unwrap_or(0);
    // One number less than the bits allow, so that the range is symmetric and zero has a code in
    // its middle.
    let half = f64::from((1_u32 << (bits - 1)) - 1);
    let sign = if quat[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut codes = [0; 3];
    let others = (0..4).filter(|&k| k != largest);
    for (code, k) in codes.iter_mut().zip(others) {
        // Components other than the largest are at most 1/√2; times √2 they are within -1..=1.
        let share = sign * f64::from(quat[k]) * std::f64::consts::SQRT_2;
        *code = ((share * half).round().clamp(-half, half) + half) as u32;
    }
    codes[0] |= (largest as u32) << bits;
    codes
}

fn write_planes(planes: &mut Vec<u8>, codes: &[u32], bytes: usize) {
    for byte in 0..bytes {
        planes.extend(codes.iter().map(|code| (code >> (8 * byte)) as u8));
    }
}
