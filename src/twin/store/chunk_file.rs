//! The chunk object: one cell with all its blocks and levels of detail.
//!
//! ```text
//! 0      magic "WILDCHNK", format u32, length of the table of contents u32, its BLAKE3, zeros
//! 4096   table of contents (bincode), zeros up to a multiple of 4096
//! ...    sections, coarse levels first, so that the start of the object holds whole levels. A section is one
//!        level of one block. One that fits into the rest of a page is placed there, any other
//!        begins a page: no section touches more pages than it must. Coarse levels of a sparse block
//!        have 200 B, so a page for every section would be mostly zeros.
//! ```
//!
//! A section is a sequence of parts of up to 65,536 Gaussians each: a length u32, and that many
//! bytes of zstd-compressed records (`scene::record`). Any section can be read, checked, and
//! decoded by itself. Where the Gaussians of a cell have classes, the records of a part end with
//! one byte of class for each; a table of contents says it by a bit beside the record format.
//!
//! The tables of all chunks together are the table that a manifest names. It is an object of its
//! own, 78 bytes a section, because as JSON 100,000 sections would take 25 MB. Each chunk object
//! repeats its own part of the table, so that it can be read without the manifest; `verify`
//! compares the two.
//!
//! A section is read, decoded, and drawn as one unit: one level of detail of one block of 16 m,
//! within a cell of 64 m. It becomes one `scene::Chunk`, so the renderer does not depend on levels.
//! A sparse cell, such as one of a skyline, is a single block: as 3,000 blocks of three Gaussians
//! each, the demo street's skyline took 9 ms of every frame.

use std::cell::RefCell;
use std::io::{self, Write};
use std::sync::Arc;

use bincode::config::Config;
use bincode::{Decode, Encode};
use glam::DVec3;
use zstd::bulk::Decompressor;

use crate::limits;
use wildcity_scene::SemanticClass;
use wildcity_scene::chunk::{Chunk, columns};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::{ChunkEntry, Section};
use wildcity_scene::pages::{LanePages, PagePool};
use wildcity_scene::record::{Clamped, PART_GAUSSIANS, RecordFormat};

const MAGIC: [u8; 8] = *b"WILDCHNK";
/// The layout that this build reads and writes.
pub(super) const FORMAT: u32 = 1;
/// Sections that start on pages can be memory-mapped, or read with direct I/O.
pub(super) const PAGE_BYTES: usize = 4096;
/// The bit of [`Contents::record`] that says that the Gaussians have classes.
const CLASSES: u8 = 0x80;
/// Higher compression levels do not make these columns smaller: they are noise around slow trends.
const ZSTD_LEVEL: i32 = 1;

/// A section that has no offset yet.
#[derive(Debug)]
pub(super) struct PackedSection {
    section: Section,
    bytes: Vec<u8>,
    bounds: Bounds,
}

impl PackedSection {
    /// Its bytes in the object.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }
}

/// The properties that all sections of a chunk object share.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChunkHeader {
    pub(super) cell: [i32; 2],
    pub(super) origin_m: DVec3,
    pub(super) sh_degree: u8,
    pub(super) record: RecordFormat,
    /// Whether the Gaussians have classes.
    pub(super) classes: bool,
}

/// One level of detail of one block.
#[derive(Clone, Copy, Debug)]
pub(super) struct LevelOfBlock {
    pub(super) block: u8,
    pub(super) level: u8,
    /// Upper bound of its geometric error against level 0, in metres.
    pub(super) error_m: f32,
}

/// The table of contents of one cell.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
struct Contents {
    cell: [i32; 2],
    origin_m: [f64; 3],
    sh_degree: u8,
    record: u8,
    sections: Vec<Row>,
}

/// A [`Section`] as stored.
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

/// Encodes and compresses one level of one block.
///
/// # Errors
/// The section would take more than 4 GiB.
pub(super) fn pack(
    chunk: &Chunk,
    LevelOfBlock { block, level, error_m }: LevelOfBlock,
    record: RecordFormat,
    clamped: &mut Clamped,
) -> io::Result<PackedSection> {
    let mut bytes = Vec::new();
    // Parts are compressed on their own, so that decoding needs memory for one part and not for the
    // section.
    for start in (0..chunk.len()).step_by(PART_GAUSSIANS) {
        let run = start..chunk.len().min(start + PART_GAUSSIANS);
        let mut part = record.encode(chunk, run.clone(), clamped);
        let classes = chunk.classes().map_or(&[][..], |classes| &classes[run]);
        part.extend(classes.iter().map(|class| class.value()));
        let part = zstd::bulk::compress(&part, ZSTD_LEVEL)?;
        // 65,536 records of at most 237 B are 15 MB, so that the length fits.
        bytes.extend((part.len() as u32).to_le_bytes());
        bytes.extend(part);
    }
    let mut bounds = Bounds::EMPTY;
    for index in 0..chunk.len() {
        // Relative to the cell's origin, as all values of a chunk are.
        let mean_m = [0, 1, 2].map(|axis| f64::from(chunk.value(index, axis)));
        bounds.add(DVec3::from_array(mean_m), chunk.half_extent_m(index));
    }
    let section = Section {
        block,
        level,
        count: chunk.len() as u32,
        error_m,
        // Rounded outwards, so that nothing reaches beyond its box.
        min_m: bounds.min_m.to_array().map(|m| (m as f32).next_down()),
        max_m: bounds.max_m.to_array().map(|m| (m as f32).next_up()),
        offset_bytes: 0,
        bytes: u32::try_from(bytes.len()).map_err(io::Error::other)?,
        hash: *blake3::hash(&bytes).as_bytes(),
    };
    Ok(PackedSection { section, bytes, bounds })
}

/// Writes the object of one cell. Returns what is in it, in order of (block, level), and the box of
/// its Gaussians in the world.
pub(super) fn write(
    out: &mut dyn Write,
    &ChunkHeader { cell, origin_m, sh_degree, record, classes }: &ChunkHeader,
    mut packed: Vec<PackedSection>,
) -> io::Result<(Vec<Section>, Bounds)> {
    // Levels from coarse to fine, and blocks in order within a level: the same content gives the
    // same bytes.
    packed.sort_by_key(|packed| (std::cmp::Reverse(packed.section.level), packed.section.block));
    let mut contents = Contents {
        cell,
        origin_m: origin_m.to_array(),
        sh_degree,
        record: record_byte(record, classes),
        sections: packed.iter().map(|packed| Row::from_section(&packed.section)).collect(),
    };

    // Give each section its offset. Integers have a fixed size, so the offsets do not change the
    // table's own size.
    let table_bytes = encode(&contents)?.len();
    let mut end = (PAGE_BYTES + table_bytes).next_multiple_of(PAGE_BYTES) as u64;
    for row in &mut contents.sections {
        row.offset_bytes = place(end, row.bytes);
        end = row.offset_bytes + u64::from(row.bytes);
    }

    // The first page, and the table of contents.
    let table = encode(&contents)?;
    let mut page = [0; PAGE_BYTES];
    page[..8].copy_from_slice(&MAGIC);
    page[8..12].copy_from_slice(&FORMAT.to_le_bytes());
    page[12..16].copy_from_slice(&(table.len() as u32).to_le_bytes());
    page[16..48].copy_from_slice(blake3::hash(&table).as_bytes());
    out.write_all(&page)?;
    out.write_all(&table)?;

    // The sections, with zeros between them.
    let mut written = (PAGE_BYTES + table.len()) as u64;
    let mut bounds = Bounds::EMPTY;
    for (packed, row) in packed.iter().zip(&contents.sections) {
        // The gap is less than a page.
        out.write_all(&[0; PAGE_BYTES][..(row.offset_bytes - written) as usize])?;
        out.write_all(&packed.bytes)?;
        written = row.offset_bytes + u64::from(row.bytes);
        // The cell's box is that of its full detail.
        if packed.section.is_full_detail() {
            bounds = bounds.union(&packed.bounds);
        }
    }
    let bounds = Bounds { min_m: origin_m + bounds.min_m, max_m: origin_m + bounds.max_m };
    Ok((contents.in_order(), bounds))
}

/// The offset of a section of `bytes` that follows one that ends at `end`.
fn place(end: u64, bytes: u32) -> u64 {
    let page = PAGE_BYTES as u64;
    // 0 if `end` is the end of a page: any section then begins the next one.
    let rest = end.next_multiple_of(page) - end;
    if u64::from(bytes) <= rest { end } else { end + rest }
}

/// Decodes a section. The caller has compared its bytes with their hash.
///
/// # Errors
/// Says what is wrong with it. Memory is allocated part by part, so that a short input with a large
/// count allocates little.
pub(super) fn unpack(
    bytes: &[u8],
    chunk: &ChunkEntry,
    section: &Section,
    sh_degree: u8,
    record: RecordFormat,
    pool: Option<Arc<PagePool>>,
) -> Result<Chunk, String> {
    let mut lanes = LanePages::new(columns(sh_degree), pool);
    let mut classes = chunk.classes.then(Vec::new);
    for_each_part(bytes, chunk, section, sh_degree, record, |part| {
        part.decode(&mut lanes, classes.as_mut())
    })?;
    let count = section.count as usize;
    let unpacked = Chunk::from_lanes(chunk.cell, chunk.origin_m, sh_degree, count, lanes);
    Ok(unpacked.with_classes(classes))
}

/// As [`unpack`], part by part: `visit` sees chunks of at most [`PART_GAUSSIANS`], in order.
///
/// # Errors
/// As [`unpack`]. Parts before a damaged one have been shown by then.
pub(super) fn unpack_parts(
    bytes: &[u8],
    chunk: &ChunkEntry,
    section: &Section,
    sh_degree: u8,
    record: RecordFormat,
    pool: &Arc<PagePool>,
    visit: &mut dyn FnMut(&Chunk),
) -> Result<(), String> {
    for_each_part(bytes, chunk, section, sh_degree, record, |part| {
        let mut lanes = LanePages::new(columns(sh_degree), Some(pool.clone()));
        let mut classes = chunk.classes.then(Vec::new);
        part.decode(&mut lanes, classes.as_mut())?;
        let unpacked = Chunk::from_lanes(chunk.cell, chunk.origin_m, sh_degree, part.count, lanes);
        visit(&unpacked.with_classes(classes));
        Ok(())
    })
}

/// A part of a section, decompressed.
struct Part<'a> {
    records: &'a [u8],
    /// One byte for each Gaussian, or none.
    classes: &'a [u8],
    sh_degree: u8,
    record: RecordFormat,
    count: usize,
}

impl Part<'_> {
    fn decode(
        &self,
        lanes: &mut LanePages,
        classes: Option<&mut Vec<SemanticClass>>,
    ) -> Result<(), String> {
        self.record.decode(self.records, self.sh_degree, self.count, lanes)?;
        // Decoded, the records have their size, and so have the classes.
        classes.map_or(Ok(()), |classes| read_classes(self.classes, classes))
    }
}

/// Passes the parts of a section on, in order.
fn for_each_part(
    bytes: &[u8],
    chunk: &ChunkEntry,
    section: &Section,
    sh_degree: u8,
    record: RecordFormat,
    mut visit: impl FnMut(&Part<'_>) -> Result<(), String>,
) -> Result<(), String> {
    let count = section.count as usize;
    let mut rest = bytes;
    // Invariant: `rest` begins with the length of the next part.
    for start in (0..count).step_by(PART_GAUSSIANS) {
        let here = (count - start).min(PART_GAUSSIANS);
        let (length, after) = rest.split_first_chunk().ok_or("it ends before its last part")?;
        let length = u32::from_le_bytes(*length) as usize;
        let part = after.get(..length).ok_or("it ends within a part")?;
        rest = &after[length..];
        // The size of a part follows from its count. A part that unpacks to more does not fit into
        // the buffer, and is refused.
        let classes_bytes = if chunk.classes { here } else { 0 };
        let capacity = record.part_bytes(sh_degree, here) + classes_bytes;
        decompressed(part, capacity, |raw| {
            let raw = raw.map_err(|error| format!("a part does not decompress: {error}"))?;
            // A part that is shorter than its classes has no records, and decoding refuses it.
            let (records, classes) = raw.split_at(raw.len().saturating_sub(classes_bytes));
            visit(&Part { records, classes, sh_degree, record, count: here })
        })?;
    }
    if rest.is_empty() { Ok(()) } else { Err(format!("{} bytes are left over", rest.len())) }
}

/// Appends the classes of a part, given their values.
fn read_classes(values: &[u8], classes: &mut Vec<SemanticClass>) -> Result<(), String> {
    classes.reserve_exact(values.len());
    for &value in values {
        let class = SemanticClass::for_gaussian(value);
        classes.push(class.ok_or_else(|| format!("no Gaussian has class {value}"))?);
    }
    Ok(())
}

/// The byte of a table of contents that says how Gaussians are encoded, and whether they have
/// classes: a reader from before there were any refuses these.
fn record_byte(record: RecordFormat, classes: bool) -> u8 {
    record as u8 | if classes { CLASSES } else { 0 }
}

/// Passes one part of up to `capacity` bytes on, decompressed.
///
/// Each thread keeps a context of 160 kB and the bytes of its largest part. To make a context for
/// each section took a twentieth of the time of loading, and parts of all sizes would leave holes
/// between the pages of sections.
fn decompressed<T>(part: &[u8], capacity: usize, take: impl FnOnce(io::Result<&[u8]>) -> T) -> T {
    thread_local! {
        static KEPT: RefCell<(Option<Decompressor<'static>>, Vec<u8>)> =
            const { RefCell::new((None, Vec::new())) };
    }
    // Taken out, so that what receives the bytes may read another section.
    let (mut decompressor, mut kept) = KEPT.take();
    // It grows to the largest part of the process and never shrinks: some megabytes a thread.
    if kept.len() < capacity {
        kept.reserve_exact(capacity - kept.len());
        kept.resize(capacity, 0);
    }
    let raw = &mut kept[..capacity];
    let mut decompress = || -> io::Result<usize> {
        let decompressor = match &mut decompressor {
            Some(decompressor) => decompressor,
            None => decompressor.insert(Decompressor::new()?),
        };
        decompressor.decompress_to_buffer(part, raw)
    };
    let taken = match decompress() {
        Ok(length) => take(Ok(&kept[..length])),
        Err(error) => take(Err(error)),
    };
    KEPT.set((decompressor, kept));
    taken
}

/// The table of all chunks.
pub(super) fn table(
    chunks: &[ChunkEntry],
    sh_degree: u8,
    record: RecordFormat,
) -> io::Result<Vec<u8>> {
    let mut table = Vec::new();
    for chunk in chunks {
        let sections = chunk.sections.iter().map(Row::from_section).collect();
        let contents = Contents {
            cell: chunk.cell,
            origin_m: chunk.origin_m.to_array(),
            sh_degree,
            record: record_byte(record, chunk.classes),
            sections,
        };
        table.extend(encode(&contents)?);
    }
    Ok(table)
}

/// Fills in the sections of chunks from the table of all chunks.
///
/// # Errors
/// Says what is wrong with the table.
pub(super) fn fill(
    chunks: &mut [ChunkEntry],
    sh_degree: u8,
    record: RecordFormat,
    mut table: &[u8],
) -> Result<(), String> {
    for chunk in chunks {
        // The tables of the chunks follow each other in the order of the manifest.
        let (contents, consumed) = decode(table)?;
        table = &table[consumed..];
        let found = (contents.cell, contents.origin_m, contents.sh_degree, contents.record);
        let record = record_byte(record, chunk.classes);
        if found != (chunk.cell, chunk.origin_m.to_array(), sh_degree, record) {
            return Err(format!("it differs from the manifest in cell {:?}", chunk.cell));
        }
        chunk.sections = contents.in_order();
        let count: u64 = chunk.full_detail().map(|section| u64::from(section.count)).sum();
        if count != chunk.count {
            return Err(format!("it has {count} Gaussians of {} in {:?}", chunk.count, chunk.cell));
        }
        check_levels(chunk)?;
    }
    if table.is_empty() { Ok(()) } else { Err("it has more cells than the manifest".into()) }
}

/// Checks that an object's own table of contents agrees with the manifest's. `start` is the start
/// of the object, up to [`limits::CHUNK_TABLE_BYTES`] and a page.
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
    // `rest` has at most [`limits::CHUNK_TABLE_BYTES`], so that this bounds the table, too.
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

/// Checks that every block has level 0 without error, and then consecutive levels with rising
/// errors.
fn check_levels(chunk: &ChunkEntry) -> Result<(), String> {
    for block in chunk.sections.chunk_by(|a, b| a.block == b.block) {
        let numbered = block.iter().enumerate().all(|(k, section)| usize::from(section.level) == k);
        // Each condition states what must hold, so that NaN fails it.
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
    fn from_section(section: &Section) -> Self {
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

/// Fixed-size integers, and a limit, without which a short input could request an allocation of any
/// size.
fn encoding() -> impl Config {
    const LIMIT: usize = limits::CHUNK_TABLE_BYTES;
    bincode::config::standard().with_fixed_int_encoding().with_limit::<LIMIT>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::Gaussians;
    use wildcity_scene::chunk::{CellRun, Partition};

    /// 300 Gaussians of one block, a coarse level of 100, and the object that holds them.
    fn object() -> (Vec<u8>, ChunkEntry) {
        let n = 300;
        let gaussians = Gaussians {
            sh_degree: 0,
            // 299 x 0.04 m are 12 m: all lie in one block of 16 m.
            means_m: (0..n).map(|i| [0.04 * f64::from(i), 1.0, 2.0]).collect(),
            quats_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n as usize],
            ln_scales: vec![[-2.0; 3]; n as usize],
            logit_opacities: vec![1.0; n as usize],
            sh: vec![0.25; 3 * n as usize],
            ..Gaussians::default()
        };
        let Partition { cells, order } = Partition::new(&gaussians.means_m);
        let cell: &CellRun = &cells[0];
        let chunk = |count: usize| {
            let mut chunk = Chunk::new(cell.cell, cell.origin_m, 0, count);
            for &index in &order[..count] {
                chunk.push(&cell.record(&gaussians, index as usize));
            }
            chunk
        };
        let lost = &mut Clamped::default();
        let packed = [(0, 0.0, 300), (1, 0.5, 100)].map(|(level, error_m, count)| {
            let level = LevelOfBlock { block: 10, level, error_m };
            pack(&chunk(count), level, RecordFormat::Q32, lost).unwrap()
        });
        let mut bytes = Vec::new();
        let header = ChunkHeader {
            cell: cell.cell,
            origin_m: cell.origin_m,
            sh_degree: 0,
            record: RecordFormat::Q32,
            classes: false,
        };
        let (sections, bounds) = write(&mut bytes, &header, packed.into()).unwrap();
        let entry = ChunkEntry {
            cell: cell.cell,
            object: blake3::hash(&bytes).to_hex().to_string(),
            count: 300,
            bytes: bytes.len() as u64,
            bounds,
            origin_m: cell.origin_m,
            classes: false,
            sections,
        };
        (bytes, entry)
    }

    fn filled(entry: &ChunkEntry, table: &[u8]) -> Result<Vec<Section>, String> {
        let mut chunks = [ChunkEntry { sections: Vec::new(), ..entry.clone() }];
        fill(&mut chunks, 0, RecordFormat::Q32, table).map(|()| chunks[0].sections.clone())
    }

    #[test]
    fn sections_share_a_page_where_they_fit_and_begin_one_where_not() {
        // 8192 is a multiple of a page. After 8292, the page has 3996 bytes left.
        assert_eq!(place(8192, 100), 8192);
        assert_eq!(place(8292, 3996), 8292);
        assert_eq!(place(8292, 3997), 12288);
        assert_eq!(place(8292, 50_000), 12288);
        let (bytes, entry) = object();
        let [full, coarse] = &entry.sections[..] else { panic!("{:?}", entry.sections) };
        // Page 0 is the header and page 1 the table.
        assert_eq!((coarse.offset_bytes, coarse.level), (8192, 1), "coarse levels come first");
        for section in [full, coarse] {
            let start = section.offset_bytes as usize;
            let own = &bytes[start..start + section.bytes as usize];
            let chunk = unpack(own, &entry, section, 0, RecordFormat::Q32, None).unwrap();
            assert_eq!((chunk.cell(), chunk.len()), (entry.cell, section.count as usize));
        }
    }

    #[test]
    fn a_table_comes_back_and_one_that_lies_is_refused() {
        let (_, entry) = object();
        let table = table(std::slice::from_ref(&entry), 0, RecordFormat::Q32).unwrap();
        assert_eq!(filled(&entry, &table).unwrap(), entry.sections);
        // A row is 78 bytes: `limits::CHUNK_TABLE_BYTES` has room for 29 levels of 16 blocks.
        // The other 42 bytes are 8 of the cell, 24 of the origin, 1 of the degree, 1 of the record,
        // and 8 of the number of rows.
        assert_eq!(table.len(), 42 + 2 * 78);
        const { assert!(42 + 16 * 29 * 78 < limits::CHUNK_TABLE_BYTES) };
        for cut in 0..table.len() {
            filled(&entry, &table[..cut]).unwrap_err();
        }
        assert!(filled(&entry, &[&table[..], &table].concat()).unwrap_err().contains("more cells"));
        let refused = |change: &dyn Fn(&mut ChunkEntry)| {
            let mut other = entry.clone();
            change(&mut other);
            let table = super::table(&[other], 0, RecordFormat::Q32).unwrap();
            filled(&entry, &table).unwrap_err()
        };
        assert!(refused(&|e| e.cell[0] += 1).contains("differs from the manifest in cell"));
        assert!(refused(&|e| e.sections[0].count = 7).contains("it has 7 Gaussians of 300"));
        for change in [
            (|e| e.sections[1].level = 2) as fn(&mut ChunkEntry),
            |e| e.sections[1].error_m = f32::NAN,
            |e| e.sections[1].error_m = -1.0,
            |e| e.sections[0].error_m = 0.1,
            |e| e.sections[1].max_m[2] = f32::INFINITY,
        ] {
            assert!(refused(&change).contains("has wrong levels"));
        }
        // 2^64 sections: nothing is allocated for them.
        let mut many = table.clone();
        // Bytes 34 to 41 are the number of rows, after the 8 + 24 + 2 bytes in front of it.
        many[34..42].fill(255);
        assert!(filled(&entry, &many).unwrap_err().contains("does not decode"));
    }

    #[test]
    fn an_object_says_itself_what_is_in_it() {
        let (bytes, entry) = object();
        check_start(&bytes, &entry).unwrap();
        let refused = |at: usize| {
            let mut bytes = bytes.clone();
            bytes[at] ^= 1;
            check_start(&bytes, &entry).unwrap_err()
        };
        assert_eq!(refused(0), "it does not start as a chunk");
        assert_eq!(refused(8), "it has format 0; this build reads format 1");
        // Byte 15 is the highest of the table's length, which becomes 16 MB longer.
        assert_eq!(refused(15), "its table is longer than it may be");
        // Byte 20 is in the stored hash, and byte 4100 in the table itself.
        assert_eq!(refused(20), "its table of contents has another hash");
        assert_eq!(refused(4100), "its table of contents has another hash");
        assert_eq!(check_start(&bytes[..4000], &entry).unwrap_err(), "it is shorter than a page");
        let mut other = entry.clone();
        other.sections[0].hash[0] ^= 1;
        let said = check_start(&bytes, &other).unwrap_err();
        assert_eq!(said, "its table of contents is not the manifest's");
    }

    #[test]
    fn a_section_that_is_not_what_it_says_is_refused_in_bounded_memory() {
        let (bytes, entry) = object();
        let section = entry.sections[0];
        let start = section.offset_bytes as usize;
        let own = &bytes[start..start + section.bytes as usize];
        let refused = |own: &[u8], count: u32| {
            let section = Section { count, ..section };
            unpack(own, &entry, &section, 0, RecordFormat::Q32, None).unwrap_err()
        };
        for cut in 0..own.len() {
            refused(&own[..cut], 300);
        }
        assert_eq!(refused(&[own, &[0]].concat(), 300), "1 bytes are left over");
        // The bytes of 300 Gaussians do not fit into the buffer for 299.
        assert!(refused(own, 299).starts_with("a part does not decompress"));
        assert!(refused(own, 301).starts_with("301 Gaussians take "));
        // 4 G Gaussians, 240 GB: the first part is missing.
        assert!(refused(own, u32::MAX).starts_with("65536 Gaussians take "));
        for at in 0..own.len() {
            let mut own = own.to_vec();
            own[at] ^= 0x40;
            // The caller compares the hash before, so here it is enough that damaged bytes cause no
            // panic.
            let _ = unpack(&own, &entry, &section, 0, RecordFormat::Q32, None);
        }
    }
}
