//! Stage project: the host culls clusters of Gaussians, and the device projects those that are
//! left, in order of (view, global id). Twin of `render/cpu/project`; WGSL: `shaders/project.wgsl`.
//!
//! Splats stay where they were projected, in order of (view, global id). Sorting and binning move
//! indices of splats: 8 B each in the sort of splats, 4 B each in the lists of tiles. A copy of the
//! splats in depth order was no faster to read, and doubled the memory of a frame.
//!
//! Depth is computed in f32 together with its rounding errors, and rounded once (`exact_z` in
//! `shaders/project.wgsl`). Thousands of surfels of one facade have equal depths; without
//! compensation they would be blended in the order of rounding errors. Distance, the depth of wide
//! lenses, is computed in the same way (`depth` in `shaders/unscented.wgsl`).
//!
//! Static pinhole cameras have their own kernels, which are identical to those of frames without
//! other cameras. The kernels for lenses and rolling shutters are compiled with the first view that
//! needs them.

use wgpu::{BindingResource, Buffer, BufferUsages, ComputePass, ShaderModule};

use super::device::Device;
use super::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use super::kernel::{Groups, Kernel, LazyShader, slot_binding, slots};
use super::layout::{ChunkView, Span, SplatColor, SplatShape};
use super::lens::Lenses;
use super::mirror::Mirror;
use super::plan::{Plan, job};
use super::project_work::{ProjectDispatch, ProjectWork, Projection, Variant};
use super::scan::Scan;

/// The splats of a region, and the keys by which they are sorted.
#[derive(Debug)]
pub(super) struct SplatBuffers {
    pub(super) shapes: GrowableBuffer,
    pub(super) colors: GrowableBuffer,
    /// Keys of (view, depth). The sort needs two buffers.
    pub(super) keys: [GrowableBuffer; 2],
    /// Indices into `shapes` and `colors`. The sort needs two buffers.
    pub(super) indices: [GrowableBuffer; 2],
}

impl SplatBuffers {
    pub(super) fn new(device: &Device) -> Self {
        let buffer = |label| GrowableBuffer::new(device, label, INTERMEDIATE);
        Self {
            shapes: buffer("shapes"),
            colors: buffer("colors"),
            keys: [buffer("depth keys"), buffer("depth keys")],
            indices: [buffer("splat indices"), buffer("splat indices")],
        }
    }

    /// Makes room for `count` splats. Returns how many the buffers can hold then.
    pub(super) fn reserve(&mut self, device: &Device, count: u64) -> u32 {
        self.shapes.reserve(device, count * size_of::<SplatShape>() as u64);
        self.colors.reserve(device, count * size_of::<SplatColor>() as u64);
        for buffer in self.keys.iter_mut().chain(&mut self.indices) {
            buffer.reserve(device, 4 * count);
        }
        let shapes = self.shapes.buffer().size() / size_of::<SplatShape>() as u64;
        let keys = self.keys[0].buffer().size() / 4;
        shapes.min(keys).min(Self::limit(device)) as u32
    }

    /// Most splats that a device can hold. The array with the largest elements decides.
    pub(super) fn limit(device: &Device) -> u64 {
        device.binding_bytes() / size_of::<SplatShape>() as u64
    }
}

/// The kernels of the stage, and their input.
#[derive(Debug)]
pub(super) struct Project {
    pinhole: LazyShader<Kernels, 4>,
    unscented: LazyShader<Kernels, 4>,
    /// By SH degree, for chunks of actors and those beneath them.
    pinhole_actors: LazyShader<Kernels, 4>,
    /// By SH degree, for chunks of actors and those beneath them.
    unscented_actors: LazyShader<Kernels, 4>,
    /// Made with the first frame that has actors.
    lights: Option<Lights>,
    cluster_views: GrowableBuffer,
    page_cluster_views: GrowableBuffer,
    chunk_views: GrowableBuffer,
    spans: GrowableBuffer,
    /// One bit per Gaussian of each cluster view.
    visible: GrowableBuffer,
    /// For each cluster view, the index of its first splat.
    offsets: GrowableBuffer,
}

/// Lights and shadows, which change the colours of Gaussians in frames with actors.
#[derive(Debug)]
struct Lights {
    /// One per chunk view.
    lights: GrowableBuffer,
    shadows: GrowableBuffer,
}

impl Lights {
    fn new(device: &Device) -> Self {
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let buffer = |label| GrowableBuffer::new(device, label, usage);
        Self { lights: buffer("chunk lights"), shadows: buffer("chunk shadows") }
    }

    fn bind(&self) -> [(u32, BindingResource<'_>); 2] {
        [(13, self.lights.bind()), (14, self.shadows.bind())]
    }
}

/// Both kernels of the stage for one projection and one SH degree.
#[derive(Debug)]
struct Kernels {
    cull: Kernel,
    project: Kernel,
}

impl Kernels {
    fn new(device: &Device, module: &ShaderModule, sh_degree: usize) -> Self {
        let constants = [("SH_DEGREE", sh_degree as f64)];
        let kernel = |entry| Kernel::new(device, module, entry, &constants);
        Self { cull: kernel("cull"), project: kernel("project") }
    }
}

impl Project {
    pub(super) fn new(device: &Device) -> Self {
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let buffer = |label, usage| GrowableBuffer::new(device, label, usage);
        Self {
            pinhole: LazyShader::new("project").with_module(device),
            unscented: LazyShader::new("project_unscented"),
            pinhole_actors: LazyShader::new("project_actors"),
            unscented_actors: LazyShader::new("project_unscented_actors"),
            lights: None,
            cluster_views: buffer("cluster views", storage),
            page_cluster_views: buffer("cluster views by page", storage),
            chunk_views: buffer("chunk views", storage),
            spans: buffer("project spans", uniform),
            visible: buffer("visible", INTERMEDIATE),
            offsets: buffer("cluster view offsets", INTERMEDIATE),
        }
    }

    /// Most cluster views that a device can hold. Each takes 32 B of visibility bits and, if every
    /// one is of a chunk of its own, 128 B of that chunk's [`ChunkView`], which decides.
    pub(super) fn limit(device: &Device) -> u64 {
        device.binding_bytes() / size_of::<ChunkView>() as u64
    }

    /// Uploads the work of a region.
    pub(super) fn upload(&mut self, device: &Device, work: &ProjectWork) {
        let spans = slots(work.dispatches.iter().map(|dispatch| dispatch.span));
        self.cluster_views.fill(device, bytemuck::cast_slice(&work.cluster_views));
        self.page_cluster_views.fill(device, bytemuck::cast_slice(&work.page_cluster_views));
        self.chunk_views.fill(device, bytemuck::cast_slice(&work.chunk_views));
        self.spans.fill(device, &spans);
        if !work.lights.is_empty() {
            let Lights { lights, shadows } = self.lights.get_or_insert_with(|| Lights::new(device));
            lights.fill(device, bytemuck::cast_slice(&work.lights));
            shadows.fill(device, bytemuck::cast_slice(&work.shadows));
        }
        // A bit for each of a cluster's 256 Gaussians.
        self.visible.reserve(device, 32 * u64::from(work.cluster_views()));
        self.offsets.reserve(device, 4 * u64::from(work.cluster_views()));
    }

    /// For each cluster view, the index of its first splat.
    pub(super) fn first_splats(&self) -> &GrowableBuffer {
        &self.offsets
    }

    /// Sets these indices for splats that another backend projected.
    pub(super) fn set_first_splats(&mut self, device: &Device, first_splats: &[u32]) {
        self.offsets.fill(device, bytemuck::cast_slice(first_splats));
    }

    /// Projects the work that was uploaded.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        work: &ProjectWork,
        inputs: ProjectInputs<'_>,
        splats: &SplatBuffers,
    ) {
        let ProjectInputs { plan, scan, mirror, lenses } = inputs;
        // Compile the kernels that are missing.
        for ProjectDispatch { variant, .. } in &work.dispatches {
            let degree = variant.degree();
            self.shader(*variant)
                .variant(device, degree, |module| Kernels::new(device, module, degree));
        }

        // The kernels and the input of each dispatch.
        let mut dispatches = Vec::with_capacity(work.dispatches.len());
        for (index, dispatch) in work.dispatches.iter().enumerate() {
            let ProjectDispatch { page, variant, span } = *dispatch;
            let Some(kernels) = self.kernels(variant) else { continue };
            let Some(page) = mirror.page(page) else { continue };
            let mut resources = self.resources(plan, page, &self.spans, index);
            if variant.projection == Projection::Unscented {
                resources.extend(lenses.bind());
            }
            dispatches.push((kernels, variant, Groups::Count(span.count), resources));
        }

        // Cull, give each cluster view the index of its first splat, and project.
        for (kernels, _, groups, resources) in &dispatches {
            kernels.cull.run(device, pass, *groups, resources);
        }
        // Splats lie in the order of cluster views: all are counted before the first one is
        // written.
        scan.run(device, pass, plan.job(job::CLUSTER_VIEWS), self.offsets.buffer());
        plan.set_splats(device, pass, scan.block_sums());
        for (kernels, variant, groups, mut resources) in dispatches {
            resources.extend(self.light_resources(variant));
            resources.extend([
                (8, splats.shapes.bind()),
                (9, splats.colors.bind()),
                (10, splats.keys[0].bind()),
                (11, splats.indices[0].bind()),
            ]);
            kernels.project.run(device, pass, groups, &resources);
        }
    }
}

impl Project {
    /// What the kernels of the stage have in common: slot `index` of some spans on one page.
    pub(super) fn resources<'a>(
        &'a self,
        plan: &'a Plan,
        page: &'a Buffer,
        spans: &'a GrowableBuffer,
        index: usize,
    ) -> Vec<(u32, BindingResource<'a>)> {
        vec![
            (0, plan.frame().as_entire_binding()),
            (1, slot_binding(spans.buffer(), index as u64, size_of::<Span>())),
            (2, self.page_cluster_views.bind()),
            (3, self.cluster_views.bind()),
            (4, self.chunk_views.bind()),
            (5, page.as_entire_binding()),
            (6, self.visible.bind()),
            (7, self.offsets.bind()),
        ]
    }

    /// The lights and shadows, for kernels that read them.
    pub(super) fn light_resources(&self, variant: Variant) -> Vec<(u32, BindingResource<'_>)> {
        let lights = self.lights.iter().filter(|_| variant.actors);
        lights.flat_map(Lights::bind).collect()
    }

    /// Spans, cluster views by page, cluster views, their visibility bits, and the index of the
    /// first splat of each.
    pub(super) fn cluster_buffers(&self) -> [&GrowableBuffer; 5] {
        let Self { spans, page_cluster_views, cluster_views, visible, offsets, .. } = self;
        [spans, page_cluster_views, cluster_views, visible, offsets]
    }

    /// One bit per Gaussian of each cluster view.
    pub(super) fn visible(&self) -> &GrowableBuffer {
        &self.visible
    }
}

impl Variant {
    /// The SH degree of its kernels.
    pub(super) fn degree(self) -> usize {
        usize::from(self.sh_degree.min(3))
    }
}

impl Project {
    fn shader(&mut self, variant: Variant) -> &mut LazyShader<Kernels, 4> {
        match (variant.projection, variant.actors) {
            (Projection::Pinhole, false) => &mut self.pinhole,
            (Projection::Unscented, false) => &mut self.unscented,
            (Projection::Pinhole, true) => &mut self.pinhole_actors,
            (Projection::Unscented, true) => &mut self.unscented_actors,
        }
    }

    /// The kernels of a variant, if they were compiled.
    fn kernels(&self, variant: Variant) -> Option<&Kernels> {
        let shader = match (variant.projection, variant.actors) {
            (Projection::Pinhole, false) => &self.pinhole,
            (Projection::Unscented, false) => &self.unscented,
            (Projection::Pinhole, true) => &self.pinhole_actors,
            (Projection::Unscented, true) => &self.unscented_actors,
        };
        shader.compiled(variant.degree())
    }
}

/// The input of [`Project::run`] in addition to the work.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProjectInputs<'a> {
    pub(super) plan: &'a Plan,
    pub(super) scan: &'a Scan,
    pub(super) mirror: &'a Mirror,
    pub(super) lenses: &'a Lenses,
}
