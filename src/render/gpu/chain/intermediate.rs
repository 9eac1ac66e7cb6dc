//! Starting or ending in the middle of a frame: the outputs of another backend's stages become the
//! input of this one's, and tests read the outputs of this one's stages.

use bytemuck::AnyBitPattern;
use rayon::ThreadPool;
use wgpu::Buffer;

use super::{Chain, Source};
use crate::actor_views::ActorViews;
use crate::gpu::kernel::Recorder;
use crate::gpu::layout::{Counters, Frame as GpuFrame, SplatColor, SplatShape};
use crate::gpu::partition::Capacity;
use crate::gpu::plan::Counts;
use crate::gpu::project_work::ProjectWork;
use crate::gpu::read_back::{MappedFrame, ReadBack};
use crate::gpu::resolve::Outputs;
use crate::layout::Splat;
use crate::stage::{Stage, StageOutputs, TileLists};
use crate::{Frame, RenderError};

impl Chain {
    /// Draws the rest of a frame after the stages that another backend has run.
    ///
    /// # Errors
    /// The device fails, or the frame needs more than the device can hold at once.
    pub(in crate::gpu) fn resume(
        &mut self,
        done: &StageOutputs,
        frame: &Frame<'_>,
        outputs: &Outputs,
    ) -> Result<MappedFrame, RenderError> {
        self.make_room(done)?;
        let mut current = self.begin(frame, &ActorViews::new(frame), outputs)?;
        let tiles = 0..current.parameters.tiles;
        let needs = self.draw_region(Source::Stages(done), tiles, &mut current)?;
        self.check_room(needs)?;
        self.finish(current)
    }

    /// Runs the stages up to and including `last`, from the beginning or after those whose outputs
    /// are `done`, and reads their outputs.
    ///
    /// # Errors
    /// The device fails, or the frame needs more than the device can hold at once.
    pub(in crate::gpu) fn run_through(
        &mut self,
        frame: &Frame<'_>,
        done: Option<&StageOutputs>,
        last: Stage,
        cull: &ThreadPool,
    ) -> Result<StageOutputs, RenderError> {
        let work;
        let source = match done {
            Some(outputs) => {
                self.make_room(outputs)?;
                Source::Stages(outputs)
            }
            None => {
                let views = 0..frame.views.len();
                cull.install(|| self.mirror.make_resident(&self.device, frame.scene))?;
                let actors = ActorViews::new(frame);
                work = cull.install(|| ProjectWork::new(frame, views, &actors, &self.mirror));
                self.lenses.upload(&self.device, frame, &actors);
                self.project.upload(&self.device, &work);
                Source::Gaussians(&work)
            }
        };
        let mut parameters = GpuFrame::new(frame.views, frame.profile);
        let mut read_back = ReadBack::new(&self.device);
        read_back.reserve_head(&self.device);
        loop {
            // Run the stages, and read the counters.
            self.reserve(&mut parameters, source.cluster_views());
            let mut recorder = Recorder::new(&self.device, None);
            self.record(&mut recorder, source, &parameters, last, false);
            let from = self.plan.counters();
            let to = read_back.head.buffer();
            let bytes = size_of::<Counters>() as u64;
            recorder.encoder.copy_buffer_to_buffer(from, 0, to, 0, bytes);
            let submission = self.device.queue.submit([recorder.encoder.finish()]);
            read_back.map(&self.device, submission)?;
            self.device.check()?;
            let counters = read_back.head(&self.device)?.counters;
            read_back.unmap();

            // Read the outputs, or try again in larger buffers.
            let (needs, fits) = self.evaluate(&counters, &parameters);
            self.check_room(needs)?;
            if fits {
                return self.read(&counters, parameters.tiles, last);
            }
        }
    }

    /// Makes sure that the buffers will be large enough for another backend's outputs.
    fn make_room(&mut self, outputs: &StageOutputs) -> Result<(), RenderError> {
        let Counts { splats, instances, .. } = counts(outputs);
        // No stage of another backend has touches: stage bin counts those that it needs.
        let needs = Capacity { splats: splats.into(), touches: 0, instances: instances.into() };
        self.check_room(needs)?;
        self.high_water = self.high_water.max(needs);
        Ok(())
    }

    /// A frame that starts or ends in the middle is not drawn region by region: it must fit the
    /// device at once.
    fn check_room(&self, needs: Capacity) -> Result<(), RenderError> {
        let limit = self.limit();
        for (what, needed, limit) in [
            ("visible splats at once", needs.splats, limit.splats),
            ("(Gaussian, macro tile) pairs at once", needs.touches, limit.touches),
            ("(Gaussian, tile) pairs at once", needs.instances, limit.instances),
        ] {
            if needed > limit {
                return Err(RenderError::TooMany { what, limit });
            }
        }
        Ok(())
    }

    /// Uploads the outputs of another backend's stages to the buffers that this one's would have
    /// filled.
    pub(super) fn fill(&mut self, outputs: &StageOutputs) -> Counts {
        let Self { device, splats, bin, .. } = self;
        let shapes: Vec<SplatShape> = outputs.splats.iter().map(shape).collect();
        let colors: Vec<SplatColor> = outputs.splats.iter().map(color).collect();
        splats.shapes.fill(device, bytemuck::cast_slice(&shapes));
        splats.colors.fill(device, bytemuck::cast_slice(&colors));
        // On the device keys and indices are in the order of the sort, if it has run.
        let indices: Vec<u32> = match &outputs.order {
            Some(order) => order.clone(),
            None => (0..outputs.splats.len() as u32).collect(),
        };
        let keys: Vec<u32> = indices.iter().map(|&index| outputs.keys[index as usize]).collect();
        splats.keys[0].fill(device, bytemuck::cast_slice(&keys));
        splats.indices[0].fill(device, bytemuck::cast_slice(&indices));
        if let Some(TileLists { ranges, instances }) = &outputs.tiles {
            bin.ranges.fill(device, bytemuck::cast_slice(ranges));
            bin.instances.fill(device, bytemuck::cast_slice(instances));
        }
        counts(outputs)
    }

    /// Reads the outputs of the stages up to `last`.
    fn read(
        &self,
        counters: &Counters,
        tiles: u32,
        last: Stage,
    ) -> Result<StageOutputs, RenderError> {
        // Copy the buffers to ones that the host can read.
        let Self { device, splats, bin, sorted, .. } = self;
        let sorted = sorted.splats;
        let count = u64::from(counters.splats);
        let mut sources: Vec<(&Buffer, u64)> = vec![
            (splats.shapes.buffer(), count * size_of::<SplatShape>() as u64),
            (splats.colors.buffer(), count * size_of::<SplatColor>() as u64),
            (splats.keys[sorted].buffer(), 4 * count),
            (splats.indices[sorted].buffer(), 4 * count),
        ];
        if last >= Stage::Bin {
            sources.push((bin.ranges.buffer(), 8 * u64::from(tiles)));
            sources.push((bin.instances.buffer(), 4 * u64::from(counters.instances)));
        }
        let mut read_back = ReadBack::new(device);
        let recorder = Recorder::new(device, None);
        let (_, submission) =
            read_back.submit(device, recorder, &sources, self.timestamps.buffer());
        read_back.map(device, submission)?;
        device.check()?;
        let pages = read_back.pages(device)?;
        // A page may be larger than what was copied to it.
        let page = |k: usize| &pages[k][..sources[k].1 as usize];

        // Decode them.
        let shapes = values::<SplatShape>(page(0));
        let colors = values::<SplatColor>(page(1));
        let keys = values::<u32>(page(2));
        let indices = values::<u32>(page(3));
        let mut outputs = StageOutputs {
            splats: shapes.iter().zip(&colors).map(|(shape, color)| splat(shape, color)).collect(),
            keys: vec![0; keys.len()],
            ..StageOutputs::default()
        };
        for (key, index) in keys.into_iter().zip(&indices) {
            // A wrong sort may yield any index.
            if let Some(slot) = outputs.keys.get_mut(*index as usize) {
                *slot = key;
            }
        }
        outputs.order = (last >= Stage::Sort).then_some(indices);
        outputs.tiles = (last >= Stage::Bin)
            .then(|| TileLists { ranges: values(page(4)), instances: values(page(5)) });
        Ok(outputs)
    }
}

fn values<T: AnyBitPattern>(bytes: &[u8]) -> Vec<T> {
    bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
}

fn counts(outputs: &StageOutputs) -> Counts {
    // No device has room for 2^32 or more, so the largest number is refused like them.
    let count = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
    let instances = outputs.tiles.as_ref().map_or(0, |tiles| tiles.instances.len());
    Counts { cluster_views: 0, splats: count(outputs.splats.len()), instances: count(instances) }
}

fn shape(splat: &Splat) -> SplatShape {
    let Splat { mean_px, factor, log2_opacity, extent_px, .. } = *splat;
    SplatShape { mean_px, extent_px, factor, log2_opacity }
}

fn color(splat: &Splat) -> SplatColor {
    SplatColor { rgb: splat.rgb, depth_m: splat.depth_m }
}

fn splat(shape: &SplatShape, color: &SplatColor) -> Splat {
    let SplatShape { mean_px, extent_px, factor, log2_opacity } = *shape;
    let SplatColor { rgb, depth_m } = *color;
    Splat { mean_px, factor, log2_opacity, rgb, depth_m, extent_px }
}
