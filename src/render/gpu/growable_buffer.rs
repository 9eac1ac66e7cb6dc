//! Buffers that grow to the largest size that was ever needed.

use wgpu::{BindingResource, Buffer, BufferUsages};

use super::device::Device;

/// Usage of buffers between two stages: another backend may write them, and tests read them.
pub(super) const INTERMEDIATE: BufferUsages =
    BufferUsages::STORAGE.union(BufferUsages::COPY_DST).union(BufferUsages::COPY_SRC);

/// A buffer that grows and never shrinks. Growing discards its content.
#[derive(Debug)]
pub(super) struct GrowableBuffer {
    label: &'static str,
    usage: BufferUsages,
    buffer: Buffer,
}

impl GrowableBuffer {
    /// A buffer of the smallest size, 256 bytes.
    pub(super) fn new(device: &Device, label: &'static str, usage: BufferUsages) -> Self {
        Self { label, usage, buffer: device.buffer(label, 0, usage) }
    }

    /// Grows the buffer to at least `bytes` if it is smaller. It then gets a quarter more, so that
    /// a growing scene does not reallocate in every frame.
    pub(super) fn reserve(&mut self, device: &Device, bytes: u64) {
        if self.buffer.size() < bytes {
            // No margin beyond what a shader can bind, and never less than what is needed.
            let with_margin = (bytes + bytes / 4).min(device.binding_bytes()).max(bytes);
            // At once: the bind groups that kernels keep would hold its memory.
            self.buffer.destroy();
            self.buffer = device.buffer(self.label, with_margin, self.usage);
        }
    }

    /// Replaces the content; the next submission and later ones see it.
    pub(super) fn fill(&mut self, device: &Device, bytes: &[u8]) {
        self.reserve(device, bytes.len() as u64);
        device.queue.write_buffer(&self.buffer, 0, bytes);
    }

    pub(super) fn buffer(&self) -> &Buffer {
        &self.buffer
    }

    /// The whole buffer as a shader's resource.
    pub(super) fn bind(&self) -> BindingResource<'_> {
        self.buffer.as_entire_binding()
    }
}
