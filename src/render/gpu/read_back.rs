//! The way of a frame back to the host: buffers in memory that it sees, which frames hand on to each
//! other.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use wgpu::{BufferUsages, BufferView, MapMode, PollType, SubmissionIndex};

use super::device::Device;
use super::growing::Growing;
use super::kernel::TICKS_BYTES;
use super::layout::{Counters, FrameView};
use super::rasterize::pages;
use super::resolve::Planes;
use crate::limits;
use crate::{FrameStats, RenderError};

/// How long a frame may take on the device before it counts as lost.
const FRAME_TIMEOUT: Duration = Duration::from_secs(60);

/// Where the ticks lie behind the counters.
pub(super) const TICKS_OFFSET: u64 = 256;

/// Where a frame reaches the host. A step's images are copied out of one while the next step fills
/// another.
#[derive(Debug)]
pub(super) struct ReadBack {
    /// Counters, then ticks.
    pub(super) head: Growing,
    pub(super) pages: Vec<Growing>,
    pub(super) tiles_per_page: u32,
}

/// Read-back buffers of one device that nobody reads.
#[derive(Clone, Debug, Default)]
pub(super) struct Ring(Arc<Mutex<Vec<ReadBack>>>);

/// A frame that is done, in mapped memory.
#[derive(Debug)]
pub(super) struct Drawn {
    pub(super) read_back: ReadBack,
    pub(super) ring: Ring,
    /// Pixels, page by page.
    pub(super) pages: Vec<BufferView>,
    pub(super) views: Vec<FrameView>,
    pub(super) stats: FrameStats,
}

impl Drawn {
    /// Tiles of a page, of the last one perhaps fewer.
    pub(super) fn tiles_per_page(&self) -> u32 {
        self.read_back.tiles_per_page
    }

    /// Gives the memory back for another frame, which may be drawn by now.
    pub(super) fn recycle(self) {
        let Self { read_back, ring, pages, .. } = self;
        // A buffer stays mapped for as long as a view of it lives.
        drop(pages);
        read_back.unmap();
        let mut unused = ring.lock();
        if unused.len() < limits::GPU_FRAMES {
            unused.push(read_back);
        }
    }
}

impl Ring {
    /// One that a frame has handed on.
    pub(super) fn take(&self) -> Option<ReadBack> {
        self.lock().pop()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<ReadBack>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ReadBack {
    /// The smallest.
    pub(super) fn new(device: &Device) -> Self {
        let head = Self::buffer(device, "counters read back");
        Self { head, pages: Vec::new(), tiles_per_page: 1 }
    }

    /// A buffer that the device copies to and the host reads.
    pub(super) fn buffer(device: &Device, label: &'static str) -> Growing {
        Growing::new(device, label, BufferUsages::MAP_READ | BufferUsages::COPY_DST)
    }

    /// Makes room for the pixels of all tiles.
    pub(super) fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32, per_page: u32) {
        self.tiles_per_page = per_page;
        self.head.reserve(device, TICKS_OFFSET + TICKS_BYTES);
        let count = tiles.div_ceil(per_page) as usize;
        self.pages.resize_with(count, || Self::buffer(device, "pixels read back"));
        for (page, tiles) in pages(&(0..tiles), per_page) {
            self.pages[page].reserve(device, planes.tile_bytes() * tiles.len() as u64);
        }
    }

    /// Waits for a submission, and maps everything.
    pub(super) fn map(
        &self,
        device: &Device,
        submission: SubmissionIndex,
    ) -> Result<(), RenderError> {
        let failed = Arc::new(AtomicBool::new(false));
        for growing in self.all() {
            let failed = Arc::clone(&failed);
            growing.buffer().slice(..).map_async(MapMode::Read, move |result| {
                failed.fetch_or(result.is_err(), Relaxed);
            });
        }
        let wait =
            PollType::Wait { submission_index: Some(submission), timeout: Some(FRAME_TIMEOUT) };
        let polled = device.device.poll(wait);
        device.check()?;
        polled.map_err(|error| device.failed(error.to_string()))?;
        match failed.load(Relaxed) {
            true => Err(device.failed("its memory could not be read".to_owned())),
            false => Ok(()),
        }
    }

    /// What was counted, and the ticks.
    pub(super) fn head(&self, device: &Device) -> Result<(Counters, Vec<u64>), RenderError> {
        let view = view(device, &self.head)?;
        let counters = bytemuck::pod_read_unaligned(&view[..size_of::<Counters>()]);
        let ticks = &view[TICKS_OFFSET as usize..(TICKS_OFFSET + TICKS_BYTES) as usize];
        Ok((counters, ticks.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect()))
    }

    /// The pixels.
    pub(super) fn pages(&self, device: &Device) -> Result<Vec<BufferView>, RenderError> {
        self.pages.iter().map(|page| view(device, page)).collect()
    }

    /// Hands everything back to the device.
    pub(super) fn unmap(&self) {
        self.all().for_each(|growing| growing.buffer().unmap());
    }

    fn all(&self) -> impl Iterator<Item = &Growing> {
        std::iter::once(&self.head).chain(&self.pages)
    }
}

fn view(device: &Device, growing: &Growing) -> Result<BufferView, RenderError> {
    let mapped = growing.buffer().slice(..).get_mapped_range();
    mapped.map_err(|error| device.failed(error.to_string()))
}
