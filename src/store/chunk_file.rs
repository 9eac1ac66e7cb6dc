//! The chunk object: one cell, all its blocks and levels of detail.
//!
//! ```text
//! 0      magic "WILDCHNK", format u32, length of the table of contents u32, its BLAKE3, zeros
//! 4096   table of contents (bincode), zeros up to a multiple of 4096
//! ...    sections, coarse levels first: one level of one block each, so that the start of the
//!        object holds whole levels. One that fits into the rest of a page lies there, any other
//!        begins a page: no section touches more pages than it must.
//! ```
//!
//! A section is one part after the other of up to 65,536 Gaussians: length u32, and that many bytes
//! of zstd, of what `scene::record` says. Any section can be read, checked and decoded by itself.
//!
//! The tables of all chunks together are the table that a manifest names.

use std::io::{self, Write};

use bincode::config::Config;
use bincode::{Decode, Encode};
use glam::DVec3;

use crate::config;
use crate::geometry::Bounds;
use crate::scene::chunk::{Chunk, LANES, Lanes, columns};
use crate::scene::manifest::{ChunkEntry, Section};
use crate::scene::record::{Clamped, PART, Record};

const MAGIC: [u8; 8] = *b"WILDCHNK";
/// The layout that this build reads and writes.
pub(super) const FORMAT: u32 = 1;
/// Sections that start on pages can be mapped and read past the cache.
pub(super) const PAGE_BYTES: usize = 4096;
/// Higher levels of zstd gain nothing on columns of noise and trends.
const ZSTD_LEVEL: i32 = 1;

/// A section before it has a place.
#[derive(Debug)]
pub(super) struct Packed {
    section: Section,
    bytes: Vec<u8>,
    bounds: Bounds,
}

/// What a table says of one cell.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
struct Contents {
    cell: [i32; 2],
    origin_m: [f64; 3],
    sh_degree: u8,
    record: u8,
    sections: Vec<Row>,
}

/// A [`Section`], on disk.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
struct Row {
    block: u8,
    level: u8,
    count: u32,
    error_m: f32,
    min_m: [f32; 3],
    max_m: [f32; 3],
    offset_bytes: u64,
    bytes: u32,
    hash: [u8; 32],
}

/// Codes and compresses one level of one block.
///
/// # Errors
/// More than 4 GiB: the block is denser than anything.
pub(super) fn pack(
    chunk: &Chunk,
    [block, level]: [u8; 2],
    error_m: f32,
    record: Record,
    clamped: &mut Clamped,
) -> io::Result<Packed> {
    let mut bytes = Vec::new();
    for start in (0..chunk.len()).step_by(PART) {
        let part = record.encode(chunk, start..chunk.len().min(start + PART), clamped);
        let part = zstd::bulk::compress(&part, ZSTD_LEVEL)?;
        bytes.extend((part.len() as u32).to_le_bytes());
        bytes.extend(part);
    }
    let mut bounds = Bounds::EMPTY;
    for index in 0..chunk.len() {
        let mean_m = [0, 1, 2].map(|axis| f64::from(chunk.value(index, axis)));
        bounds.add(DVec3::from_array(mean_m), chunk.reach_m(index));
    }
    let section = Section {
        block,
        level,
        count: chunk.len() as u32,
        error_m,
        // Rounded outwards: nothing reaches beyond its box.
        min_m: bounds.min_m.to_array().map(|m| (m as f32).next_down()),
        max_m: bounds.max_m.to_array().map(|m| (m as f32).next_up()),
        offset_bytes: 0,
        bytes: u32::try_from(bytes.len()).map_err(io::Error::other)?,
        hash: *blake3::hash(&bytes).as_bytes(),
    };
    Ok(Packed { section, bytes, bounds })
}

/// Writes the object of one cell. Returns what is in it, in order of (block, level), and the box of
/// its Gaussians in the world.
pub(super) fn write(
    out: &mut dyn Write,
    (cell, origin_m): ([i32; 2], DVec3),
    sh_degree: u8,
    record: Record,
    mut packed: Vec<Packed>,
) -> io::Result<(Vec<Section>, Bounds)> {
    packed.sort_by_key(|packed| (std::cmp::Reverse(packed.section.level), packed.section.block));
    let mut contents = Contents {
        cell,
        origin_m: origin_m.to_array(),
        sh_degree,
        record: record as u8,
        sections: packed.iter().map(|packed| Row::of(&packed.section)).collect(),
    };
    // Integers have a fixed size, so that the places do not change the table's own size.
    let table_bytes = encode(&contents)?.len();
    let mut end = (PAGE_BYTES + table_bytes).next_multiple_of(PAGE_BYTES) as u64;
    for row in &mut contents.sections {
        row.offset_bytes = place(end, row.bytes);
        end = row.offset_bytes + u64::from(row.bytes);
    }
    let table = encode(&contents)?;
    let mut page = [0; PAGE_BYTES];
    page[..8].copy_from_slice(&MAGIC);
    page[8..12].copy_from_slice(&FORMAT.to_le_bytes());
    page[12..16].copy_from_slice(&(table.len() as u32).to_le_bytes());
    page[16..48].copy_from_slice(blake3::hash(&table).as_bytes());
    out.write_all(&page)?;
    out.write_all(&table)?;
    let mut written = (PAGE_BYTES + table.len()) as u64;
    let mut bounds = Bounds::EMPTY;
    for (packed, row) in packed.iter().zip(&contents.sections) {
        // Less than a page.
        out.write_all(&[0; PAGE_BYTES][..(row.offset_bytes - written) as usize])?;
        out.write_all(&packed.bytes)?;
        written = row.offset_bytes + u64::from(row.bytes);
        if packed.section.level == 0 {
            bounds = bounds.union(&packed.bounds);
        }
    }
    let bounds = Bounds { min_m: origin_m + bounds.min_m, max_m: origin_m + bounds.max_m };
    Ok((contents.in_order(), bounds))
}

/// Where a section goes that follows one that ends at `end`.
fn place(end: u64, bytes: u32) -> u64 {
    let page = PAGE_BYTES as u64;
    let rest = end.next_multiple_of(page) - end;
    if u64::from(bytes) <= rest { end } else { end + rest }
}

/// Decodes a section, whose bytes have the hash that they should.
///
/// # Errors
/// Says what is wrong with it. Memory is taken part by part, as the bytes for it turn up.
pub(super) fn unpack(
    bytes: &[u8],
    chunk: &ChunkEntry,
    section: &Section,
    sh_degree: u8,
    record: Record,
) -> Result<Chunk, String> {
    let count = section.count as usize;
    let width = columns(sh_degree);
    let mut lanes = Vec::new();
    let mut rest = bytes;
    for start in (0..count).step_by(PART) {
        let here = (count - start).min(PART);
        let (length, after) = rest.split_first_chunk().ok_or("it ends before its last part")?;
        let length = u32::from_le_bytes(*length) as usize;
        let part = after.get(..length).ok_or("it ends within a part")?;
        rest = &after[length..];
        let raw = zstd::bulk::decompress(part, record.part_bytes(sh_degree, here));
        let raw = raw.map_err(|error| format!("a part does not decompress: {error}"))?;
        let first = lanes.len();
        lanes.resize(first + here.div_ceil(LANES) * width, Lanes([0.0; LANES]));
        record.decode(&raw, sh_degree, here, &mut lanes[first..])?;
    }
    if !rest.is_empty() {
        return Err(format!("{} bytes are left over", rest.len()));
    }
    Ok(Chunk::from_lanes(chunk.cell, chunk.origin_m, sh_degree, count, lanes))
}

/// The table of all chunks.
pub(super) fn table(chunks: &[ChunkEntry], sh_degree: u8, record: Record) -> io::Result<Vec<u8>> {
    let mut table = Vec::new();
    for chunk in chunks {
        let sections = chunk.sections.iter().map(Row::of).collect();
        let (cell, origin_m) = (chunk.cell, chunk.origin_m.to_array());
        let contents = Contents { cell, origin_m, sh_degree, record: record as u8, sections };
        table.extend(encode(&contents)?);
    }
    Ok(table)
}

/// Fills in the sections of chunks from the table of all.
///
/// # Errors
/// Says what is wrong with the table.
pub(super) fn fill(
    chunks: &mut [ChunkEntry],
    sh_degree: u8,
    record: Record,
    mut table: &[u8],
) -> Result<(), String> {
    for chunk in chunks {
        let (contents, consumed) = decode(table)?;
        table = &table[consumed..];
        let found = (contents.cell, contents.origin_m, contents.sh_degree, contents.record);
        if found != (chunk.cell, chunk.origin_m.to_array(), sh_degree, record as u8) {
            return Err(format!("it says something else of cell {:?}", chunk.cell));
        }
        chunk.sections = contents.in_order();
        let full = chunk.sections.iter().filter(|section| section.level == 0);
        let count: u64 = full.map(|section| u64::from(section.count)).sum();
        if count != chunk.count {
            return Err(format!("it has {count} Gaussians of {} in {:?}", chunk.count, chunk.cell));
        }
        check_levels(chunk)?;
    }
    if table.is_empty() { Ok(()) } else { Err("it has more cells than the manifest".into()) }
}

/// Whether an object's own table says what the manifest's does. `start` is the object's start, as
/// long as it is, up to [`config::CHUNK_TABLE_BYTES`] and a page.
///
/// # Errors
/// Says what is wrong.
pub(super) fn check_start(start: &[u8], chunk: &ChunkEntry) -> Result<(), String> {
    let (page, rest) =
        start.split_first_chunk::<PAGE_BYTES>().ok_or("it is shorter than a page")?;
    if page[..8] != MAGIC {
        return Err("it does not start as a chunk".into());
    }
    let word = |at: usize| u32::from_le_bytes([page[at], page[at + 1], page[at + 2], page[at + 3]]);
    if word(8) != FORMAT {
        return Err(format!("it has format {}; this build reads format {FORMAT}", word(8)));
    }
    let table = rest.get(..word(12) as usize).ok_or("its table is longer than it may be")?;
    if page[16..48] != *blake3::hash(table).as_bytes() {
        return Err("its table of contents has another hash".into());
    }
    let (contents, consumed) = decode(table)?;
    let same = consumed == table.len()
        && (contents.cell, contents.origin_m) == (chunk.cell, chunk.origin_m.to_array())
        && contents.in_order() == chunk.sections;
    if same { Ok(()) } else { Err("its table of contents is not the manifest's".into()) }
}

/// Every block has level 0 without error, and then levels in a row with rising errors.
fn check_levels(chunk: &ChunkEntry) -> Result<(), String> {
    for block in chunk.sections.chunk_by(|a, b| a.block == b.block) {
        let numbered = block.iter().enumerate().all(|(k, section)| usize::from(section.level) == k);
        // Phrased as what must hold, so that NaN fails it.
        let rising = block.is_sorted_by(|a, b| a.error_m <= b.error_m) && block[0].error_m == 0.0;
        let finite = block.iter().all(|section| {
            section.min_m.iter().chain(&section.max_m).all(|m| m.is_finite())
                && section.error_m.is_finite()
        });
        if !(numbered && rising && finite) {
            return Err(format!(
                "block {} of cell {:?} has wrong levels",
                block[0].block, chunk.cell
            ));
        }
    }
    Ok(())
}

impl Contents {
    fn in_order(&self) -> Vec<Section> {
        let mut sections: Vec<Section> = self.sections.iter().map(Row::section).collect();
        sections.sort_by_key(|section| (section.block, section.level));
        sections
    }
}

impl Row {
    fn of(section: &Section) -> Self {
        let Section { block, level, count, error_m, min_m, max_m, offset_bytes, bytes, hash } =
            *section;
        Self { block, level, count, error_m, min_m, max_m, offset_bytes, bytes, hash }
    }

    fn section(&self) -> Section {
        let Self { block, level, count, error_m, min_m, max_m, offset_bytes, bytes, hash } = *self;
        Section { block, level, count, error_m, min_m, max_m, offset_bytes, bytes, hash }
    }
}

fn encode(contents: &Contents) -> io::Result<Vec<u8>> {
    bincode::encode_to_vec(contents, encoding()).map_err(io::Error::other)
}

fn decode(bytes: &[u8]) -> Result<(Contents, usize), String> {
    bincode::decode_from_slice(bytes, encoding())
        .map_err(|error| format!("a table of contents does not decode: {error}"))
}

/// Fixed-size integers, and a limit, without which a short message may ask for any allocation.
fn encoding() -> impl Config {
    const LIMIT: usize = config::CHUNK_TABLE_BYTES;
    bincode::config::standard().with_fixed_int_encoding().with_limit::<LIMIT>()
}
