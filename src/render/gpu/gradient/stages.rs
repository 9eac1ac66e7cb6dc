//! The kernels of the way back, and their buffers.

use wgpu::{BindingResource, Buffer, BufferUsages, ComputePass};

use super::GradientClusters;
use super::macro_runs::{MacroRuns, Run, RunLimits, SUMS_BYTES};
use super::pixels::TILE_DERIVATIVES;
use crate::RenderError;
use crate::gpu::bin::Bin;
use crate::gpu::device::Device;
use crate::gpu::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use crate::gpu::kernel::{Groups, Kernel, LazyShader, Recorder, module, slot_binding, slots};
use crate::gpu::layout::{Frame, MACRO_COLUMNS, MACRO_ROWS, MacroRun};
use crate::gpu::mirror::Mirror;
use crate::gpu::plan::{Plan, job};
use crate::gpu::project::{Project, SplatBuffers};
use crate::gpu::project_work::ProjectWork;
use crate::gpu::read_back::{ReadBack, mapped};
use wildcity_scene::chunk::CLUSTER;

/// Bytes of the derivatives by the pixels of a tile.
const TILE_BYTES: u64 = 4 * TILE_DERIVATIVES as u64;

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
    /// Runs of macro tiles.
    runs: GrowableBuffer,
    /// The sums of the touches of a run, then those of its instances.
    run_sums: GrowableBuffer,
    ranks: GrowableBuffer,
    touch_ranks: GrowableBuffer,
    pub(in crate::gpu) splat_sums: GrowableBuffer,
    project_spans: GrowableBuffer,
    first_lines: GrowableBuffer,
    /// Lines of the gradients of each cluster.
    pub(in crate::gpu) lines: GrowableBuffer,
    /// For each cluster view, the derivatives by the view's twist.
    pub(in crate::gpu) twists: GrowableBuffer,
    pub(in crate::gpu) read_back: ReadBack,
    /// The ranges of touches and instances.
    lists: ReadBack,
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
    pub(in crate::gpu) splat_count: u32,
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
            runs: GrowableBuffer::new(device, "runs of macro tiles", uniform),
            run_sums: buffer("sums of a run"),
            ranks: buffer("splat ranks"),
            touch_ranks: buffer("touch ranks"),
            splat_sums: buffer("splat sums"),
            project_spans: GrowableBuffer::new(device, "gradient project spans", uniform),
            first_lines: buffer("first gradient lines"),
            lines: buffer("gradient lines"),
            twists: buffer("twists"),
            read_back: ReadBack::new(device),
            lists: ReadBack::new(device),
        }
    }

    /// Reads how many touches and instances each part of a frame has, and divides the frame.
    ///
    /// # Errors
    /// The device fails; buffers may then still be mapped.
    pub(in crate::gpu) fn divide(
        &mut self,
        device: &Device,
        bin: &Bin,
        frame: &Frame,
        splats: u32,
        timestamps: &Buffer,
    ) -> Result<MacroRuns, RenderError> {
        let sources = [
            (bin.macro_ranges.buffer(), 8 * u64::from(frame.macro_tiles)),
            (bin.ranges.buffer(), 8 * u64::from(frame.tiles)),
        ];
        let recorder = Recorder::new(device, None);
        let (_, submission) = self.lists.submit(device, recorder, &sources, timestamps);
        self.lists.map(device, submission)?;
        let limits = RunLimits {
            splats,
            binding_bytes: device.binding_bytes(),
            tiles_per_page: (device.binding_bytes() / TILE_BYTES).min(u32::MAX.into()) as u32,
        };
        let pages = self.lists.pages(device)?;
        let views = &frame.view[..frame.views as usize];
        let touches = mapped(device, &pages[0])?;
        let instances = mapped(device, &pages[1])?;
        let runs = MacroRuns::new(views, touches, instances, limits);
        // A buffer cannot be unmapped while views of it exist.
        drop(pages);
        self.lists.unmap();
        Ok(runs)
    }

    /// Bytes of the largest buffer that a frame needs.
    pub(in crate::gpu) fn needed_bytes(
        splats: u32,
        runs: &MacroRuns,
        clusters: &GradientClusters,
    ) -> u64 {
        let most = u64::from(splats).max(runs.sums());
        let lines = clusters.lines * 4 * CLUSTER as u64;
        (SUMS_BYTES * most).max(lines).max(TILE_BYTES * runs.page_tiles())
    }

    /// Uploads the derivatives by the pixels of all tiles.
    pub(in crate::gpu) fn upload_derivatives(
        &mut self,
        device: &Device,
        runs: &MacroRuns,
        derivatives: &[f32],
    ) {
        for (page, tiles) in runs.pages.iter().enumerate() {
            if page == self.derivatives.len() {
                let buffer = GrowableBuffer::new(device, "derivatives by pixels", INTERMEDIATE);
                self.derivatives.push(buffer);
            }
            // Tiles are counted through all pages, as the derivatives are.
            let [start, end] = [tiles.start, tiles.end].map(|t| t as usize * TILE_DERIVATIVES);
            self.derivatives[page].fill(device, bytemuck::cast_slice(&derivatives[start..end]));
        }
    }

    /// Records the way back, after [`GradientStages::upload_derivatives`].
    pub(in crate::gpu) fn record(
        &mut self,
        device: &Device,
        recorder: &mut Recorder,
        inputs: BackwardInputs<'_>,
        work: &ProjectWork,
        runs: &MacroRuns,
        clusters: &GradientClusters,
    ) {
        let splats = u64::from(inputs.splat_count);
        self.runs.fill(device, &slots(runs.runs.iter().map(|run| run.layout)));
        self.run_sums.reserve(device, SUMS_BYTES * runs.sums());
        self.ranks.reserve(device, 4 * splats);
        self.touch_ranks.reserve(device, 4 * runs.touches());
        self.splat_sums.reserve(device, SUMS_BYTES * splats);
        self.first_lines.fill(device, bytemuck::cast_slice(&clusters.first_lines()));
        self.lines.reserve(device, clusters.lines * 4 * CLUSTER as u64);
        // A twist has six f32.
        self.twists.reserve(device, 24 * u64::from(work.cluster_views()));
        let spans = slots(clusters.dispatches.iter().map(|dispatch| dispatch.span));
        self.project_spans.fill(device, &spans);
        // Sums begin at 0.
        for buffer in [&self.splat_sums, &self.lines, &self.twists] {
            recorder.encoder.clear_buffer(buffer.buffer(), 0, None);
        }

        let mut pass = recorder.stage("blend backwards");
        self.rank(device, &mut pass, inputs);
        for (index, run) in runs.runs.iter().enumerate() {
            // All runs share the buffer of sums: each is gathered before the next one writes there.
            self.blend(device, &mut pass, inputs, index, run);
            self.gather(device, &mut pass, inputs, index, run);
        }
        drop(pass);
        let mut pass = recorder.stage("project backwards");
        self.project(device, &mut pass, inputs, clusters);
    }

    fn rank(&self, device: &Device, pass: &mut ComputePass<'_>, inputs: BackwardInputs<'_>) {
        let BackwardInputs { plan, splats, sorted_splats, .. } = inputs;
        let job = plan.job(job::SPLATS);
        let splat_indices = splats.indices[sorted_splats].bind();
        let resources = [(8, job.bind()), (9, splat_indices), (13, self.ranks.bind())];
        self.rank.run(device, pass, Groups::Job(job), &resources);
    }

    fn blend(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        inputs: BackwardInputs<'_>,
        index: usize,
        run: &Run,
    ) {
        let BackwardInputs { plan, splats, bin, .. } = inputs;
        let resources = [
            (0, plan.frame().as_entire_binding()),
            (1, self.run_binding(index)),
            (2, bin.ranges.bind()),
            (3, bin.instances.bind()),
            (4, splats.shapes.bind()),
            (5, splats.colors.bind()),
            (6, self.derivatives[run.page].bind()),
            (7, self.run_sums.bind()),
        ];
        let tiles = run.layout.macro_tiles * MACRO_COLUMNS * MACRO_ROWS;
        self.blend.run(device, pass, Groups::Count(tiles), &resources);
    }

    fn gather(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        inputs: BackwardInputs<'_>,
        index: usize,
        run: &Run,
    ) {
        let BackwardInputs { plan, splats, bin, sorted_splats, sorted_touches, .. } = inputs;
        let frame = (0, plan.frame().as_entire_binding());
        let own_run = (6, self.run_binding(index));
        let touch_ranks = (14, self.touch_ranks.bind());
        let run_sums = (12, self.run_sums.bind());
        let touches = bin.touch_resources(sorted_touches).into_iter().chain([
            frame.clone(),
            own_run.clone(),
            run_sums.clone(),
            (13, self.ranks.bind()),
            touch_ranks.clone(),
        ]);
        let touches: Vec<(u32, BindingResource<'_>)> = touches.collect();
        self.gather_touches.run(device, pass, Groups::Count(run.layout.batches), &touches);

        // The sums of a macro tile that goes on in the next run are not complete, and neither are
        // those of its splats.
        if !run.is_last {
            return;
        }
        let splats_job = plan.job(job::SPLATS);
        let of_splats = [
            frame,
            (1, bin.macro_ranges.bind()),
            own_run,
            (8, splats_job.bind()),
            (9, splats.indices[sorted_splats].bind()),
            (10, splats.keys[sorted_splats].bind()),
            (11, splats.shapes.bind()),
            touch_ranks,
            run_sums,
            (15, self.splat_sums.bind()),
        ];
        self.gather_splats.run(device, pass, Groups::Job(splats_job), &of_splats);
    }

    fn run_binding(&self, index: usize) -> BindingResource<'_> {
        slot_binding(self.runs.buffer(), index as u64, size_of::<MacroRun>())
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
