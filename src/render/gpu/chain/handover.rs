//! Handing over in mid-frame: from another backend to the device, and from the device to tests.

use bytemuck::AnyBitPattern;
use rayon::ThreadPool;
use wgpu::{Buffer, CommandEncoderDescriptor};

use super::{Chain, Source};
use crate::gpu::kernel::{Recorder, TICKS_BYTES};
use crate::gpu::layout::{Counters, Frame as GpuFrame, SplatColor, SplatShape};
use crate::gpu::parts::Needs;
use crate::gpu::plan::Counts;
use crate::gpu::project::Work;
use crate::gpu::read_back::{Drawn, ReadBack, TICKS_OFFSET};
use crate::gpu::resolve::Wanted;
use crate::layout::{Cutoffs, Splat};
use crate::stage::{Stage, StageOutputs, TileLists};
use crate::{Frame, FrameStats, RenderError};

impl Chain {
    /// Draws the rest of a frame.
    ///
    /// # Errors
    /// The device fails, or the frame needs more than it can hold.
    pub(in crate::gpu) fn resume(
        &mut self,
        between: &StageOutputs,
        frame: &Frame<'_>,
        wanted: &Wanted,
    ) -> Result<Drawn, RenderError> {
        self.expect(between)?;
        let planes = wanted.planes;
        let (mut gpu_frame, read_back) = self.begin(frame, wanted)?;
        let (tiles, mut stats) = (0..gpu_frame.tiles, FrameStats::default());
        let output = (planes, &tiles, read_back.tiles_per_page);
        let source = Source::StageOutputs(between);
        let needs = self.draw_part(source, &mut gpu_frame, output, &read_back, &mut stats)?;
        self.check_room(needs)?;
        self.finish(read_back, &gpu_frame, stats)
    }

    /// Runs the stages up to and including `last`, after those that `done` is the result of, and
    /// reads what they leave.
    ///
    /// # Errors
    /// The device fails, or the frame needs more than it can hold.
    pub(in crate::gpu) fn run_through(
        &mut self,
        frame: &Frame<'_>,
        done: Option<&StageOutputs>,
        last: Stage,
        cull: &ThreadPool,
    ) -> Result<StageOutputs, RenderError> {
        let work;
        let source = match done {
            Some(between) => {
                self.expect(between)?;
                Source::StageOutputs(between)
            }
            None => {
                cull.install(|| self.mirror.hold(&self.device, frame.scene))?;
                work = cull.install(|| Work::new(frame, 0..frame.views.len(), &self.mirror));
                self.lenses.hold(&self.device, frame);
                self.project.upload(&self.device, &work);
                Source::Gaussians(&work)
            }
        };
        let mut gpu_frame = GpuFrame::new(frame.views, &Cutoffs::new(frame.profile));
        let mut read_back = ReadBack::new(&self.device);
        read_back.head.reserve(&self.device, TICKS_OFFSET + TICKS_BYTES);
        loop {
            self.reserve(&mut gpu_frame, source.items());
            let mut recorder = Recorder::new(&self.device, None);
            let sorted = self.record(&mut recorder, source, &gpu_frame, last);
            let (from, to) = (self.plan.counters(), read_back.head.buffer());
            let bytes = size_of::<Counters>() as u64;
            recorder.encoder.copy_buffer_to_buffer(from, 0, to, 0, bytes);
            let submission = self.device.queue.submit([recorder.encoder.finish()]);
            read_back.map(&self.device, submission)?;
            self.device.check()?;
            let (counters, _) = read_back.head(&self.device)?;
            read_back.unmap();
            let (needs, fits) = self.learn(&counters, &gpu_frame);
            self.check_room(needs)?;
            if fits {
                return self.read(sorted, &counters, gpu_frame.tiles, last);
            }
        }
    }

    /// Makes sure that there will be room for what another backend did.
    fn expect(&mut self, between: &StageOutputs) -> Result<(), RenderError> {
        let Counts { splats, instances, .. } = counts(between);
        let needs =
            Needs { splats: splats.into(), touches: 0, instances: instances.into(), crowd: 0 };
        self.check_room(needs)?;
        self.high_water = self.high_water.max(needs);
        Ok(())
    }

    /// What is handed over is not drawn in parts: it must fit the device at once.
    fn check_room(&self, needs: Needs) -> Result<(), RenderError> {
        let limit = self.limit();
        for (what, needed, limit) in [
            ("visible splats at once", needs.splats, limit.splats),
            ("(Gaussian, macro tile) pairs at once", needs.touches, limit.touches),
            ("(Gaussian, tile) pairs at once", needs.instances, limit.instances),
            ("visible splats in 32 tiles (of a device in software)", needs.crowd, limit.crowd),
        ] {
            if needed > limit {
                return Err(RenderError::TooMany { what, limit });
            }
        }
        Ok(())
    }

    /// Fills the buffers that the stages which are done would have filled.
    pub(super) fn fill(&mut self, between: &StageOutputs) -> Counts {
        let Self { device, splats, bin, .. } = self;
        let shapes: Vec<SplatShape> = between.splats.iter().map(shape).collect();
        let colors: Vec<SplatColor> = between.splats.iter().map(color).collect();
        splats.shapes.fill(device, bytemuck::cast_slice(&shapes));
        splats.colors.fill(device, bytemuck::cast_slice(&colors));
        let in_order = |places: &[u32]| -> Vec<u32> {
            places.iter().map(|&place| between.keys[place as usize]).collect()
        };
        let places: Vec<u32> = match &between.order {
            Some(order) => order.clone(),
            None => (0..between.splats.len() as u32).collect(),
        };
        splats.keys[0].fill(device, bytemuck::cast_slice(&in_order(&places)));
        splats.places[0].fill(device, bytemuck::cast_slice(&places));
        if let Some(TileLists { ranges, instances }) = &between.tiles {
            bin.ranges.fill(device, bytemuck::cast_slice(ranges));
            bin.instances.fill(device, bytemuck::cast_slice(instances));
        }
        counts(between)
    }

    /// Reads what the stages up to `last` left.
    fn read(
        &self,
        sorted: usize,
        counters: &Counters,
        tiles: u32,
        last: Stage,
    ) -> Result<StageOutputs, RenderError> {
        let Self { device, splats, bin, .. } = self;
        let (count, instances) = (u64::from(counters.splats), u64::from(counters.instances));
        let mut from: Vec<(&Buffer, u64)> = vec![
            (splats.shapes.buffer(), count * size_of::<SplatShape>() as u64),
            (splats.colors.buffer(), count * size_of::<SplatColor>() as u64),
            (splats.keys[sorted].buffer(), 4 * count),
            (splats.places[sorted].buffer(), 4 * count),
        ];
        if last >= Stage::Bin {
            from.push((bin.ranges.buffer(), 8 * u64::from(tiles)));
            from.push((bin.instances.buffer(), 4 * instances));
        }
        let mut read_back = ReadBack::new(device);
        let descriptor = CommandEncoderDescriptor { label: Some("handover") };
        let mut encoder = device.device.create_command_encoder(&descriptor);
        for (buffer, bytes) in &from {
            let mut to = ReadBack::buffer(device, "handover read back");
            to.reserve(device, *bytes);
            encoder.copy_buffer_to_buffer(buffer, 0, to.buffer(), 0, *bytes);
            read_back.pages.push(to);
        }
        read_back.map(device, device.queue.submit([encoder.finish()]))?;
        device.check()?;
        let pages = read_back.pages(device)?;
        let page = |k: usize| &pages[k][..from[k].1 as usize];

        let (shapes, colors) = (values::<SplatShape>(page(0)), values::<SplatColor>(page(1)));
        let (keys, places) = (values::<u32>(page(2)), values::<u32>(page(3)));
        let mut between = StageOutputs {
            splats: shapes.iter().zip(&colors).map(splat).collect(),
            keys: vec![0; keys.len()],
            ..StageOutputs::default()
        };
        for (key, place) in keys.into_iter().zip(&places) {
            // A sort that is wrong may name any place.
            if let Some(of) = between.keys.get_mut(*place as usize) {
                *of = key;
            }
        }
        between.order = (last >= Stage::Sort).then_some(places);
        between.tiles = (last >= Stage::Bin)
            .then(|| TileLists { ranges: values(page(4)), instances: values(page(5)) });
        Ok(between)
    }
}

fn values<T: AnyBitPattern>(bytes: &[u8]) -> Vec<T> {
    bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
}

fn counts(between: &StageOutputs) -> Counts {
    // More than 2^32 fit nowhere, and are refused as many.
    let count = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
    let instances = between.tiles.as_ref().map_or(0, |tiles| tiles.instances.len());
    Counts { items: 0, splats: count(between.splats.len()), instances: count(instances) }
}

fn shape(splat: &Splat) -> SplatShape {
    let Splat { mean_px, factor, log2_opacity, extent_px, .. } = *splat;
    SplatShape { mean_px, extent_px, factor, log2_opacity }
}

fn color(splat: &Splat) -> SplatColor {
    SplatColor { rgb: splat.rgb, depth_m: splat.depth_m }
}

fn splat((shape, color): (&SplatShape, &SplatColor)) -> Splat {
    let SplatShape { mean_px, extent_px, factor, log2_opacity } = *shape;
    let SplatColor { rgb, depth_m } = *color;
    Splat { mean_px, factor, log2_opacity, rgb, depth_m, extent_px }
}
