//! A frame and its gradients, in one turn: the way back reads what the stages of the frame have
//! left in their buffers.

use std::time::Instant;

use rayon::ThreadPool;
use wgpu::Buffer;

use super::record::add_stage_times;
use super::regions::{DrawInput, PreparedRegion};
use super::{Chain, CurrentFrame, Source, add_time};
use crate::actor_views::ActorViews;
use crate::gpu::gradient::{
    BackwardInputs, GradientClusters, GradientStages, HostSplats, MacroRuns, back_project, images,
    pack,
};
use crate::gpu::kernel::Recorder;
use crate::gpu::layout::{FrameView, RASTER_BATCH, SplatShape};
use crate::gpu::partition::TileRows;
use crate::gpu::project_work::{ProjectWork, Projection};
use crate::gpu::read_back::{ReadBack, mapped};
use crate::gpu::resolve::{Outputs, Pixels};
use crate::gradient::{
    GaussianImages, GradientError, Gradients, LossGradient, Partial, Twist, check_finite,
    check_sizes, mask,
};
use crate::{Frame, FrameStats, RenderError, View};
use wildcity_scene::chunk::CLUSTER;

/// A frame that was drawn, and whose buffers still hold it.
#[derive(Debug)]
struct Drawn<'a> {
    frame: &'a Frame<'a>,
    actors: ActorViews,
    current: CurrentFrame,
    work: ProjectWork,
    clusters: GradientClusters,
    runs: MacroRuns,
    splat_count: u32,
}

impl Chain {
    /// Draws a frame, asks for the derivatives of a loss by its images, and computes those by all
    /// parameters.
    ///
    /// # Errors
    /// Those of [`differentiate`](crate::gradient::Differentiate::differentiate).
    pub(in crate::gpu) fn differentiate(
        &mut self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
        pool: &ThreadPool,
    ) -> Result<FrameStats, GradientError> {
        // Taken out, so that they can be borrowed beside the rest of the chain.
        let kept = self.gradient.take();
        let mut stages = kept.unwrap_or_else(|| GradientStages::new(&self.device));
        let done = self.differentiate_in(&mut stages, frame, depth, loss, gradients, pool);
        // After a failure of the device they are not used again: some buffers may still be mapped.
        if !matches!(done, Err(GradientError::Render(RenderError::Device { .. }))) {
            self.gradient = Some(stages);
        }
        done
    }

    fn differentiate_in(
        &mut self,
        stages: &mut GradientStages,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
        pool: &ThreadPool,
    ) -> Result<FrameStats, GradientError> {
        let (mut drawn, images) = self.draw_for_gradients(stages, frame, depth, pool)?;
        let start = Instant::now();
        let mut by_images = loss(&images);
        check_sizes(frame, depth, &mut by_images)?;
        for (view, by_images) in by_images.iter().enumerate() {
            check_finite(view, by_images)?;
        }
        add_time(&mut drawn.current.stats, "loss", start.elapsed());

        let start = Instant::now();
        let views = &drawn.current.parameters.view[..frame.views.len()];
        let derivatives = pool.install(|| pack(views, &images, &by_images));
        stages.upload_derivatives(&self.device, &drawn.runs, &derivatives);
        add_time(&mut drawn.current.stats, "upload", start.elapsed());

        self.run_backwards(stages, &mut drawn)?;
        let start = Instant::now();
        self.deliver_gradients(stages, &drawn, gradients, pool)?;
        stages.read_back.unmap();
        add_time(&mut drawn.current.stats, "deliver", start.elapsed());
        Ok(drawn.current.stats)
    }

    /// Draws the images of the Gaussians, and checks that their gradients fit the device.
    fn draw_for_gradients<'a>(
        &mut self,
        stages: &mut GradientStages,
        frame: &'a Frame<'a>,
        depth: bool,
        pool: &ThreadPool,
    ) -> Result<(Drawn<'a>, Vec<GaussianImages>), GradientError> {
        let outputs = Outputs::for_gradients(depth);
        pool.install(|| self.mirror.make_resident(&self.device, frame.scene))?;
        let actors = ActorViews::new(frame);
        let mut current = self.begin(frame, &actors, &outputs)?;
        let memory = GradientError::Memory { limit_bytes: self.device.binding_bytes() };
        let rows = TileRows::from_frame(frame);
        let input = DrawInput { frame, actors: &actors, rows: &rows };
        let PreparedRegion::Ready(work, tiles) =
            self.prepare_region(input, &rows.all(), pool, &mut current)?
        else {
            // A frame in regions overwrites the splats that the way back reads.
            return Err(memory);
        };
        let needs = self.draw_region(Source::Gaussians(&work), tiles, &mut current)?;
        let head = current.read_back.head(&self.device)?;
        if needs.min_regions(self.limit()) > 1 {
            current.read_back.unmap();
            return Err(memory);
        }
        let clusters = GradientClusters::new(&work, frame.scene, &self.mirror);
        let splat_count = head.counters.splats;
        let timestamps = self.timestamps.buffer();
        let parameters = &current.parameters;
        let runs = stages.divide(&self.device, &self.bin, parameters, splat_count, timestamps)?;
        let needed = GradientStages::needed_bytes(splat_count, &runs, &clusters);
        if needed > self.device.binding_bytes() {
            current.read_back.unmap();
            return Err(memory);
        }
        let longest = u64::from(RASTER_BATCH) * u64::from(head.tile_counters.most_batches);
        self.check_loops(&current, longest).inspect_err(|_| current.read_back.unmap())?;
        let images = self.read_images(frame, &current, depth, pool)?;
        {
            let mut tally = self.tally.lock();
            tally.regions += 1;
            tally.last_frame = current.counts;
        }
        current.read_back.unmap();
        // The frame lives on with its parameters and times; its buffers are free for others.
        let read_back = std::mem::replace(&mut current.read_back, ReadBack::new(&self.device));
        self.read_backs.give_back(read_back);
        Ok((Drawn { frame, actors, current, work, clusters, runs, splat_count }, images))
    }

    /// Checks that no loop of the way back is longer than a software device can run. `longest` is
    /// the largest number of splats of a tile.
    fn check_loops(&self, current: &CurrentFrame, longest: u64) -> Result<(), RenderError> {
        let limit = self.device.max_gradient_splats();
        if longest > limit {
            let what = "splats in one tile whose gradients are computed (on a software device)";
            return Err(RenderError::TooMany { what, limit });
        }
        let limit = self.device.max_gradient_macro_tiles();
        let parameters = &current.parameters;
        let firsts = parameters.view[..parameters.views as usize].iter();
        // A view ends where the next one begins, and the last one where the frame does.
        let ends = firsts.clone().skip(1).map(|view| view.first_macro_tile);
        let most = firsts
            .zip(ends.chain([parameters.macro_tiles]))
            .map(|(view, end)| end - view.first_macro_tile)
            .max();
        if most.is_some_and(|most| u64::from(most) > limit) {
            let what = "macro tiles in a view whose gradients are computed (on a software device)";
            return Err(RenderError::TooMany { what, limit });
        }
        Ok(())
    }

    /// The images of a frame whose pixels are mapped, 0 outside of each lens' field.
    fn read_images(
        &self,
        frame: &Frame<'_>,
        current: &CurrentFrame,
        depth: bool,
        pool: &ThreadPool,
    ) -> Result<Vec<GaussianImages>, RenderError> {
        let pages = current.read_back.pages(&self.device)?;
        let words: Vec<&[u32]> =
            pages.iter().map(|page| mapped(&self.device, page)).collect::<Result<_, _>>()?;
        let pixels = Pixels {
            pages: &words,
            tiles_per_page: current.read_back.tiles_per_page,
            planes: current.planes,
        };
        let views = &current.parameters.view[..current.parameters.views as usize];
        let masked = |(layout, view): (&FrameView, &View)| {
            let mut images = images(&pixels, layout, depth);
            mask(view, &mut images);
            images
        };
        Ok(pool.install(|| views.iter().zip(frame.views).map(masked).collect()))
    }

    /// Runs the way back, and maps what the host reads of it.
    fn run_backwards(
        &self,
        stages: &mut GradientStages,
        drawn: &mut Drawn<'_>,
    ) -> Result<(), RenderError> {
        let Self { device, plan, project, mirror, splats, bin, sorted, .. } = self;
        let Drawn { current, work, clusters, runs, splat_count, .. } = drawn;
        let inputs = BackwardInputs {
            plan,
            project,
            mirror,
            splats,
            bin,
            sorted_splats: sorted.splats,
            sorted_touches: sorted.touches,
            splat_count: *splat_count,
        };
        let start = Instant::now();
        let mut recorder = Recorder::new(device, self.queries.clone());
        stages.record(device, &mut recorder, inputs, work, runs, clusters);

        let cluster_views = u64::from(work.cluster_views());
        let mut sources: Vec<(&Buffer, u64)> = vec![
            (stages.lines.buffer(), clusters.lines * 4 * CLUSTER as u64),
            (stages.twists.buffer(), 24 * cluster_views),
            (project.visible().buffer(), 32 * cluster_views),
        ];
        // Splats only if the host projects some of them backwards.
        if has_lenses(work) {
            let count = u64::from(*splat_count);
            sources.extend([
                (project.first_splats().buffer(), 4 * cluster_views),
                (splats.shapes.buffer(), size_of::<SplatShape>() as u64 * count),
                (stages.splat_sums.buffer(), size_of::<Partial>() as u64 * count),
            ]);
        }
        let (names, submission) =
            stages.read_back.submit(device, recorder, &sources, self.timestamps.buffer());
        stages.read_back.map(device, submission)?;
        device.check()?;
        let timestamps = stages.read_back.head(device)?.timestamps;
        add_stage_times(device, &mut current.stats, &names, &timestamps, start.elapsed());
        Ok(())
    }

    /// Copies what is mapped to the gradients.
    fn deliver_gradients(
        &self,
        stages: &GradientStages,
        drawn: &Drawn<'_>,
        gradients: &mut Gradients,
        pool: &ThreadPool,
    ) -> Result<(), RenderError> {
        let Drawn { frame, actors, work, clusters, .. } = drawn;
        let pages = stages.read_back.pages(&self.device)?;
        let page = |index: usize| pages.get(index).map_or(&[][..], |page| &page[..]);
        let lines: &[f32] = mapped(&self.device, page(0))?;
        let twists: &[[f32; 6]] = mapped(&self.device, page(1))?;
        let visible: &[u32] = mapped(&self.device, page(2))?;
        gradients.reset(frame.scene, frame.views.len());
        pool.install(|| clusters.copy_to(frame.scene, work, lines, visible, &mut gradients.chunks));
        // In the order of (view, global id). The device has none of lenses.
        for (cluster_view, twist) in (0..work.cluster_views()).zip(twists) {
            gradients.twists[work.view(cluster_view)] += Twist::from_array(twist.map(f64::from));
        }
        if has_lenses(work) {
            let splats = HostSplats {
                first_splats: mapped(&self.device, page(3))?,
                shapes: mapped(&self.device, page(4))?,
                sums: mapped(&self.device, page(5))?,
                visible,
            };
            pool.install(|| back_project(frame, actors, work, clusters, splats, gradients));
        }
        Ok(())
    }
}

/// Whether some view is no static pinhole.
fn has_lenses(work: &ProjectWork) -> bool {
    work.dispatches.iter().any(|dispatch| dispatch.variant.projection == Projection::Unscented)
}
