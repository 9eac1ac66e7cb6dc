//! The kernels of the way back, and their buffers.

use wgpu::{BindingResource, BufferUsages, ComputePass};

use super::GradientClusters;
use super::pixels::TILE_DERIVATIVES;
use crate::gpu::bin::Bin;
use crate::gpu::device::Device;
use crate::gpu::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use crate::gpu::kernel::{Groups, Kernel, LazyShader, Recorder, module, slot_binding, span_slots};
use crate::gpu::layout::{Counters, Span};
use crate::gpu::mirror::Mirror;
use crate::gpu::plan::{Plan, job};
use crate::gpu::project::{Project, SplatBuffers};
use crate::gpu::project_work::ProjectWork;
use crate::gpu::rasterize::pages;
use crate::gpu::read_back::ReadBack;
use crate::gradient::Partial;
use wildcity_scene::chunk::CLUSTER;

/// Bytes of the sums of a splat, a touch or an instance.
const SUMS_BYTES: u64 = size_of::<Partial>() as u64;

/// The kernels of the way back, and their buffers.
#[derive(Debug)]
pub(in crate::gpu) struct GradientStages {
    blend: Kernel,
    rank: Kernel,
    gather_touches: Kernel,
    gather_splats: Kernel,
    /// By SH degree, for chunks of the twin.
    project: LazyShader<Kernel, 4>,
    /// By SH degree, for chunks of actors.
    project_actors: LazyShader<Kernel, 4>,
    /// The derivatives by the pixels of each tile, page by page.
    derivatives: Vec<GrowableBuffer>,
    tile_spans: GrowableBuffer,
    instance_sums: GrowableBuffer,
    ranks: GrowableBuffer,
    touch_ranks: GrowableBuffer,
    touch_sums: GrowableBuffer,
    pub(in crate::gpu) splat_sums: GrowableBuffer,
    project_spans: GrowableBuffer,
    first_lines: GrowableBuffer,
    /// Lines of the gradients of each cluster.
    pub(in crate::gpu) lines: GrowableBuffer,
    /// For each cluster view, the derivatives by the view's twist.
    pub(in crate::gpu) twists: GrowableBuffer,
    pub(in crate::gpu) read_back: ReadBack,
}

/// What the stages of the frame have left.
#[derive(Clone, Copy, Debug)]
pub(in crate::gpu) struct BackwardInputs<'a> {
    pub(in crate::gpu) plan: &'a Plan,
    pub(in crate::gpu) project: &'a Project,
    pub(in crate::gpu) mirror: &'a Mirror,
    pub(in crate::gpu) splats: &'a SplatBuffers,
    pub(in crate::gpu) bin: &'a Bin,
    pub(in crate::gpu) sorted_splats: usize,
    pub(in crate::gpu) sorted_touches: usize,
    pub(in crate::gpu) counters: Counters,
    /// Tiles of the frame.
    pub(in crate::gpu) tiles: u32,
}

impl GradientStages {
    pub(in crate::gpu) fn new(device: &Device) -> Self {
        let gather = module(device, "gather");
        let kernel = |entry| Kernel::new(device, &gather, entry, &[]);
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let buffer = |label| GrowableBuffer::new(device, label, INTERMEDIATE);
        Self {
            blend: Kernel::new(device, &module(device, "rasterize_gradient"), "main", &[]),
            rank: kernel("rank"),
            gather_touches: kernel("touches"),
            gather_splats: kernel("splats"),
            project: LazyShader::new("project_gradient"),
            project_actors: LazyShader::new("project_gradient_actors"),
            derivatives: Vec::new(),
            tile_spans: GrowableBuffer::new(device, "gradient tile spans", uniform),
            instance_sums: buffer("instance sums"),
            ranks: buffer("splat ranks"),
            touch_ranks: buffer("touch ranks"),
            touch_sums: buffer("touch sums"),
            splat_sums: buffer("splat sums"),
            project_spans: GrowableBuffer::new(device, "gradient project spans", uniform),
            first_lines: buffer("first gradient lines"),
            lines: buffer("gradient lines"),
            twists: buffer("twists"),
            read_back: ReadBack::new(device),
        }
    }

    /// Bytes of the largest buffer that a frame needs.
    pub(in crate::gpu) fn needed_bytes(counters: &Counters, clusters: &GradientClusters) -> u64 {
        let Counters { splats, touches, instances } = *counters;
        let most = splats.max(touches).max(instances);
        (SUMS_BYTES * u64::from(most)).max(clusters.lines * 4 * CLUSTER as u64)
    }

    /// Uploads the derivatives by the pixels of all tiles.
    pub(in crate::gpu) fn upload_derivatives(&mut self, device: &Device, derivatives: &[f32]) {
        let tiles = (derivatives.len() / TILE_DERIVATIVES) as u32;
        let pages: Vec<_> = pages(&(0..tiles), Self::tiles_per_page(device)).collect();
        let spans =
            pages.iter().map(|(_, tiles)| Span { first: tiles.start, count: tiles.len() as u32 });
        self.tile_spans.fill(device, &span_slots(spans));
        for (page, tiles) in pages {
            if page == self.derivatives.len() {
                let buffer = GrowableBuffer::new(device, "derivatives by pixels", INTERMEDIATE);
                self.derivatives.push(buffer);
            }
            let [start, end] = [tiles.start, tiles.end].map(|t| t as usize * TILE_DERIVATIVES);
            self.derivatives[page].fill(device, bytemuck::cast_slice(&derivatives[start..end]));
        }
    }

    fn tiles_per_page(device: &Device) -> u32 {
        let most = device.binding_bytes() / (4 * TILE_DERIVATIVES as u64);
        most.min(u64::from(u32::MAX)) as u32
    }

    /// Records the way back, after [`GradientStages::upload_derivatives`].
    pub(in crate::gpu) fn record(
        &mut self,
        device: &Device,
        recorder: &mut Recorder,
        inputs: BackwardInputs<'_>,
        work: &ProjectWork,
        clusters: &GradientClusters,
    ) {
        let Counters { splats, touches, instances } = inputs.counters;
        self.instance_sums.reserve(device, SUMS_BYTES * u64::from(instances));
        self.ranks.reserve(device, 4 * u64::from(splats));
        self.touch_ranks.reserve(device, 4 * u64::from(touches));
        self.touch_sums.reserve(device, SUMS_BYTES * u64::from(touches));
        self.splat_sums.reserve(device, SUMS_BYTES * u64::from(splats));
        self.first_lines.fill(device, bytemuck::cast_slice(&clusters.first_lines()));
        self.lines.reserve(device, clusters.lines * 4 * CLUSTER as u64);
        self.twists.reserve(device, 24 * u64::from(work.cluster_views()));
        let spans = span_slots(clusters.dispatches.iter().map(|dispatch| dispatch.span));
        self.project_spans.fill(device, &spans);
        // Splats behind the last one that a tile blends have no sums, and lines begin at 0.
        for buffer in [&self.instance_sums, &self.lines, &self.twists] {
            recorder.encoder.clear_buffer(buffer.buffer(), 0, None);
        }

        let mut pass = recorder.stage("blend backwards");
        self.blend(device, &mut pass, inputs);
        drop(pass);
        let mut pass = recorder.stage("gather");
        self.gather(device, &mut pass, inputs);
        drop(pass);
        let mut pass = recorder.stage("project backwards");
        self.project(device, &mut pass, inputs, clusters);
    }

    fn blend(&self, device: &Device, pass: &mut ComputePass<'_>, inputs: BackwardInputs<'_>) {
        let BackwardInputs { plan, splats, bin, tiles, .. } = inputs;
        for (page, tiles) in pages(&(0..tiles), Self::tiles_per_page(device)) {
            let span = slot_binding(self.tile_spans.buffer(), page as u64, size_of::<Span>());
            let resources = [
                (0, plan.frame().as_entire_binding()),
                (1, span),
                (2, bin.ranges.bind()),
                (3, bin.instances.bind()),
                (4, splats.shapes.bind()),
                (5, splats.colors.bind()),
                (6, self.derivatives[page].bind()),
                (7, self.instance_sums.bind()),
            ];
            self.blend.run(device, pass, Groups::Count(tiles.len() as u32), &resources);
        }
    }

    fn gather(&self, device: &Device, pass: &mut ComputePass<'_>, inputs: BackwardInputs<'_>) {
        let BackwardInputs { plan, splats, bin, sorted_splats, sorted_touches, .. } = inputs;
        let splats_job = plan.job(job::SPLATS);
        let splat_indices = (9, splats.indices[sorted_splats].bind());
        let ranks = (13, self.ranks.bind());
        let rank = [(8, splats_job.bind()), splat_indices.clone(), ranks.clone()];
        self.rank.run(device, pass, Groups::Job(splats_job), &rank);

        let frame = (0, plan.frame().as_entire_binding());
        let touch_ranks = (14, self.touch_ranks.bind());
        let touch_sums = (15, self.touch_sums.bind());
        let batches = plan.job(job::BATCHES);
        let touches = bin.touch_resources(sorted_touches).into_iter().chain([
            frame.clone(),
            (6, batches.bind()),
            (7, plan.job(job::INSTANCES).bind()),
            (12, self.instance_sums.bind()),
            ranks,
            touch_ranks.clone(),
            touch_sums.clone(),
        ]);
        let touches: Vec<(u32, BindingResource<'_>)> = touches.collect();
        self.gather_touches.run(device, pass, Groups::Job(batches), &touches);

        let [macro_ranges, ..] = bin.touch_resources(sorted_touches);
        let of_splats = [
            frame,
            macro_ranges,
            (8, splats_job.bind()),
            splat_indices,
            (10, splats.keys[sorted_splats].bind()),
            (11, splats.shapes.bind()),
            touch_ranks,
            touch_sums,
            (16, self.splat_sums.bind()),
        ];
        self.gather_splats.run(device, pass, Groups::Job(splats_job), &of_splats);
    }

    fn project(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        inputs: BackwardInputs<'_>,
        clusters: &GradientClusters,
    ) {
        let BackwardInputs { plan, project, mirror, splats, .. } = inputs;
        for (index, dispatch) in clusters.dispatches.iter().enumerate() {
            let Some(page) = mirror.page(dispatch.page) else { continue };
            let variant = dispatch.variant;
            let degree = variant.degree();
            let shader = if variant.actors { &mut self.project_actors } else { &mut self.project };
            let kernel = shader.variant(device, degree, |module| {
                Kernel::new(device, module, "back_project", &[("SH_DEGREE", degree as f64)])
            });
            let mut resources = project.resources(plan, page, &self.project_spans, index);
            resources.extend(project.light_resources(variant));
            resources.extend([
                (8, splats.shapes.bind()),
                (9, splats.colors.bind()),
                (15, self.splat_sums.bind()),
                (16, self.first_lines.bind()),
                (17, self.lines.bind()),
                (18, self.twists.bind()),
            ]);
            kernel.run(device, pass, Groups::Count(dispatch.span.count), &resources);
        }
    }
}
