//! Reading a frame back: buffers in memory that the host can read, reused by later frames.

use std::sync::{Arc, mpsc};

use bytemuck::AnyBitPattern;
use parking_lot::Mutex;
use wgpu::{Buffer, BufferUsages, BufferView, MapMode, PollType, SubmissionIndex};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Recorder, TIMESTAMP_BYTES};
use super::layout::{Counters, FrameView, TileCounters};
use super::rasterize::pages;
use super::resolve::Planes;
use crate::{FrameStats, RenderError, limits};

/// Offset of the counters of stage rasterize after the others, in bytes.
pub(super) const TILE_COUNTERS_OFFSET: u64 = 128;

/// Offset of the timestamps after the counters, in bytes.
pub(super) const TIMESTAMP_OFFSET: u64 = 256;

/// The read-back buffers of one frame. The host copies the images of a step out of one set while
/// the device fills another set with those of the next step.
#[derive(Debug)]
pub(super) struct ReadBack {
    /// Counters, those of stage rasterize, then timestamps.
    pub(super) head: GrowableBuffer,
    pub(super) pages: Vec<GrowableBuffer>,
    /// Tiles of a page; the last page may have fewer.
    pub(super) tiles_per_page: u32,
}

/// What the host reads of a submission beside pixels.
#[derive(Debug)]
pub(super) struct Head {
    pub(super) counters: Counters,
    pub(super) tile_counters: TileCounters,
    pub(super) timestamps: Vec<u64>,
}

/// The unused read-back buffers of one device.
#[derive(Clone, Debug, Default)]
pub(super) struct ReadBackPool(Arc<Mutex<Vec<ReadBack>>>);

/// A frame that the device has finished, in mapped memory.
#[derive(Debug)]
pub(super) struct MappedFrame {
    pub(super) read_back: ReadBack,
    pub(super) pool: ReadBackPool,
    /// Pixels, page by page.
    pub(super) pages: Vec<BufferView>,
    pub(super) views: Vec<FrameView>,
    pub(super) stats: FrameStats,
}

impl MappedFrame {
    /// Tiles of a page; the last page may have fewer.
    pub(super) fn tiles_per_page(&self) -> u32 {
        self.read_back.tiles_per_page
    }

    /// Unmaps the memory and returns it for use by another frame.
    pub(super) fn recycle(self) {
        let Self { read_back, pool, pages, .. } = self;
        // A buffer cannot be unmapped while a view of it exists.
        drop(pages);
        read_back.unmap();
        pool.give_back(read_back);
    }
}

impl ReadBackPool {
    /// Takes the buffers of an earlier frame, if some are unused.
    pub(super) fn take(&self) -> Option<ReadBack> {
        self.0.lock().pop()
    }

    /// Keeps unmapped buffers for another frame.
    pub(super) fn give_back(&self, read_back: ReadBack) {
        let mut unused = self.0.lock();
        if unused.len() < limits::GPU_FRAMES_MAX {
            unused.push(read_back);
        }
    }
}

impl ReadBack {
    /// Buffers of the smallest size.
    pub(super) fn new(device: &Device) -> Self {
        let head = Self::buffer(device, "counters read back");
        Self { head, pages: Vec::new(), tiles_per_page: 1 }
    }

    /// A buffer to which the device copies and from which the host reads.
    fn buffer(device: &Device, label: &'static str) -> GrowableBuffer {
        GrowableBuffer::new(device, label, BufferUsages::MAP_READ | BufferUsages::COPY_DST)
    }

    /// Makes room for the pixels of all tiles.
    pub(super) fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32, per_page: u32) {
        self.tiles_per_page = per_page;
        self.reserve_head(device);
        let count = tiles.div_ceil(per_page) as usize;
        self.pages.resize_with(count, || Self::buffer(device, "pixels read back"));
        for (page, tiles) in pages(&(0..tiles), per_page) {
            self.pages[page].reserve(device, planes.tile_bytes() * tiles.len() as u64);
        }
    }

    /// Makes room for the counters and the timestamps.
    pub(super) fn reserve_head(&mut self, device: &Device) {
        self.head.reserve(device, TIMESTAMP_OFFSET + TIMESTAMP_BYTES);
    }

    /// Ends a recording with copies of buffers, one to each page, and submits it. Returns the names
    /// of its stages, whose times go to the head by way of `timestamps`.
    pub(super) fn submit(
        &mut self,
        device: &Device,
        mut recorder: Recorder,
        sources: &[(&Buffer, u64)],
        timestamps: &Buffer,
    ) -> (Vec<&'static str>, SubmissionIndex) {
        self.reserve_head(device);
        self.pages.resize_with(sources.len(), || Self::buffer(device, "buffers read back"));
        let stages = recorder.finish_stages(timestamps);
        let mut encoder = recorder.encoder;
        let head = self.head.buffer();
        encoder.copy_buffer_to_buffer(timestamps, 0, head, TIMESTAMP_OFFSET, TIMESTAMP_BYTES);
        for ((from, bytes), to) in sources.iter().zip(&mut self.pages) {
            to.reserve(device, *bytes);
            encoder.copy_buffer_to_buffer(from, 0, to.buffer(), 0, *bytes);
        }
        (stages, device.queue.submit([encoder.finish()]))
    }

    /// Waits for a submission, and maps all buffers.
    ///
    /// # Errors
    /// The device fails, or does not finish within [`Device::frame_timeout`].
    pub(super) fn map(
        &self,
        device: &Device,
        submission: SubmissionIndex,
    ) -> Result<(), RenderError> {
        let (mapped, all_mapped) = mpsc::channel();
        for buffer in self.all() {
            let mapped = mapped.clone();
            buffer.buffer().slice(..).map_async(MapMode::Read, move |result| {
                // Sending fails if this frame has failed meanwhile.
                let _ = mapped.send(result.is_ok());
            });
        }
        // With no sender left but those of the callbacks, callbacks that are dropped end the wait
        // below.
        drop(mapped);
        let timeout = Some(device.frame_timeout());
        let wait = PollType::Wait { submission_index: Some(submission), timeout };
        let polled = device.device.poll(wait);
        device.check()?;
        polled.map_err(|error| device.failed(error.to_string()))?;
        // Another thread that waits for the device may have taken the callbacks, and still be
        // calling them.
        for _ in self.all() {
            if all_mapped.recv_timeout(limits::MAP_CALLBACK) != Ok(true) {
                return Err(device.failed("its memory could not be read".to_owned()));
            }
        }
        Ok(())
    }

    /// The counters and the timestamps.
    pub(super) fn head(&self, device: &Device) -> Result<Head, RenderError> {
        let view = view(device, &self.head)?;
        let part = |at: u64, bytes: usize| &view[at as usize..at as usize + bytes];
        let timestamps = part(TIMESTAMP_OFFSET, TIMESTAMP_BYTES as usize).chunks_exact(8);
        let tile_counters = part(TILE_COUNTERS_OFFSET, size_of::<TileCounters>());
        Ok(Head {
            counters: bytemuck::pod_read_unaligned(part(0, size_of::<Counters>())),
            tile_counters: bytemuck::pod_read_unaligned(tile_counters),
            timestamps: timestamps.map(bytemuck::pod_read_unaligned).collect(),
        })
    }

    /// The mapped pages, in order.
    pub(super) fn pages(&self, device: &Device) -> Result<Vec<BufferView>, RenderError> {
        self.pages.iter().map(|page| view(device, page)).collect()
    }

    /// Unmaps all buffers, so that the device can use them again.
    pub(super) fn unmap(&self) {
        self.all().for_each(|buffer| buffer.buffer().unmap());
    }

    fn all(&self) -> impl Iterator<Item = &GrowableBuffer> {
        std::iter::once(&self.head).chain(&self.pages)
    }
}

/// The mapped content of a buffer.
fn view(device: &Device, buffer: &GrowableBuffer) -> Result<BufferView, RenderError> {
    let mapped = buffer.buffer().slice(..).get_mapped_range();
    mapped.map_err(|error| device.failed(error.to_string()))
}

/// Mapped bytes as values, as many as there are whole ones.
pub(super) fn mapped<'a, T: AnyBitPattern>(
    device: &Device,
    bytes: &'a [u8],
) -> Result<&'a [T], RenderError> {
    let whole = bytes.len() / size_of::<T>() * size_of::<T>();
    bytemuck::try_cast_slice(&bytes[..whole])
        .map_err(|error| device.failed(format!("its memory cannot be read: {error}")))
}
