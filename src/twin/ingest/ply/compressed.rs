//! PLY as compressed by PlayCanvas: 16 bytes per Gaussian, in chunks of 256 that share a value
//! range.
//!
//! Source: the format of the PlayCanvas engine and its SuperSplat editor. A vertex has
//! packed_position and packed_scale (11, 10, 11 bits from the top, within the chunk's range),
//! packed_rotation (2 bits for the largest component, 3 x 10 for the others) and packed_color (4 x
//! 8: colour within the chunk's range, opacity). An element sh holds f_rest in 8 bits.

use std::io::BufRead;

use wildcity_scene::{Gaussians, sh};

use super::header::{Element, Header, Property, error};
use super::{Body, degree, file_name};
use crate::ingest::activation;
use crate::ingest::notes::Reading;
use crate::ingest::validate::Field;
use crate::ingest::{IngestError, Progress, check_count};

/// Number of Gaussians in a chunk.
const CHUNK: usize = 256;

/// Reads the body: value ranges, vertices and higher SH degrees.
pub(super) fn read(
    input: impl BufRead,
    header: &Header,
    file_bytes: u64,
    reading: &mut Reading,
    progress: Progress<'_>,
) -> Result<Gaussians, IngestError> {
    // Find the columns, and check the size of the file.
    let (chunk, vertex, colour) = tables(header)?;
    let sh_degree = colour.map_or(Ok(0), degree)?;
    let ranges = ValueRanges::find(chunk)?;
    let position = vertex.property("packed_position").cloned()?;
    let rotation = vertex.property("packed_rotation").cloned()?;
    let scale = vertex.property("packed_scale").cloned()?;
    let color = vertex.property("packed_color").cloned()?;
    let rest = colour.map_or(Ok(Vec::new()), |colour| higher_degrees(colour, sh_degree))?;
    header.check_size(file_bytes)?;
    let count = check_count(vertex.count)?;

    // Value ranges, then vertices, then higher SH degrees: the order of the body.
    let mut chunks = Vec::with_capacity(count.div_ceil(CHUNK));
    let encoding = header.encoding;
    let mut body = Body { input, encoding, done: header.bytes, file_bytes, progress };
    body.rows(chunk, |row| chunks.push(ranges.value(row)))?;
    let coefficients = sh::coefficients(sh_degree);
    let mut gaussians = Gaussians::with_capacity(sh_degree, count);
    body.rows(vertex, |row| {
        let word = |property: &Property| property.value(row) as u32;
        // `tables` has compared the lengths: there is a chunk for every 256 vertices.
        let [low, high] = chunks[gaussians.len() / CHUNK];
        let between = |first: usize, unit: [f64; 3]| -> [f64; 3] {
            let mix = |i| low[first + i] + (high[first + i] - low[first + i]) * unit[i];
            std::array::from_fn(mix)
        };
        gaussians.means_m.push(between(0, unpack_11_10_11(word(&position))));
        gaussians.quats_wxyz.push(unpack_rotation(word(&rotation)));
        let scale = between(3, unpack_11_10_11(word(&scale)));
        gaussians.ln_scales.push(scale.map(|ln| ln as f32));
        // Red is in the highest byte.
        let [r, g, b, opacity] = word(&color).to_be_bytes().map(|byte| f64::from(byte) / 255.0);
        gaussians.logit_opacities.push(activation::logit(opacity));
        gaussians.sh.extend(between(6, [r, g, b]).map(activation::dc));
        gaussians.sh.extend(std::iter::repeat_n(0.0, 3 * (coefficients - 1)));
    })?;
    if let Some(colour) = colour {
        let mut sh = gaussians.sh.chunks_exact_mut(3 * coefficients);
        body.rows(colour, |row| {
            for (value, property) in sh.next().into_iter().flat_map(|s| &mut s[3..]).zip(&rest) {
                *value = unpack_coefficient(property.value(row)) as f32;
            }
        })?;
    }
    body.check_end()?;
    reading.accept(gaussians, &|field| file_name(field, sh_degree))
}

/// Columns of the coefficients above degree 0, coefficient-major, then red, green, blue.
fn higher_degrees(colour: &Element, sh_degree: u8) -> Result<Vec<Property>, IngestError> {
    let fields =
        (1..sh::coefficients(sh_degree)).flat_map(|k| (0..3).map(move |c| Field::Sh(k, c)));
    fields.map(|field| colour.property(&file_name(field, sh_degree)).cloned()).collect()
}

/// The tables chunk, vertex, and (if there is one) sh, in that order and of matching lengths.
fn tables(header: &Header) -> Result<(&Element, &Element, Option<&Element>), IngestError> {
    let bad = |reason: String| error("compressed elements".into(), reason);
    let known = |element: &&Element| {
        element.count > 0 || ["chunk", "vertex", "sh"].contains(&element.name.as_str())
    };
    let elements: Vec<&Element> = header.elements.iter().filter(known).collect();
    let (chunk, vertex, colour) = match elements[..] {
        [chunk, vertex] => (chunk, vertex, None),
        [chunk, vertex, colour] => (chunk, vertex, Some(colour)),
        _ => return Err(bad("chunk, vertex and perhaps sh are expected".into())),
    };
    let names = [chunk.name.as_str(), &vertex.name, colour.map_or("sh", |sh| &sh.name)];
    if names != ["chunk", "vertex", "sh"] {
        return Err(bad(format!("{} must be chunk, vertex, sh", names.join(", "))));
    }
    if chunk.count != vertex.count.div_ceil(CHUNK as u64) {
        let chunks = chunk.count;
        let count = vertex.count;
        return Err(bad(format!("{chunks} chunks of {CHUNK} do not make {count} vertices")));
    }
    match colour {
        Some(sh) if sh.count != vertex.count => {
            Err(bad(format!("{} rows of sh for {} vertices", sh.count, vertex.count)))
        }
        _ => Ok((chunk, vertex, colour)),
    }
}

/// Columns of a chunk's smallest and largest position, ln scale, and colour, in that order.
struct ValueRanges([Vec<Property>; 2]);

impl ValueRanges {
    fn find(chunk: &Element) -> Result<Self, IngestError> {
        let fields = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
        let find = |end: &str| {
            let names = fields.iter().map(|field| format!("{end}_{field}"));
            names.map(|name| chunk.property(&name).cloned()).collect::<Result<Vec<_>, _>>()
        };
        Ok(Self([find("min")?, find("max")?]))
    }

    fn value(&self, row: &[u8]) -> [[f64; 9]; 2] {
        [0, 1].map(|end| std::array::from_fn(|i| self.0[end][i].value(row)))
    }
}

/// The lowest `bits` bits of `word`, as a fraction of their largest value.
fn unit(word: u32, bits: u32) -> f64 {
    let largest = (1 << bits) - 1;
    f64::from(word & largest) / f64::from(largest)
}

fn unpack_11_10_11(word: u32) -> [f64; 3] {
    [unit(word >> 21, 11), unit(word >> 11, 10), unit(word, 11)]
}

/// The largest component is omitted, so the others are within ±√½.
fn unpack_rotation(word: u32) -> [f32; 4] {
    let others = [20, 10, 0].map(|shift| (unit(word >> shift, 10) - 0.5) * 2f64.sqrt());
    activation::quat_of_smallest_three((word >> 30) as usize, others)
}

/// Decodes 8 bits over [-4, 4]: 0 and 255 are the ends exactly, other values are at the middle of
/// their step.
fn unpack_coefficient(byte: f64) -> f64 {
    let unit = match byte {
        0.0 => 0.0,
        255.0 => 1.0,
        byte => (byte + 0.5) / 256.0,
    };
    8.0 * (unit - 0.5)
}
