//! The mirror: the device's copy of the Gaussians in main memory, encoded (`encode.rs`) and
//! uploaded once.
//!
//! The mirror consists of pages, one buffer each, whose free lines are allocated cluster by
//! cluster. A chunk that main memory drops is dropped here too. If there is a limit, the least
//! recently drawn chunks are evicted to make room. If a scene would fit but its clusters do not fit
//! between others (fragmentation), everything is evicted and uploaded again.
//!
//! A page is made as large as the missing clusters of the frame, or a quarter of the mirror, so
//! that a twin that is streamed section by section does not end with one page, and one dispatch,
//! per section.

mod encode;
mod free_lines;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::{Arc, Weak};

use rayon::prelude::*;
use wgpu::{Buffer, BufferUsages};

pub(super) use self::encode::largest_component;
use self::encode::{LINE_BYTES, MAX_LINES};
use self::free_lines::FreeLines;
use super::device::Device;
use super::layout::SOA_BLOCK;
use crate::RenderError;
use wildcity_scene::{Chunk, Scene};

/// Lines encoded at a time: 64 MiB, the most staging memory that is used.
const UPLOAD_LINES: u32 = 1 << 19;

/// The chunks on one device.
#[derive(Debug)]
pub(super) struct Mirror {
    /// Most bytes of all pages.
    limit_bytes: u64,
    /// `None` where a page was freed.
    pages: Vec<Option<Page>>,
    /// By the chunk's address. It is not reused as long as the weak pointer exists.
    resident: BTreeMap<usize, Resident>,
    /// (Last frame, address) of every resident chunk: the first is the least recently drawn.
    by_last_frame: BTreeSet<(u64, usize)>,
    /// Number of calls of [`Mirror::make_resident`].
    frame: u64,
}

/// One buffer. The size of a binding is limited, so a scene may need several.
#[derive(Debug)]
struct Page {
    buffer: Buffer,
    lines: u32,
    free: FreeLines,
}

impl Page {
    /// Frees the memory once the frames on the device are done: bind groups of earlier frames would
    /// keep it.
    fn free(self) {
        self.buffer.destroy();
    }
}

/// A chunk on the device.
#[derive(Debug)]
struct Resident {
    chunk: Weak<Chunk>,
    /// The location of each cluster, in order.
    places: Vec<ClusterLocation>,
    /// The frame that drew the chunk last.
    last_frame: u64,
}

/// The location of a cluster in the mirror.
#[derive(Clone, Debug)]
pub(super) struct ClusterLocation {
    /// Index of the page.
    pub(super) page: usize,
    /// Lines of the page.
    pub(super) lines: Range<u32>,
}

impl Mirror {
    /// An empty mirror that takes at most `limit_bytes` of the device's memory.
    pub(super) fn new(limit_bytes: u64) -> Self {
        Self {
            limit_bytes,
            pages: Vec::new(),
            resident: BTreeMap::new(),
            by_last_frame: BTreeSet::new(),
            frame: 0,
        }
    }

    /// Uploads the chunks of a scene that are not resident yet. Drops those that main memory has
    /// dropped.
    ///
    /// # Errors
    /// [`RenderError::DeviceMemory`] if the scene by itself exceeds the limit.
    pub(super) fn make_resident(
        &mut self,
        device: &Device,
        scene: &Scene,
    ) -> Result<(), RenderError> {
        self.frame += 1;
        self.drop_unused();
        if self.add_missing(device, scene).is_err() {
            // The free lines may be fragmented: evict everything and try again.
            self.resident.clear();
            self.by_last_frame.clear();
            self.pages.drain(..).flatten().for_each(Page::free);
            self.add_missing(device, scene).map_err(|Full| RenderError::DeviceMemory {
                needed_bytes: scene.distinct_chunks().map(|chunk| needed_lines(chunk)).sum::<u64>()
                    * LINE_BYTES,
                limit_bytes: self.limit_bytes,
            })?;
        }
        Ok(())
    }

    /// Where a chunk's clusters lie, in order. Empty if the chunk is not resident.
    pub(super) fn places(&self, chunk: &Arc<Chunk>) -> &[ClusterLocation] {
        self.resident.get(&address(chunk)).map_or(&[], |resident| &resident.places)
    }

    /// The buffer of a page; `None` if the page was freed.
    pub(super) fn page(&self, page: usize) -> Option<&Buffer> {
        self.pages.get(page)?.as_ref().map(|page| &page.buffer)
    }

    /// Device memory of all pages, in bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.pages.iter().flatten().map(|page| page.buffer.size()).sum()
    }

    /// Marks the chunks of a scene as drawn in this frame, and uploads those that are missing.
    fn add_missing(&mut self, device: &Device, scene: &Scene) -> Result<(), Full> {
        // First mark all resident chunks, so that none of them is evicted for a missing one.
        let mut missing = Vec::new();
        for chunk in scene.distinct_chunks() {
            match self.resident.get_mut(&address(chunk)) {
                Some(resident) => {
                    self.by_last_frame.remove(&(resident.last_frame, address(chunk)));
                    self.by_last_frame.insert((self.frame, address(chunk)));
                    resident.last_frame = self.frame;
                }
                None => missing.push(chunk),
            }
        }
        let mut needed = missing.iter().map(|chunk| needed_lines(chunk)).sum();
        for chunk in missing {
            let mut places = Vec::with_capacity(chunk.clusters().len());
            for lines in encode::lines(chunk) {
                match self.allocate(device, lines, needed) {
                    Ok(place) => places.push(place),
                    Err(full) => {
                        // The clusters that found a place; the chunk itself is not resident.
                        self.free(&places);
                        return Err(full);
                    }
                }
                needed -= u64::from(lines);
            }
            self.upload(device, chunk, &places);
            let address = address(chunk);
            let chunk = Arc::downgrade(chunk);
            let last_frame = self.frame;
            self.resident.insert(address, Resident { chunk, places, last_frame });
            self.by_last_frame.insert((last_frame, address));
        }
        Ok(())
    }

    /// Allocates consecutive lines: of an existing page, of a new page, or after evicting chunks
    /// that this frame does not draw. `needed` is the number of lines that the frame still has to
    /// allocate.
    fn allocate(
        &mut self,
        device: &Device,
        lines: u32,
        needed: u64,
    ) -> Result<ClusterLocation, Full> {
        loop {
            let found = self.pages.iter_mut().enumerate().find_map(|(index, page)| {
                Some(ClusterLocation { page: index, lines: page.as_mut()?.free.allocate(lines)? })
            });
            match found {
                Some(place) => return Ok(place),
                None if self.add_page(device, lines, needed) => {}
                None => self.evict_oldest()?,
            }
        }
    }

    /// Adds a page that has room for a cluster of `lines` and, as far as the device and the limit
    /// allow, for `needed` lines or a quarter of the mirror, whichever is more. Returns whether it
    /// could.
    fn add_page(&mut self, device: &Device, lines: u32, needed: u64) -> bool {
        let held = self.bytes();
        let wanted = needed.max(held / 4 / LINE_BYTES);
        let available = self.limit_bytes.saturating_sub(held).min(device.binding_bytes());
        let most = available / LINE_BYTES;
        // Sizes of buffers are multiples of 256 B, two lines.
        let lines_of_page = wanted.next_multiple_of(2).min(most & !1);
        if lines_of_page < u64::from(lines) {
            return false;
        }
        // A binding has less than 2^32 bytes on any device, and a line has 2^7.
        let lines = u32::try_from(lines_of_page).unwrap_or(u32::MAX);
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = device.buffer("gaussians", u64::from(lines) * LINE_BYTES, usage);
        let page = Page { buffer, lines, free: FreeLines::all(lines) };
        // Locations name pages by their index, so the indices of other pages must not change.
        match self.pages.iter_mut().find(|page| page.is_none()) {
            Some(slot) => *slot = Some(page),
            None => self.pages.push(Some(page)),
        }
        true
    }

    /// Evicts the least recently drawn chunk, unless this frame draws it.
    fn evict_oldest(&mut self) -> Result<(), Full> {
        let oldest = self.by_last_frame.first();
        let evictable = oldest.filter(|(last_frame, _)| *last_frame < self.frame);
        let &(_, address) = evictable.ok_or(Full)?;
        self.evict(address);
        Ok(())
    }

    fn evict(&mut self, address: usize) {
        if let Some(Resident { places, last_frame, .. }) = self.resident.remove(&address) {
            self.by_last_frame.remove(&(last_frame, address));
            self.free(&places);
        }
    }

    /// Evicts the chunks that main memory has dropped, and frees pages without clusters.
    fn drop_unused(&mut self) {
        let dropped: Vec<usize> = (self.resident.iter())
            .filter(|(_, resident)| resident.chunk.strong_count() == 0)
            .map(|(&address, _)| address)
            .collect();
        for address in dropped {
            self.evict(address);
        }
        for slot in &mut self.pages {
            if slot.as_ref().is_some_and(|page| page.free.is_all(page.lines)) {
                slot.take().into_iter().for_each(Page::free);
            }
        }
    }

    fn free(&mut self, places: &[ClusterLocation]) {
        for place in places {
            if let Some(Some(page)) = self.pages.get_mut(place.page) {
                page.free.free(place.lines.clone());
            }
        }
    }

    /// Encodes a chunk's clusters in parallel, and uploads them. Clusters on consecutive lines are
    /// uploaded together, up to [`UPLOAD_LINES`].
    fn upload(&self, device: &Device, chunk: &Chunk, places: &[ClusterLocation]) {
        let mut next_cluster = 0;
        for run in places.chunk_by(|a, b| a.page == b.page && a.lines.end == b.lines.start) {
            let Some(buffer) = self.page(run[0].page) else { continue };
            // A cluster has at most MAX_LINES, so that this many clusters stay within UPLOAD_LINES.
            for batch in run.chunks((UPLOAD_LINES / MAX_LINES) as usize) {
                let lines = batch[0].lines.start..batch[batch.len() - 1].lines.end;
                let mut words = vec![0; lines.len() * SOA_BLOCK as usize];
                let mut rest = &mut words[..];
                let mut clusters = Vec::with_capacity(batch.len());
                for place in batch {
                    let cluster;
                    (cluster, rest) = rest.split_at_mut(place.lines.len() * SOA_BLOCK as usize);
                    clusters.push(cluster);
                }
                clusters.into_par_iter().enumerate().for_each(|(k, words)| {
                    encode::encode(chunk, next_cluster + k, words);
                });
                next_cluster += batch.len();
                let offset = u64::from(lines.start) * LINE_BYTES;
                device.write_now(buffer, offset, bytemuck::cast_slice(&words));
            }
        }
    }
}

/// There is no room within the limit.
#[derive(Debug)]
struct Full;

fn address(chunk: &Arc<Chunk>) -> usize {
    Arc::as_ptr(chunk) as usize
}

fn needed_lines(chunk: &Chunk) -> u64 {
    encode::lines(chunk).map(u64::from).sum()
}
