//! SPZ, Niantic's format: versions 2 and 3 in one gzip stream (or none), version 4 in zstd streams.
//!
//! Source: the format's description and headers in nianticlabs/spz. All versions hold the same
//! attributes, each for all Gaussians, in the order of `Header::attributes`: positions (3 x 24-bit
//! fixed point), opacities (u8), colours (3 u8), ln scales (3 u8, sixteenths from -10), rotations
//! and the higher colour coefficients (u8, 128ths from -1; coefficient-major, then red, green,
//! blue). Version 4 has an uncompressed header of 32 bytes and a table of the streams' sizes after
//! it. Between the two, or after the payload of earlier versions, there may be extensions: the one
//! of the coordinate system is read, others are named in a warning. Without it the system is right,
//! up, back.

mod extensions;

use std::io::{self, BufRead, Read};

use flate2::bufread::GzDecoder;

use wildcity_scene::{Gaussians, sh};

use super::notes::{BLUR_PX2, Reading};
use super::unpack_budget::{self, UnpackBudget};
use super::validate::Field;
use super::{IngestError, activation, check_count};

const FORMAT: &str = "SPZ";
/// "NGSP": Niantic's Gaussian splats.
const MAGIC: [u8; 4] = *b"NGSP";
/// Bytes of the header of versions 2 and 3.
const HEADER_BYTES: u64 = 16;
/// Bytes of version 4's header. Its last 16 begin with the offset of the table of streams.
const HEADER_4_BYTES: u64 = 32;
/// Two u64 per stream: compressed and uncompressed bytes.
const STREAM_ENTRY_BYTES: u64 = 16;
/// Set if the scene was trained with opacity compensation.
const FLAG_ANTIALIASED: u8 = 1;
/// Set if there are extensions: before the table in version 4, after the payload in the others.
const FLAG_EXTENSIONS: u8 = 2;
/// The factor that colours were multiplied by before quantisation, so that values beyond 0 to 1 fit
/// into a byte.
const COLOUR_SCALE: f64 = 0.15;

/// Reads a file that starts with the header, of a known size.
pub(super) fn read(
    mut input: impl BufRead,
    file_bytes: u64,
    budget: UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let header = Header::read(&mut input)?;
    header.note_flags(reading);
    let count = header.count;
    let attributes = header.attributes();
    if header.version < 4 {
        // Before version 4 the file is not compressed here, so that its size must be exact. Only
        // extensions, whose size is not recorded, may follow.
        let promised = u128::from(HEADER_BYTES) + header.body_bytes();
        let held = u128::from(file_bytes);
        if header.flags & FLAG_EXTENSIONS == 0 && promised != held || promised > held {
            let content = format!("{count} Gaussians of SH degree {}", header.sh_degree);
            return Err(IngestError::Size { format: FORMAT, promised, held, content });
        }
        let rows = |attribute: usize, take: &mut dyn FnMut(&[u8])| {
            attributes[attribute].rows(&mut input, take)
        };
        let gaussians = decode(&header, rows, reading)?;
        extensions::read(&mut input, (held - promised) as u64, reading)?;
        extensions::assume_system(reading);
        return Ok(gaussians);
    }
    let streams = read_table(&mut input, &header, file_bytes, budget, reading)?;
    extensions::assume_system(reading);
    let rows = |attribute: usize, take: &mut dyn FnMut(&[u8])| {
        let attribute = &attributes[attribute];
        let broken = |error: io::Error| attribute.broken(&error);
        // Bounded by the table, so that a stream cannot read on into the next one.
        let mut packed = (&mut input).take(streams[attribute.index]);
        let mut stream = zstd::Decoder::with_buffer(&mut packed).map_err(broken)?.single_frame();
        attribute.rows(&mut stream, take)?;
        // A byte more in the decoded stream, or one of the packed stream that was not used,
        // contradicts the table.
        let more = stream.read(&mut [0]).map_err(broken)? + packed.read(&mut [0])?;
        if more > 0 {
            return Err(body(attribute.name, "the stream is longer than its table says".into()));
        }
        Ok(())
    };
    decode(&header, rows, reading)
}

/// Reads a gzip stream that holds versions 2 or 3, of a known compressed size.
pub(super) fn read_gzip(
    input: impl BufRead,
    file_bytes: u64,
    mut budget: UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    budget.read(file_bytes);
    read_gzip_within(input, file_bytes, &mut budget, reading)
}

/// As [`read_gzip`], of a stream whose compressed bytes the budget already counts.
pub(super) fn read_gzip_within(
    input: impl BufRead,
    file_bytes: u64,
    budget: &mut UnpackBudget,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let mut input = GzDecoder::new(input);
    let header = Header::read(&mut input)?;
    if header.version > 3 {
        let reason = format!("version {} within gzip; 2 and 3 are read so", header.version);
        return Err(bad("bytes 4 to 7", reason));
    }
    let unpacked_bytes = u128::from(HEADER_BYTES) + header.body_bytes();
    // Checked before decoding: a small gzip stream may unpack to a thousand times its size.
    budget.unpack(FORMAT, "the gzip stream", unpacked_bytes)?;
    header.note_flags(reading);
    let attributes = header.attributes();
    let rows = |attribute: usize, take: &mut dyn FnMut(&[u8])| {
        attributes[attribute].rows(&mut input, take)
    };
    let gaussians = decode(&header, rows, reading)?;
    // Read to the end, so that the checksum is verified.
    let limit = unpack_budget::limit_bytes(file_bytes);
    let damaged = |e: io::Error| body("the end", format!("the gzip stream is damaged: {e}"));
    let mut after = Vec::new();
    if header.flags & FLAG_EXTENSIONS != 0 {
        // An extension is read from memory, and only up to what a legacy file may hold.
        let kept = limit.min(extensions::LEGACY_BYTES);
        (&mut input).take(kept).read_to_end(&mut after).map_err(damaged)?;
        extensions::read(&mut &after[..], after.len() as u64, reading)?;
    }
    extensions::assume_system(reading);
    let left = limit - (after.len() as u64).min(limit);
    let rest = io::copy(&mut (&mut input).take(left), &mut io::sink()).map_err(damaged)?;
    let more = rest + after.len() as u64;
    if more > 0 && header.flags & FLAG_EXTENSIONS == 0 {
        let reason = format!("more than the {unpacked_bytes} bytes that the header promises");
        return Err(body("the end", reason));
    }
    // After `limit` bytes the end of the stream may not be reached, and bytes that are left are no
    // fault.
    if more < limit && !input.into_inner().fill_buf()?.is_empty() {
        return Err(body("the end", "more than the gzip stream: copy the file again".into()));
    }
    Ok(gaussians)
}

/// The fields that all versions begin with.
struct Header {
    version: u32,
    count: u32,
    sh_degree: u8,
    fraction_bits: u8,
    flags: u8,
    /// Number of streams, in version 4.
    streams: u8,
}

impl Header {
    fn read(input: &mut impl Read) -> Result<Self, IngestError> {
        let mut bytes = [0; HEADER_BYTES as usize];
        input.read_exact(&mut bytes).map_err(|e| bad("the first 16 bytes", e.to_string()))?;
        let [magic, version, count, rest] = *bytes.as_chunks::<4>().0 else {
            return Err(bad("the first 16 bytes", "there are fewer".into()));
        };
        if magic != MAGIC {
            let reason = format!("{:?}, not \"NGSP\"", String::from_utf8_lossy(&magic));
            return Err(bad("the first 4 bytes", reason));
        }
        let [sh_degree, fraction_bits, flags, streams] = rest;
        let version = u32::from_le_bytes(version);
        if !(2..=4).contains(&version) {
            return Err(bad("bytes 4 to 7", format!("version {version}; 2, 3 and 4 are read")));
        }
        if sh_degree > sh::MAX_DEGREE {
            return Err(bad("byte 12", format!("SH degree {sh_degree}; 0 to 3 are read")));
        }
        // A coordinate has a sign and 23 bits.
        if fraction_bits > 23 {
            return Err(bad("byte 13", format!("{fraction_bits} fractional bits; 0 to 23 fit")));
        }
        let count = u32::from_le_bytes(count);
        Ok(Self { version, count, sh_degree, fraction_bits, flags, streams })
    }

    /// Notes what the flags say.
    fn note_flags(&self, reading: &mut Reading) {
        if self.flags & FLAG_ANTIALIASED != 0 {
            reading.set_antialiased(BLUR_PX2, "bit 0 of the SPZ flags".to_owned());
        }
        let unknown = self.flags & !(FLAG_ANTIALIASED | FLAG_EXTENSIONS);
        if unknown != 0 {
            reading.warn(format!("SPZ flags {unknown:#04x} are unknown and have no effect"));
        }
    }

    /// The attributes in the order of the file.
    fn attributes(&self) -> Vec<Attribute> {
        // Version 2 stores x, y and z in a byte each; later ones the smallest three in 32 bits.
        let rotation_bytes = if self.version == 2 { 3 } else { 4 };
        let sh_bytes = 3 * (sh::coefficients(self.sh_degree) - 1);
        let attributes = [
            ("positions", 9),
            ("opacities", 1),
            ("colours", 3),
            ("scales", 3),
            ("rotations", rotation_bytes),
            ("colour coefficients", sh_bytes),
        ];
        attributes
            .into_iter()
            .enumerate()
            // Without higher degrees a file has no stream of coefficients, and its table no entry
            // for one.
            .filter(|(_, (_, stride))| *stride > 0)
            .map(|(index, (name, stride))| Attribute { index, name, stride, count: self.count })
            .collect()
    }

    /// Bytes of all attributes.
    fn body_bytes(&self) -> u128 {
        self.attributes().iter().map(Attribute::bytes).sum()
    }
}

/// One property of all Gaussians.
struct Attribute {
    index: usize,
    name: &'static str,
    stride: usize,
    count: u32,
}

impl Attribute {
    fn bytes(&self) -> u128 {
        self.stride as u128 * u128::from(self.count)
    }

    /// Calls `take` with each row.
    fn rows(&self, input: &mut dyn Read, take: &mut dyn FnMut(&[u8])) -> Result<(), IngestError> {
        // In blocks, so that not every row costs a call of a dynamic reader.
        let mut rows = vec![0; self.stride * ROWS_AT_ONCE];
        let mut left = self.count as usize;
        while left > 0 {
            let rows = &mut rows[..self.stride * left.min(ROWS_AT_ONCE)];
            input.read_exact(rows).map_err(|error| self.broken(&error))?;
            rows.chunks_exact(self.stride).for_each(&mut *take);
            left -= left.min(ROWS_AT_ONCE);
        }
        Ok(())
    }

    fn broken(&self, error: &io::Error) -> IngestError {
        let reason = match error.kind() {
            io::ErrorKind::UnexpectedEof => {
                format!("the file ends before {} of them: it is truncated", self.count)
            }
            _ => format!("the compressed stream is damaged: {error}"),
        };
        body(self.name, reason)
    }
}

/// Rows that are read at once.
const ROWS_AT_ONCE: usize = 4096;

/// Reads the extensions up to version 4's table of streams, and the compressed size of every
/// attribute from it.
fn read_table(
    input: &mut impl Read,
    header: &Header,
    file_bytes: u64,
    mut budget: UnpackBudget,
    reading: &mut Reading,
) -> Result<Vec<u64>, IngestError> {
    budget.read(file_bytes);
    // The count of streams follows from the SH degree. Another count means another layout.
    let attributes = header.attributes();
    if usize::from(header.streams) != attributes.len() {
        let found = header.streams;
        let wanted = attributes.len();
        let degree = header.sh_degree;
        return Err(bad("byte 15", format!("{found} streams; SH degree {degree} has {wanted}")));
    }
    let short = |e: io::Error| bad("the table of streams", e.to_string());
    let mut rest = [0; (HEADER_4_BYTES - HEADER_BYTES) as usize];
    input.read_exact(&mut rest).map_err(short)?;
    let table_at = u64::from(u32::from_le_bytes([rest[0], rest[1], rest[2], rest[3]]));
    let streams_at = table_at + STREAM_ENTRY_BYTES * attributes.len() as u64;
    // The table must lie behind the header and within the file, so that the subtractions below
    // hold.
    if table_at < HEADER_4_BYTES || streams_at > file_bytes {
        let reason = format!("the table cannot be at {table_at} in a file of {file_bytes} bytes");
        return Err(bad("bytes 16 to 19", reason));
    }
    extensions::read(input, table_at - HEADER_4_BYTES, reading)?;
    let mut packed = Vec::with_capacity(attributes.len());
    for attribute in &attributes {
        let mut entry = [0; STREAM_ENTRY_BYTES as usize];
        input.read_exact(&mut entry).map_err(short)?;
        let sizes = entry.as_chunks::<8>().0;
        let packed_bytes = u64::from_le_bytes(sizes[0]);
        let bytes = u64::from_le_bytes(sizes[1]);
        // Sizes that disagree with the count would shift all rows after them.
        if u128::from(bytes) != attribute.bytes() {
            let wanted = attribute.bytes();
            let count = attribute.count;
            let reason = format!("{bytes} bytes; {count} Gaussians have {wanted}");
            return Err(bad(&format!("stream of {}", attribute.name), reason));
        }
        packed.push(packed_bytes);
    }
    let promised = packed.iter().map(|&bytes| u128::from(bytes)).sum();
    let held = u128::from(file_bytes - streams_at);
    if promised != held {
        let content = format!("{} streams", packed.len());
        return Err(IngestError::Size { format: FORMAT, promised, held, content });
    }
    // Unpacked bytes follow from the header, so the budget is charged before a stream is decoded.
    budget.unpack(FORMAT, "the zstd streams", header.body_bytes())?;
    Ok(packed)
}

/// Decodes Gaussians from the attributes; `rows` calls its argument with all rows of one attribute.
fn decode(
    header: &Header,
    mut rows: impl FnMut(usize, &mut dyn FnMut(&[u8])) -> Result<(), IngestError>,
    reading: &mut Reading,
) -> Result<Gaussians, IngestError> {
    let count = check_count(header.count.into())?;
    let mut gaussians = Gaussians::with_capacity(header.sh_degree, count);
    let g = &mut gaussians;
    let unit = |byte: u8| f64::from(byte) / 255.0;
    let metres = f64::from(header.fraction_bits).exp2().recip();
    rows(0, &mut |row| {
        let fixed = |i: usize| {
            // Into the upper three bytes, and shifted back with the sign.
            i32::from_le_bytes([0, row[3 * i], row[3 * i + 1], row[3 * i + 2]]) >> 8
        };
        g.means_m.push(std::array::from_fn(|i| f64::from(fixed(i)) * metres));
    })?;
    rows(1, &mut |row| g.logit_opacities.push(activation::logit(unit(row[0]))))?;
    let stride = 3 * sh::coefficients(header.sh_degree);
    g.sh.resize(stride * count, 0.0);
    let mut colours = g.sh.chunks_exact_mut(stride);
    // A row has three bytes, so that `zip` fills the first three values of a Gaussian: degree 0.
    rows(2, &mut |row| {
        for (value, &byte) in colours.next().into_iter().flatten().zip(row) {
            *value = ((unit(byte) - 0.5) / COLOUR_SCALE) as f32;
        }
    })?;
    rows(3, &mut |row| {
        // The specification stores ln(scale) as 16 (ln(scale) + 10): steps of 1/16 from -10 to
        // 5.94.
        g.ln_scales.push(std::array::from_fn(|i| f32::from(row[i]) / 16.0 - 10.0));
    })?;
    rows(4, &mut |row| {
        g.quats_wxyz.push(match *row {
            [x, y, z] => quat_of_xyz([x, y, z]),
            _ => quat_of_word(row.first_chunk().map_or(0, |&word| u32::from_le_bytes(word))),
        });
    })?;
    if header.sh_degree > 0 {
        let mut colours = g.sh.chunks_exact_mut(stride);
        rows(5, &mut |row| {
            // Coefficient 0 was set by the colours, so its three values are skipped.
            for (value, &byte) in colours.next().into_iter().flat_map(|c| &mut c[3..]).zip(row) {
                *value = (f32::from(byte) - 128.0) / 128.0;
            }
        })?;
    }
    reading.accept(gaussians, &Field::plain_name)
}

/// Version 2: x, y, z around 127.5; w is positive and makes the length 1.
fn quat_of_xyz(bytes: [u8; 3]) -> [f32; 4] {
    let xyz = bytes.map(|byte| f64::from(byte) / 127.5 - 1.0);
    activation::quat_of_smallest_three(0, xyz)
}

/// Version 3: the index of the largest of (x, y, z, w) in the upper 2 bits, then sign and magnitude
/// of the others, 1 + 9 bits each, as fractions of √½.
fn quat_of_word(word: u32) -> [f32; 4] {
    // The fields lie from bit 29 down to bit 0, in the order of the components that are left.
    let others = [20, 10, 0].map(|shift| {
        let bits = word >> shift;
        let magnitude = f64::from(bits & 0x1ff) / f64::from(0x1ff) * 0.5f64.sqrt();
        if bits & 0x200 == 0 { magnitude } else { -magnitude }
    });
    let [x, y, z, w] = activation::quat_of_smallest_three((word >> 30) as usize, others);
    [w, x, y, z]
}

fn bad(place: &str, reason: String) -> IngestError {
    IngestError::Header { format: FORMAT, place: place.into(), reason }
}

fn body(place: &str, reason: String) -> IngestError {
    IngestError::Body { format: FORMAT, place: place.into(), reason }
}
