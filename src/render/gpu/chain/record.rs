//! Recording the stages of a region, and timing them.

use std::time::Duration;

use wgpu::SubmissionIndex;

use super::{Chain, CurrentFrame, Sorted, Source, add_time};
use crate::FrameStats;
use crate::constants::DEPTH_BITS;
use crate::gpu::device::Device;
use crate::gpu::kernel::{Recorder, TIMESTAMP_BYTES};
use crate::gpu::layout::{Counters, Frame as GpuFrame, Owner, TileCounters};
use crate::gpu::plan::{Counts, job};
use crate::gpu::project::ProjectInputs;
use crate::gpu::rasterize::{RasterizeInputs, TileOutput};
use crate::gpu::read_back::{TILE_COUNTERS_OFFSET, TIMESTAMP_OFFSET};
use crate::gpu::sort::{Columns, SortJobs};
use crate::gpu::splat_owners::SplatOwners;
use crate::stage::Stage;

impl Chain {
    /// Records and submits all stages of a region that must still run. Returns the names of the
    /// stages in order, and the submission.
    pub(super) fn submit(
        &mut self,
        source: Source<'_>,
        current: &CurrentFrame,
        output: &TileOutput,
    ) -> (Vec<&'static str>, SubmissionIndex) {
        let mut recorder = Recorder::new(&self.device, self.queries.clone());
        if output.planes.has_semantics() {
            let device = &self.device;
            self.splat_owners.get_or_insert_with(|| SplatOwners::new(device));
        }
        let with_classes = output.planes.has_semantics();
        self.record(&mut recorder, source, &current.parameters, Stage::Bin, with_classes);
        let Self { device, plan, project, splats, bin, lenses, timestamps, .. } = self;
        let splat_owners = self.splat_owners.as_ref().filter(|_| with_classes);

        // The owners of the splats. Only instance ids without classes read them.
        let mut resumed = Vec::new();
        let owners = match source {
            Source::Gaussians(work) => work.owners(),
            Source::Stages(outputs) if output.planes.has_owners() && !with_classes => {
                let first_splats = outputs.owners.iter().map(|owner| owner.first_splat);
                project.set_first_splats(device, &first_splats.collect::<Vec<u32>>());
                resumed.extend(outputs.owners.iter().zip(0..).map(|(owner, cluster_view)| Owner {
                    cluster_view,
                    instance: owner.instance.into(),
                }));
                &resumed[..]
            }
            Source::Stages(_) => &resumed[..],
        };
        let first_splats = project.first_splats();

        let mut pass = recorder.stage("rasterize");
        let splat_owners = splat_owners.map(SplatOwners::splats);
        let inputs =
            RasterizeInputs { plan, splats, bin, lenses, owners, first_splats, splat_owners };
        self.rasterize.run(device, &mut pass, inputs, output, current.parameters.tiles);
        // The pass borrows the encoder until here.
        drop(pass);

        // Copy all values that the host reads.
        let read_back = &current.read_back;
        let timestamps = timestamps.buffer();
        let head = read_back.head.buffer();
        let stages = recorder.finish_stages(timestamps);
        let encoder = &mut recorder.encoder;
        encoder.copy_buffer_to_buffer(plan.counters(), 0, head, 0, size_of::<Counters>() as u64);
        let bytes = size_of::<TileCounters>() as u64;
        let tile_counters = plan.tile_counters();
        encoder.copy_buffer_to_buffer(tile_counters, 0, head, TILE_COUNTERS_OFFSET, bytes);
        encoder.copy_buffer_to_buffer(timestamps, 0, head, TIMESTAMP_OFFSET, TIMESTAMP_BYTES);
        self.rasterize.copy(encoder, &read_back.pages, output);
        let submission = device.queue.submit([recorder.encoder.finish()]);
        (stages, submission)
    }

    /// Records the stages up to and including `last` that must still run. `with_classes` also
    /// writes the owner of each splat.
    pub(super) fn record(
        &mut self,
        recorder: &mut Recorder,
        source: Source<'_>,
        parameters: &GpuFrame,
        last: Stage,
        with_classes: bool,
    ) {
        // Stages that another backend has run are skipped, and so are those beyond the last one.
        let must_run = |stage| stage <= last && source.needs(stage);
        let counts = match source {
            Source::Gaussians(work) => {
                Counts { cluster_views: work.cluster_views(), ..Counts::default() }
            }
            Source::Stages(outputs) => self.fill(outputs),
        };
        let Self { device, mirror, plan, scan, splats, splat_owners, lenses, .. } = self;
        let splat_owners = splat_owners.as_mut().filter(|_| with_classes);
        plan.start(device, parameters, &counts);

        if let Source::Gaussians(work) = source {
            let mut pass = recorder.stage("project");
            let inputs = ProjectInputs { plan, scan, mirror, lenses };
            self.project.run(device, &mut pass, work, inputs, splats);
            if let Some(owners) = splat_owners {
                let stage = (&*plan, &self.project, &*mirror);
                owners.run(device, &mut pass, stage, work, parameters.splat_capacity);
            }
        } else if let (Source::Stages(outputs), Some(owners)) = (source, splat_owners) {
            owners.fill(device, outputs);
        }

        let mut sorted = Sorted::default();
        if must_run(Stage::Sort) {
            let mut pass = recorder.stage("sort");
            let jobs = SortJobs {
                keys: plan.job(job::SPLATS_SORT),
                counters: plan.job(job::SPLATS_DIGITS),
            };
            // A key has the number of the view above the depth, so few views may take fewer passes
            // of the sort.
            let depth_bits = DEPTH_BITS + bits(parameters.views - 1);
            let data = Columns { keys: &splats.keys, values: &splats.indices, masks: None };
            sorted.splats = self.sort.run(device, &mut pass, scan, jobs, data, depth_bits);
        }

        if must_run(Stage::Bin) {
            // Outside of a pass, since a buffer is cleared by the encoder. Tiles without splats
            // write no range.
            self.bin.clear_ranges(&mut recorder.encoder);
            let mut pass = recorder.stage("bin");
            self.bin.list_touches(device, &mut pass, plan, scan, splats, sorted.splats);
            drop(pass);

            let mut pass = recorder.stage("tile sort");
            let jobs = SortJobs {
                keys: plan.job(job::TOUCHES_SORT),
                counters: plan.job(job::TOUCHES_DIGITS),
            };
            // Touches of no tile have the number after the last macro tile.
            let macro_tile_bits = bits(parameters.macro_tiles);
            let data = self.bin.touches();
            sorted.touches = self.sort.run(device, &mut pass, scan, jobs, data, macro_tile_bits);
            drop(pass);

            let mut pass = recorder.stage("expand");
            let macro_tiles = parameters.macro_tiles;
            let touches = sorted.touches;
            self.bin.list_instances(device, &mut pass, plan, scan, macro_tiles, touches);
        }
        self.sorted = sorted;
    }
}

/// Adds the time of each stage by the device's clock. If it has none, adds the time of the whole
/// submission as "device".
pub(super) fn add_stage_times(
    device: &Device,
    stats: &mut FrameStats,
    stages: &[&'static str],
    timestamps: &[u64],
    whole: Duration,
) {
    let Some(tick_ns) = device.tick_ns() else {
        add_time(stats, "device", whole);
        return;
    };
    for (stage, ticks) in stages.iter().zip(timestamps.chunks_exact(2)) {
        // A clock that was reset in between gives 0, and not a time of years.
        let ns = ticks[1].saturating_sub(ticks[0]) as f64 * f64::from(tick_ns);
        add_time(stats, stage, Duration::from_nanos(ns as u64));
    }
}

/// Number of significant bits of a number.
fn bits(number: u32) -> u32 {
    u32::BITS - number.leading_zeros()
}
