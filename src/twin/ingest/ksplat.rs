//! `.ksplat`, the format of mkkellogg's GaussianSplats3D, version 0.1: levels 0 to 2, SH degrees 0
//! to 2.
//!
//! A header of 4096 bytes, one of 1024 per section, then the sections: sizes of the buckets that
//! are not full, centres of all buckets, records. A record is position, standard deviations,
//! rotation (w, x, y, z), colour and opacity (4 u8, of 255), and the higher colour coefficients:
//! each degree's all of red, then green, then blue. Level 0 has f32; levels 1 and 2 have positions
//! of 16 bits around their bucket's centre and f16; level 2 has coefficients of 8 bits.

use std::io::{self, Read};

use half::f16;

use wildcity_scene::{Gaussians, sh};

use super::notes::Reading;
use super::validate::Field;
use super::{IngestError, activation, check_count};

const FORMAT: &str = ".ksplat";
const HEADER_BYTES: usize = 4096;
const SECTION_HEADER_BYTES: usize = 1024;
/// Largest SH degree of the format.
const MAX_DEGREE: u16 = 2;
/// Default for half the number of steps of a 16-bit position, which a section may override.
const POSITION_RANGE: u32 = 32767;
/// Default range of 8-bit coefficients in both directions, which the file may override.
const SH_RANGE: f32 = 1.5;

/// Reads a file of a known size.
pub(super) fn read(
    mut input: impl Read,
    file_bytes: u64,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let header = Header::read(&mut input)?;
    let headers_bytes =
        HEADER_BYTES as u128 + u128::from(header.sections) * SECTION_HEADER_BYTES as u128;
    let size = |promised: u128, content: String| IngestError::Size {
        format: FORMAT,
        promised,
        held: file_bytes.into(),
        content,
    };
    // Before allocating one entry per section: their number is untrusted.
    if headers_bytes > file_bytes.into() {
        return Err(size(headers_bytes, format!("headers of {} sections", header.sections)));
    }
    let mut sections = Vec::with_capacity(header.sections as usize);
    for index in 0..header.sections {
        sections.push(Section::read(&mut input, index, &header)?);
    }
    let body: u128 = sections.iter().map(Section::bytes).sum();
    if headers_bytes + body != file_bytes.into() {
        return Err(size(headers_bytes + body, format!("{} sections", sections.len())));
    }
    let count = sections.iter().map(|section| u64::from(section.count)).sum();
    check_count(count)?;
    if count != u64::from(header.count) {
        let reason = format!("{} Gaussians; the sections have {count}", header.count);
        return Err(bad("bytes 16 to 19", reason));
    }
    let mut all = Gaussians::default();
    for section in &sections {
        let part = section.decode(&mut input, &header)?;
        all.append(&part);
    }
    reading.accept(all, &Field::plain_name)
}

struct Header {
    /// Number of sections with a header; unused ones are empty.
    sections: u32,
    /// Number of Gaussians of all sections.
    count: u32,
    level: u16,
    /// Smallest and largest value of 8-bit coefficients.
    sh_range: [f32; 2],
}

impl Header {
    fn read(input: &mut impl Read) -> Result<Self, IngestError> {
        let mut bytes = vec![0; HEADER_BYTES];
        input.read_exact(&mut bytes).map_err(|e| bad("header", e.to_string()))?;
        let level = u16_at(&bytes, 20);
        if level > 2 {
            return Err(bad("bytes 20 to 21", format!("level {level}; 0, 1 and 2 are read")));
        }
        let [least, most] = [36, 40].map(|at| f32::from_bits(u32_at(&bytes, at)));
        // Zero stands for the default: a file need not give a range.
        let or = |value: f32, default: f32| if value == 0.0 { default } else { value };
        let sh_range = [or(least, -SH_RANGE), or(most, SH_RANGE)];
        Ok(Self { sections: u32_at(&bytes, 4), count: u32_at(&bytes, 16), level, sh_range })
    }
}

/// The header of a section: a run of Gaussians of one SH degree.
struct Section {
    index: u32,
    count: u32,
    max_count: u32,
    bucket_size: u32,
    buckets: u32,
    block_m: f32,
    bucket_bytes: u16,
    range: u32,
    full_buckets: u32,
    partial_buckets: u32,
    sh_degree: u8,
    record_bytes: usize,
}

impl Section {
    fn read(input: &mut impl Read, index: u32, header: &Header) -> Result<Self, IngestError> {
        let mut bytes = [0; SECTION_HEADER_BYTES];
        input.read_exact(&mut bytes)?;
        let place = format!("section {index}");
        let degree = u16_at(&bytes, 40);
        if degree > MAX_DEGREE {
            return Err(bad(&place, format!("SH degree {degree}; 0, 1 and 2 are read")));
        }
        let sh_degree = degree as u8;
        let values = 3 * (sh::coefficients(sh_degree) - 1);
        let range = u32_at(&bytes, 24);
        let section = Self {
            index,
            count: u32_at(&bytes, 0),
            max_count: u32_at(&bytes, 4),
            bucket_size: u32_at(&bytes, 8),
            buckets: u32_at(&bytes, 12),
            block_m: f32::from_bits(u32_at(&bytes, 16)),
            bucket_bytes: u16_at(&bytes, 20),
            range: if range == 0 { POSITION_RANGE } else { range },
            full_buckets: u32_at(&bytes, 32),
            partial_buckets: u32_at(&bytes, 36),
            sh_degree,
            // 44 = 12 + 12 + 16 + 4 bytes of position, scales, rotation and colour; 24 = 6 + 6 + 8
            // + 4.
            record_bytes: match header.level {
                0 => 44 + 4 * values,
                1 => 24 + 2 * values,
                _ => 24 + values,
            },
        };
        // The rest of the room is unused records, whose number is computed by subtraction.
        if section.count > section.max_count {
            let count = section.count;
            let most = section.max_count;
            return Err(bad(&place, format!("{count} Gaussians, but room for {most}")));
        }
        let has_centres = section.count > 0 || section.buckets > 0;
        if header.level > 0 && has_centres && section.bucket_bytes < 12 {
            let bytes = section.bucket_bytes;
            return Err(bad(&place, format!("buckets of {bytes} bytes; a centre takes 12")));
        }
        Ok(section)
    }

    /// Bytes of the section, without its header.
    fn bytes(&self) -> u128 {
        u128::from(self.partial_buckets) * 4
            + u128::from(self.buckets) * u128::from(self.bucket_bytes)
            + u128::from(self.max_count) * self.record_bytes as u128
    }

    /// Reads the section. The caller has checked that the file is long enough.
    fn decode(&self, input: &mut impl Read, header: &Header) -> Result<Gaussians, IngestError> {
        let mut word = [0; 4];
        let mut partial_sizes = Vec::new();
        for _ in 0..self.partial_buckets {
            input.read_exact(&mut word)?;
            partial_sizes.push(u32::from_le_bytes(word));
        }
        let mut centres_m: Vec<[f32; 3]> = Vec::new();
        let mut bucket = vec![0; self.bucket_bytes.into()];
        if header.level > 0 {
            for _ in 0..self.buckets {
                input.read_exact(&mut bucket)?;
                centres_m.push([0, 4, 8].map(|at| f32::from_bits(u32_at(&bucket, at))));
            }
        } else {
            // Not one by one: buckets may have no bytes, and there may be four billion of them.
            let bytes = u64::from(self.buckets) * u64::from(self.bucket_bytes);
            let read = io::copy(&mut input.by_ref().take(bytes), &mut io::sink())?;
            if read < bytes {
                return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
            }
        }
        let mut gaussians = Gaussians::with_capacity(self.sh_degree, self.count as usize);
        let mut record = vec![0; self.record_bytes];
        // Full buckets come first and hold `bucket_size` Gaussians each; the sizes of the others
        // are listed.
        let full = std::iter::repeat_n(self.bucket_size, self.full_buckets as usize);
        let sizes = full.chain(partial_sizes).enumerate();
        let mut buckets =
            sizes.flat_map(|(bucket, size)| std::iter::repeat_n(bucket, size as usize));
        for index in 0..self.count {
            input.read_exact(&mut record)?;
            let centre_m = match header.level {
                0 => [0.0; 3],
                _ => *buckets.next().and_then(|bucket| centres_m.get(bucket)).ok_or_else(|| {
                    let reason = format!("its Gaussian {index} is in no bucket");
                    bad(&format!("section {}", self.index), reason)
                })?,
            };
            self.push(&record, centre_m, header, &mut gaussians);
        }
        // Unused records.
        let rest = u64::from(self.max_count - self.count) * self.record_bytes as u64;
        io::copy(&mut input.take(rest), &mut io::sink())?;
        Ok(gaussians)
    }

    fn push(&self, record: &[u8], centre_m: [f32; 3], header: &Header, g: &mut Gaussians) {
        let single = |at: usize| f32::from_bits(u32_at(record, at));
        let half = |at: usize| f16::from_bits(u16_at(record, at)).to_f32();
        let (scales, quat, colour_at): ([f32; 3], [f32; 4], usize) = if header.level == 0 {
            g.means_m.push([0, 4, 8].map(|at| single(at).into()));
            ([12, 16, 20].map(single), [24, 28, 32, 36].map(single), 40)
        } else {
            // Steps count from -range to +range over one block, so half a block has `range` steps.
            let metres = f64::from(self.block_m) / 2.0 / f64::from(self.range);
            g.means_m.push(std::array::from_fn(|axis| {
                let steps = f64::from(u16_at(record, 2 * axis)) - f64::from(self.range);
                steps * metres + f64::from(centre_m[axis])
            }));
            ([6, 8, 10].map(half), [12, 14, 16, 18].map(half), 20)
        };
        g.ln_scales.push(scales.map(|scale| activation::ln_scale(scale.into())));
        g.quats_wxyz.push(quat);
        let unit = |i: usize| f64::from(record[colour_at + i]) / 255.0;
        g.sh.extend([0, 1, 2].map(|channel| activation::dc(unit(channel))));
        g.logit_opacities.push(activation::logit(unit(3)));
        let value = |i: usize| match header.level {
            0 => single(44 + 4 * i),
            1 => half(24 + 2 * i),
            _ => {
                let [least, most] = header.sh_range;
                least + (most - least) * f32::from(record[24 + i]) / 255.0
            }
        };
        for degree in 1..=usize::from(self.sh_degree) {
            // Degree l has 2 l + 1 coefficients. The degrees below l have l² in sum, of which the
            // one of degree 0 is not here; each has three channels.
            let of_this = 2 * degree + 1;
            let before = 3 * (degree * degree - 1);
            for k in 0..of_this {
                g.sh.extend([0, 1, 2].map(|channel| value(before + channel * of_this + k)));
            }
        }
    }
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: FORMAT, place: place.into(), reason }
}
