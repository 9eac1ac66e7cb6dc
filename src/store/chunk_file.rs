//! The chunk object: a header page and F32 records.
//!
//! ```text
//! 0      magic "WILDCHNK", format u32, header length u32, header (bincode), zeros up to 4096
//! 4096   count records of little-endian f32: mean relative to the origin (x, y, z), quaternion
//!        (w, x, y, z), ln scale (3), logit opacity, SH [(degree + 1)^2, 3]: 92 B at degree 1
//! ```

use std::io::{self, Read, Write};

use bincode::{Decode, Encode};
use glam::DVec3;

use crate::scene::Gaussians;
use crate::scene::chunk::{CellRun, Chunk, RawRecord};
use crate::scene::sh;

const MAGIC: [u8; 8] = *b"WILDCHNK";
/// The layout that this build reads and writes.
pub(super) const FORMAT: u32 = 0;
/// One page: sections that start on pages can be mapped and read past the cache.
const PAGE_BYTES: usize = 4096;
/// Magic, format and header length.
const PREFIX_BYTES: usize = 16;
/// Records that are read at once: 4,096 of degree 1 are 377 KB.
const BATCH: usize = 4096;

/// What the header page says.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
struct Header {
    cell: [i32; 2],
    origin_m: [f64; 3],
    sh_degree: u8,
    count: u64,
}

/// Why a chunk object cannot be read.
#[derive(Debug)]
pub(super) enum ReadError {
    Io(io::Error),
    Damaged(String),
    Format(u32),
}

/// Writes the chunk of one cell, one record at a time.
pub(super) fn write(
    out: &mut dyn Write,
    cell: &CellRun,
    gaussians: &Gaussians,
    order: &[u32],
    mut written: impl FnMut(),
) -> io::Result<()> {
    let header = Header {
        cell: cell.cell,
        origin_m: cell.origin_m.to_array(),
        sh_degree: gaussians.sh_degree,
        count: order.len() as u64,
    };
    out.write_all(&header_page(&header)?)?;
    let mut bytes = Vec::with_capacity(record_bytes(gaussians.sh_degree));
    for &index in order {
        let record = cell.record(gaussians, index as usize);
        bytes.clear();
        let logit = [record.logit_opacity];
        let fields: [&[f32]; 5] =
            [&record.mean_m, &record.quat_wxyz, &record.ln_scale, &logit, record.sh];
        for value in fields.into_iter().flatten() {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        out.write_all(&bytes)?;
        written();
    }
    Ok(())
}

/// Reads a chunk object of `total_bytes`, activating record by record: the only copy in memory.
pub(super) fn read(input: &mut impl Read, total_bytes: u64) -> Result<Chunk, ReadError> {
    let mut page = [0; PAGE_BYTES];
    input.read_exact(&mut page).map_err(ReadError::Io)?;
    let Header { cell, origin_m, sh_degree, count } = parse_page(&page)?;
    if sh_degree > sh::MAX_DEGREE {
        return Err(ReadError::Damaged(format!("SH degree is {sh_degree}, not 0 to 3")));
    }
    let stride = record_bytes(sh_degree);
    let wanted = count.checked_mul(stride as u64).and_then(|b| b.checked_add(PAGE_BYTES as u64));
    if wanted != Some(total_bytes) {
        let reason = format!("{count} Gaussians of degree {sh_degree} are not {total_bytes} bytes");
        return Err(ReadError::Damaged(reason));
    }
    // The count is now known to fit a file, and so a usize.
    let mut left = count as usize;
    let mut chunk = Chunk::new(cell, DVec3::from_array(origin_m), sh_degree, left);
    let mut bytes = vec![0; stride * left.min(BATCH)];
    let mut values = vec![0.0; stride / 4];
    while left > 0 {
        let batch = &mut bytes[..stride * left.min(BATCH)];
        input.read_exact(batch).map_err(ReadError::Io)?;
        for record in batch.chunks_exact(stride) {
            for (value, bytes) in values.iter_mut().zip(record.as_chunks().0) {
                *value = f32::from_le_bytes(*bytes);
            }
            chunk.push(&RawRecord {
                mean_m: [values[0], values[1], values[2]],
                quat_wxyz: [values[3], values[4], values[5], values[6]],
                ln_scale: [values[7], values[8], values[9]],
                logit_opacity: values[10],
                sh: &values[11..],
            });
        }
        left -= batch.len() / stride;
    }
    Ok(chunk)
}

/// Bytes of one record: 11 floats and three per colour coefficient.
fn record_bytes(sh_degree: u8) -> usize {
    4 * crate::scene::chunk::columns(sh_degree)
}

fn header_page(header: &Header) -> io::Result<[u8; PAGE_BYTES]> {
    let mut page = [0; PAGE_BYTES];
    let length = bincode::encode_into_slice(header, &mut page[PREFIX_BYTES..], encoding())
        .map_err(io::Error::other)?;
    page[..8].copy_from_slice(&MAGIC);
    page[8..12].copy_from_slice(&FORMAT.to_le_bytes());
    page[12..16].copy_from_slice(&(length as u32).to_le_bytes());
    Ok(page)
}

fn parse_page(page: &[u8; PAGE_BYTES]) -> Result<Header, ReadError> {
    let damaged = |reason: &str| ReadError::Damaged(reason.to_owned());
    if page[..8] != MAGIC {
        return Err(damaged("it does not start as a chunk"));
    }
    let word = |at: usize| u32::from_le_bytes([page[at], page[at + 1], page[at + 2], page[at + 3]]);
    if word(8) != FORMAT {
        return Err(ReadError::Format(word(8)));
    }
    let body = page[PREFIX_BYTES..].get(..word(12) as usize);
    let body = body.ok_or_else(|| damaged("its header is longer than a page"))?;
    let (header, consumed) = bincode::decode_from_slice(body, encoding())
        .map_err(|e| ReadError::Damaged(format!("its header does not decode: {e}")))?;
    if consumed != body.len() {
        return Err(damaged("its header has bytes that mean nothing"));
    }
    Ok(header)
}

/// Fixed-size integers, and a limit, without which a short message may ask for any allocation.
fn encoding() -> impl bincode::config::Config {
    const LIMIT: usize = PAGE_BYTES - PREFIX_BYTES;
    bincode::config::standard().with_fixed_int_encoding().with_limit::<LIMIT>()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> Header {
        Header { cell: [3, -4], origin_m: [192.0, -256.0, 64.0], sh_degree: 1, count: 0 }
    }

    /// What is wrong with a header page after a change.
    fn refused(change: impl FnOnce(&mut [u8; PAGE_BYTES])) -> String {
        let mut page = header_page(&header()).unwrap();
        change(&mut page);
        match read(&mut &page[..], PAGE_BYTES as u64).unwrap_err() {
            ReadError::Io(error) => error.to_string(),
            ReadError::Damaged(reason) => reason,
            ReadError::Format(found) => format!("format {found}"),
        }
    }

    #[test]
    fn a_header_fills_one_page() {
        let page = header_page(&header()).unwrap();
        assert_eq!(parse_page(&page).unwrap(), header());
        // Two i32, three f64, a u8 and a u64.
        assert_eq!(page[12..16], 41_u32.to_le_bytes());
        assert_eq!(page[PREFIX_BYTES + 41..], [0; PAGE_BYTES - PREFIX_BYTES - 41]);
        let chunk = read(&mut &page[..], PAGE_BYTES as u64).unwrap();
        assert_eq!((chunk.cell(), chunk.len()), ([3, -4], 0));
    }

    #[test]
    fn a_header_that_lies_is_refused() {
        assert_eq!(refused(|page| page[0] = b'X'), "it does not start as a chunk");
        assert_eq!(refused(|page| page[8] = 7), "format 7");
        assert_eq!(refused(|page| page[14] = 1), "its header is longer than a page");
        assert_eq!(refused(|page| page[12] = 42), "its header has bytes that mean nothing");
        assert!(refused(|page| page[12] = 40).starts_with("its header does not decode"));
        let degree = PREFIX_BYTES + 32;
        assert_eq!(refused(|page| page[degree] = 4), "SH degree is 4, not 0 to 3");
        // 2^56 Gaussians, and a count whose size overflows: nothing is allocated for them.
        assert!(refused(|page| page[degree + 8] = 1).contains("are not 4096 bytes"));
        assert!(refused(|page| page[degree + 1..degree + 9].fill(255)).contains("are not 4096"));
    }
}
