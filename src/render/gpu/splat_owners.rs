//! The owner of every splat, for frames with classes: an instance and a class in one word.
//!
//! Instance ids alone need no such list, since the splats of one owner are one range. A class may
//! differ from each Gaussian to the next, so a kernel of its own writes the owner of each splat
//! after stage project, in the same pass. A device on which no frame asks for classes has neither
//! the kernel nor its buffers. WGSL: `shaders/splat_owners.wgsl`.

use wgpu::{BufferUsages, ComputePass};

use super::device::Device;
use super::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use super::kernel::{Groups, Kernel, module, slot_binding};
use super::layout::{Span, packed_owner};
use super::mirror::Mirror;
use super::plan::Plan;
use super::project::Project;
use super::project_work::{ProjectDispatch, ProjectWork};
use crate::stage::StageOutputs;

/// The kernel, its input, and the owners.
#[derive(Debug)]
pub(super) struct SplatOwners {
    kernel: Kernel,
    /// The owner of each chunk view, with the class of Gaussians without one.
    chunks: GrowableBuffer,
    /// The owner of each splat, with the class of its Gaussian.
    splats: GrowableBuffer,
}

impl SplatOwners {
    pub(super) fn new(device: &Device) -> Self {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let module = module(device, "splat_owners");
        Self {
            kernel: Kernel::new(device, &module, "main", &[]),
            chunks: GrowableBuffer::new(device, "chunk owners", usage),
            splats: GrowableBuffer::new(device, "splat owners", INTERMEDIATE),
        }
    }

    /// Writes the owners of the splats that stage project wrote. The buffers of splats hold
    /// `splat_capacity`.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (plan, project, mirror): (&Plan, &Project, &Mirror),
        work: &ProjectWork,
        splat_capacity: u32,
    ) {
        self.chunks.fill(device, bytemuck::cast_slice(&work.chunk_owners));
        self.splats.reserve(device, 4 * u64::from(splat_capacity));
        for (index, dispatch) in work.dispatches.iter().enumerate() {
            let ProjectDispatch { page, span, .. } = *dispatch;
            let Some(page) = mirror.page(page) else { continue };
            let [spans, page_cluster_views, cluster_views, visible, offsets] =
                project.cluster_buffers();
            let resources = [
                (0, plan.frame().as_entire_binding()),
                (1, slot_binding(spans.buffer(), index as u64, size_of::<Span>())),
                (2, page_cluster_views.bind()),
                (3, cluster_views.bind()),
                (4, page.as_entire_binding()),
                (5, visible.bind()),
                (6, offsets.bind()),
                (7, self.chunks.bind()),
                (8, self.splats.bind()),
            ];
            self.kernel.run(device, pass, Groups::Count(span.count), &resources);
        }
    }

    /// Sets the owners of splats that another backend projected.
    pub(super) fn fill(&mut self, device: &Device, outputs: &StageOutputs) {
        let mut owners = Vec::with_capacity(outputs.splats.len());
        let ends = outputs.owners.iter().skip(1).map(|next| next.first_splat as usize);
        for (owner, end) in outputs.owners.iter().zip(ends.chain([outputs.splats.len()])) {
            owners.resize(end, packed_owner(owner.instance, owner.class));
        }
        self.splats.fill(device, bytemuck::cast_slice(&owners));
    }

    /// The owner of each splat, in order of (view, global id).
    pub(super) fn splats(&self) -> &GrowableBuffer {
        &self.splats
    }
}
