//! The mirror: what is resident in main memory, encoded for the device (`mirror/encode.rs`) and uploaded
//! once.
//!
//! It lies in pages, one buffer each, whose free lines are handed out cluster by cluster. What main
//! memory drops is dropped here, and where there is a limit, what was not drawn for longest goes when
//! something else is drawn.

mod encode;
mod free;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::{Arc, Weak};

use rayon::prelude::*;
use wgpu::{Buffer, BufferUsages};

use self::encode::{LINE_BYTES, MOST_LINES};
use self::free::Free;
use super::device::Device;
use super::layout::STRIP;
use crate::RenderError;
use wildcity_scene::{Chunk, Scene};

/// Lines encoded at a time: 64 MiB, the most of staging memory.
const UPLOAD_LINES: u32 = 1 << 19;

/// All chunks on one device.
#[derive(Debug)]
pub(super) struct Mirror {
    /// Most bytes of all pages.
    limit_bytes: u64,
    pages: Vec<Option<Page>>,
    /// By address, which is a chunk's own for as long as the weak pointer lives.
    resident: BTreeMap<usize, Resident>,
    /// The same by the frame that drew them last, and address: the first goes first.
    by_frame: BTreeSet<(u64, usize)>,
    /// Counts calls of [`Mirror::hold`].
    frame: u64,
}

/// One buffer: a binding is limited, so a scene may need several.
#[derive(Debug)]
struct Page {
    buffer: Buffer,
    lines: u32,
    free: Free,
}

#[derive(Debug)]
struct Resident {
    chunk: Weak<Chunk>,
    places: Vec<Place>,
    last_frame: u64,
}

/// Where a cluster lies.
#[derive(Clone, Debug)]
pub(super) struct Place {
    /// On which page.
    pub(super) page: usize,
    /// Its lines of the page.
    pub(super) lines: Range<u32>,
}

impl Mirror {
    /// An empty one that takes so much of the device's memory at most.
    pub(super) fn new(limit_bytes: u64) -> Self {
        let (resident, by_frame) = (BTreeMap::new(), BTreeSet::new());
        Self { limit_bytes, pages: Vec::new(), resident, by_frame, frame: 0 }
    }

    /// Makes a scene resident. What main memory has dropped is dropped here too.
    ///
    /// # Errors
    /// [`RenderError::DeviceMemory`] if it is more than the limit by itself.
    pub(super) fn hold(&mut self, device: &Device, scene: &Scene) -> Result<(), RenderError> {
        self.frame += 1;
        self.drop_dead();
        if self.hold_beside_others(device, scene).is_err() {
            // Its clusters would fit, but not between the others: everything goes, and they come anew.
            self.resident.clear();
            self.by_frame.clear();
            self.pages.clear();
            self.hold_beside_others(device, scene).map_err(|Full| RenderError::DeviceMemory {
                needed_bytes: scene.chunks.iter().map(|chunk| lines_of(chunk)).sum::<u64>()
                    * LINE_BYTES,
                limit_bytes: self.limit_bytes,
            })?;
        }
        Ok(())
    }

    /// Where a chunk's clusters lie, in order. Empty unless [`Mirror::hold`] has seen it.
    pub(super) fn places(&self, chunk: &Arc<Chunk>) -> &[Place] {
        self.resident.get(&address(chunk)).map_or(&[], |resident| &resident.places)
    }

    /// The buffer of a page.
    pub(super) fn page(&self, page: usize) -> Option<&Buffer> {
        self.pages.get(page)?.as_ref().map(|page| &page.buffer)
    }

    /// Pages, those that are gone included.
    pub(super) fn pages(&self) -> usize {
        self.pages.len()
    }

    /// Device memory held, in bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.pages.iter().flatten().map(|page| page.buffer.size()).sum()
    }

    fn hold_beside_others(&mut self, device: &Device, scene: &Scene) -> Result<(), Full> {
        let mut missing = Vec::new();
        for chunk in &scene.chunks {
            match self.resident.get_mut(&address(chunk)) {
                Some(resident) => {
                    self.by_frame.remove(&(resident.last_frame, address(chunk)));
                    self.by_frame.insert((self.frame, address(chunk)));
                    resident.last_frame = self.frame;
                }
                None => missing.push(chunk),
            }
        }
        let mut needed = missing.iter().map(|chunk| lines_of(chunk)).sum();
        for chunk in missing {
            let mut places = Vec::with_capacity(chunk.clusters().len());
            for lines in encode::lines(chunk) {
                match self.place(device, lines, needed) {
                    Ok(place) => places.push(place),
                    Err(full) => {
                        self.give_back(&places);
                        return Err(full);
                    }
                }
                needed -= u64::from(lines);
            }
            self.upload(device, chunk, &places);
            let (chunk, last_frame) = (Arc::downgrade(chunk), self.frame);
            let address = chunk.as_ptr() as usize;
            self.resident.insert(address, Resident { chunk, places, last_frame });
            self.by_frame.insert((last_frame, address));
        }
        Ok(())
    }

    /// Takes consecutive lines, of a new page or of what this frame does not draw if it must be;
    /// `needed` are those that the frame will take.
    fn place(&mut self, device: &Device, lines: u32, needed: u64) -> Result<Place, Full> {
        loop {
            let found = self.pages.iter_mut().enumerate().find_map(|(index, page)| {
                Some(Place { page: index, lines: page.as_mut()?.free.take(lines)? })
            });
            match found {
                Some(place) => return Ok(place),
                None if self.add_page(device, lines, needed) => {}
                None => self.evict()?,
            }
        }
    }

    /// Adds a page with room for a cluster and, if the device and the limit have it, for what the frame
    /// needs, or a quarter of what there is: as a twin streams by, pages must not become many.
    fn add_page(&mut self, device: &Device, lines: u32, needed: u64) -> bool {
        let held = self.bytes();
        let wanted = needed.max(held / 4 / LINE_BYTES);
        let most = self.limit_bytes.saturating_sub(held).min(device.binding_bytes()) / LINE_BYTES;
        // Buffers have a multiple of two lines.
        let lines_of_page = wanted.next_multiple_of(2).min(most & !1);
        if lines_of_page < u64::from(lines) {
            return false;
        }
        // A binding has less than 2^32 bytes on any device, and a line has 2^7.
        let lines = u32::try_from(lines_of_page).unwrap_or(u32::MAX);
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = device.buffer("gaussians", u64::from(lines) * LINE_BYTES, usage);
        let page = Page { buffer, lines, free: Free::all(lines) };
        match self.pages.iter_mut().find(|page| page.is_none()) {
            Some(slot) => *slot = Some(page),
            None => self.pages.push(Some(page)),
        }
        true
    }

    /// Drops what was not drawn for longest.
    fn evict(&mut self) -> Result<(), Full> {
        let oldest = self.by_frame.first().filter(|(last_frame, _)| *last_frame < self.frame);
        let &(_, address) = oldest.ok_or(Full)?;
        self.drop_chunk(address);
        Ok(())
    }

    fn drop_chunk(&mut self, address: usize) {
        if let Some(Resident { places, last_frame, .. }) = self.resident.remove(&address) {
            self.by_frame.remove(&(last_frame, address));
            self.give_back(&places);
        }
    }

    fn drop_dead(&mut self) {
        let dead: Vec<usize> = (self.resident.iter())
            .filter(|(_, resident)| resident.chunk.strong_count() == 0)
            .map(|(&address, _)| address)
            .collect();
        for address in dead {
            self.drop_chunk(address);
        }
        for slot in &mut self.pages {
            if slot.as_ref().is_some_and(|page| page.free.is_all(page.lines)) {
                *slot = None;
            }
        }
    }

    fn give_back(&mut self, places: &[Place]) {
        for place in places {
            if let Some(Some(page)) = self.pages.get_mut(place.page) {
                page.free.give_back(place.lines.clone());
            }
        }
    }

    fn upload(&self, device: &Device, chunk: &Chunk, places: &[Place]) {
        let mut next = 0;
        for run in places.chunk_by(|a, b| a.page == b.page && a.lines.end == b.lines.start) {
            let Some(buffer) = self.page(run[0].page) else { continue };
            let most = (UPLOAD_LINES / MOST_LINES) as usize;
            for together in run.chunks(most) {
                let lines = together[0].lines.start..together[together.len() - 1].lines.end;
                let mut words = vec![0; lines.len() * STRIP as usize];
                let mut rest = &mut words[..];
                let mut clusters = Vec::with_capacity(together.len());
                for place in together {
                    let own;
                    (own, rest) = rest.split_at_mut(place.lines.len() * STRIP as usize);
                    clusters.push(own);
                }
                clusters.into_par_iter().enumerate().for_each(|(k, words)| {
                    encode::encode(chunk, next + k, words);
                });
                next += together.len();
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

fn lines_of(chunk: &Chunk) -> u64 {
    encode::lines(chunk).map(u64::from).sum()
}
