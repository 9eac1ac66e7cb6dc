//! Buffers that keep the largest size that was ever needed.

use wgpu::{BindingResource, Buffer, BufferUsages};

use super::device::Device;

/// What lies between stages: another backend may have filled it, and tests read it.
pub(super) const HANDED_OVER: BufferUsages =
    BufferUsages::STORAGE.union(BufferUsages::COPY_DST).union(BufferUsages::COPY_SRC);

/// A buffer that grows and never shrinks. Its content does not outlive growing.
#[derive(Debug)]
pub(super) struct Growing {
    label: &'static str,
    usage: BufferUsages,
    buffer: Buffer,
}

impl Growing {
    /// The smallest buffer.
    pub(super) fn new(device: &Device, label: &'static str, usage: BufferUsages) -> Self {
        Self { label, usage, buffer: device.buffer(label, 0, usage) }
    }

    /// Makes room for `bytes`, and for a quarter more so that a growing scene does not reallocate
    /// in every frame.
    pub(super) fn reserve(&mut self, device: &Device, bytes: u64) {
        if self.buffer.size() < bytes {
            let roomy = (bytes + bytes / 4).min(device.binding_bytes()).max(bytes);
            self.buffer.destroy();
            self.buffer = device.buffer(self.label, roomy, self.usage);
        }
    }

    /// Replaces the content, from the start of the next submission on.
    pub(super) fn fill(&mut self, device: &Device, bytes: &[u8]) {
        self.reserve(device, bytes.len() as u64);
        device.queue.write_buffer(&self.buffer, 0, bytes);
    }

    pub(super) fn buffer(&self) -> &Buffer {
        &self.buffer
    }

    /// The whole buffer, as a shader sees it.
    pub(super) fn bind(&self) -> BindingResource<'_> {
        self.buffer.as_entire_binding()
    }
}
