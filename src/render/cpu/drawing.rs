//! Draws a frame within the limit of its intermediate buffers: all views at once, or one half of
//! them after the other, or one view slab by slab. The images do not depend on this choice.

use fearless_simd::Level;

use super::overflow::PartError;
use super::part::FramePart;
use super::project::{self, Job, ProjectLimits};
use super::slabs::{Cut, DepthClusters, Slab};
use super::unfinished::{Continued, UnfinishedTiles};
use super::{Scratch, StageTimer, bin, rasterize};
use crate::layout::Cutoffs;
use crate::samples::{is_sampled, sample_view};
use crate::stage::Stage;
use crate::{Frame, FrameStats, OnViewDone, RenderError, Target, View, limits};
use wildcity_scene::RenderProfile;

/// A frame that is being drawn.
pub(super) struct Drawing<'a> {
    pub(super) level: Level,
    pub(super) cutoffs: &'a Cutoffs,
    /// Most bytes of the intermediate buffers.
    pub(super) most_bytes: u64,
    pub(super) scratch: &'a mut Scratch,
    pub(super) finished: OnViewDone<'a>,
    pub(super) stats: FrameStats,
}

/// Most bytes that are held while views are drawn with `most_bytes` of intermediate buffers: these,
/// the sums of one view that is drawn in slabs, and each thread's copies of a macro tile.
pub(super) fn most_held_bytes(most_bytes: u64, sums_bytes: u64, threads: usize) -> u64 {
    // A single view may exceed the limit up to the size of its sums, see `Drawing::most_bytes`.
    most_bytes.max(sums_bytes) + sums_bytes + bin::COPIES_BYTES * threads as u64
}

/// Most bytes of the sums of one of some views.
pub(super) fn sums_bytes(views: &[View], profile: &RenderProfile) -> u64 {
    let sums_of_one = |view: &View| {
        let samples = sample_view(view, profile);
        UnfinishedTiles::bytes(samples.as_ref().unwrap_or(view), samples.is_some())
    };
    views.iter().map(sums_of_one).max().unwrap_or(0)
}

/// Whether a target asks for classes.
fn has_semantics(targets: &[Target<'_>]) -> bool {
    targets.iter().any(|target| target.semantics.is_some())
}

/// Runs the stages project and bin for a part of a frame.
pub(super) struct Stages<'a> {
    pub(super) level: Level,
    pub(super) frame: &'a Frame<'a>,
    pub(super) cutoffs: &'a Cutoffs,
    /// Most bytes of their outputs.
    pub(super) most_bytes: u64,
    /// Whether the classes of splats are kept.
    pub(super) classes: bool,
}

impl Stages<'_> {
    /// Projects, and bins if `last` is [`Stage::Bin`]. Each stage overwrites its part of `scratch`,
    /// so the data of an earlier frame, even one that panicked, has no effect.
    pub(super) fn run(
        &self,
        scratch: &mut Scratch,
        jobs: &[Job<'_>],
        slab: Option<&Slab<'_>>,
        last: Stage,
        stats: &mut FrameStats,
    ) -> Result<(), PartError> {
        let Self { level, frame, cutoffs, most_bytes, classes } = *self;
        let Scratch { projected, bins, .. } = scratch;
        // The time of a failed attempt counts, too: the errors are returned after `finish`.
        let mut timer = StageTimer::start();
        // Each splat has one pair at least, nearly always.
        let places = most_bytes / (limits::LEAST_SPLAT_BYTES + u64::from(classes));
        let most_places = usize::try_from(places).unwrap_or(usize::MAX);
        let limits = ProjectLimits { most_places, classes };
        let done = projected.project(level, jobs, cutoffs, slab, limits);
        timer.finish("project", stats);
        done?;
        if last >= Stage::Bin {
            let done = bins.bin(level, projected, frame.views, cutoffs, most_bytes);
            timer.finish("bin", stats);
            done?;
            stats.instances += bins.instances();
        }
        stats.visible_pairs += projected.len() as u64;
        Ok(())
    }
}

impl Drawing<'_> {
    /// Draws a part of the frame.
    pub(super) fn draw(
        &mut self,
        part: FramePart<'_>,
        targets: &mut [Target<'_>],
    ) -> Result<(), RenderError> {
        // An upper bound of the splats is cheap. If it exceeds the limit, stages that would
        // overflow are not even begun.
        let most_bytes = self.most_bytes(&part);
        let most_splats = usize::try_from(most_bytes / limits::SPLAT_BYTES).unwrap_or(usize::MAX);
        if part.max_splats(most_splats) <= most_splats {
            match self.draw_at_once(part, targets, most_bytes) {
                Ok(()) => return Ok(()),
                Err(PartError::Render(error)) => return Err(error),
                // The number of macro tiles that the splats touch is known only after the stages.
                Err(PartError::Overflow) => {}
            }
        }
        if let [view] = part.frame.views {
            return self.draw_slabs(part, view, targets, most_bytes);
        }
        // At most 16 views are halved, so that the recursion is at most four deep.
        let [first, second] = part.halves();
        let (of_first, of_second) = targets.split_at_mut(first.frame.views.len());
        self.draw(first, of_first)?;
        self.draw(second, of_second)
    }

    /// A single view may have as much as its sums would take if it were drawn in slabs.
    fn most_bytes(&self, part: &FramePart<'_>) -> u64 {
        match (part.frame.views, part.shown) {
            // Slabs would need as much for their sums, so that drawing at once may take it, too.
            ([view], [shown]) => {
                self.most_bytes.max(UnfinishedTiles::bytes(view, is_sampled(view, shown)))
            }
            _ => self.most_bytes,
        }
    }

    fn draw_at_once(
        &mut self,
        part: FramePart<'_>,
        targets: &mut [Target<'_>],
        most_bytes: u64,
    ) -> Result<(), PartError> {
        let Self { level, cutoffs, .. } = *self;
        let classes = has_semantics(targets);
        let stages = Stages { level, frame: &part.frame, cutoffs, most_bytes, classes };
        project::with_jobs(&part.frame, part.first_view, |jobs| {
            stages.run(self.scratch, jobs, None, Stage::Bin, &mut self.stats)
        })?;
        self.rasterize(part, targets, None);
        Ok(())
    }

    /// Draws the only view of a part slab by slab.
    fn draw_slabs(
        &mut self,
        part: FramePart<'_>,
        view: &View,
        targets: &mut [Target<'_>],
        most_bytes: u64,
    ) -> Result<(), RenderError> {
        // The sums of all tiles, which go on from one slab to the next.
        let tiles = UnfinishedTiles::new(view);
        project::with_jobs(&part.frame, part.first_view, |jobs| {
            let mut timer = StageTimer::start();
            let clusters =
                DepthClusters::new(jobs.len(), |job| jobs[job].visible_clusters(), self.cutoffs);
            timer.finish("project", &mut self.stats);
            let mut slabs = Slabs::new(&clusters, most_bytes);
            let mut instances = 0;
            // From the nearest slab to the farthest: blending goes from front to back.
            while let Some(cut) = slabs.next() {
                // A slab that cannot be cut any more is one job at one depth.
                let is_whole = cut.halves().is_none();
                let most_bytes = if is_whole { u64::MAX } else { most_bytes };
                let Self { level, cutoffs, .. } = *self;
                let classes = has_semantics(targets);
                let stages = Stages { level, frame: &part.frame, cutoffs, most_bytes, classes };
                let slab = Slab { cut: &cut, clusters: &clusters };
                // Projected again for each slab: only splats within the slab's cut are kept.
                let run = stages.run(self.scratch, jobs, Some(&slab), Stage::Bin, &mut self.stats);
                match run {
                    Err(PartError::Overflow) => {
                        slabs.halve(&cut);
                        continue;
                    }
                    Err(PartError::Render(error)) => return Err(error),
                    Ok(()) => {}
                }
                let Scratch { projected, bins, .. } = &*self.scratch;
                // The limit applies to the frame, however many slabs it takes.
                instances += bins.instances();
                bin::check_instances(instances)?;
                slabs.drew(bins.held_bytes(projected));
                let continued = Continued { tiles: &tiles, is_last: slabs.is_done() };
                self.rasterize(part, targets, Some(continued));
            }
            Ok(())
        })
    }

    fn rasterize(
        &mut self,
        part: FramePart<'_>,
        targets: &mut [Target<'_>],
        continued: Option<Continued<'_>>,
    ) {
        let FramePart { frame, shown, backgrounds, first_view } = part;
        let Scratch { projected, bins, rasterizer, .. } = &mut *self.scratch;
        let cutoffs = self.cutoffs;
        let mut timer = StageTimer::start();
        let views = frame.views;
        let input = rasterize::Input { projected, bins, views, shown, backgrounds, cutoffs };
        let finished =
            |view: usize, target: &Target<'_>| (self.finished)(first_view + view, target);
        let work =
            rasterize::rasterize(self.level, input, continued, rasterizer, targets, &finished);
        // The copies of each thread's macro tile are not counted: they are bounded beforehand.
        let sums_bytes = continued.map_or(0, |slab| slab.tiles.held_bytes());
        let held_bytes = bins.held_bytes(projected) + sums_bytes;
        self.stats.held_bytes = self.stats.held_bytes.max(held_bytes);
        self.stats.evaluations += work.evaluations;
        let stages = [("sort", work.sort_ns), ("rasterize", work.rasterize_ns)];
        timer.finish_both(stages, &mut self.stats);
    }
}

/// The slabs of a view that are still to be drawn.
struct Slabs<'a> {
    clusters: &'a DepthClusters,
    most_bytes: u64,
    /// Halves of slabs that had too many splats, the nearest last.
    halves: Vec<Cut>,
    /// The cut at which the slab after these begins.
    next_key: u32,
    /// Estimated bytes of a Gaussian, and estimated number of Gaussians in the last slab.
    bytes_each: f64,
    gaussians: f64,
}

impl<'a> Slabs<'a> {
    fn new(clusters: &'a DepthClusters, most_bytes: u64) -> Self {
        Self {
            clusters,
            most_bytes,
            halves: Vec::new(),
            next_key: clusters.keys().start,
            bytes_each: limits::SPLAT_BYTES as f64,
            gaussians: 0.0,
        }
    }

    fn is_done(&self) -> bool {
        self.halves.is_empty() && self.next_key >= self.clusters.keys().end
    }

    /// The nearest slab that is not drawn.
    fn next(&mut self) -> Option<Cut> {
        if let Some(cut) = self.halves.pop() {
            return Some(cut);
        }
        if self.is_done() {
            return None;
        }
        // An eighth is reserved for the error of the estimate.
        // The cut is set in numbers of Gaussians; what each takes is known from the last slab.
        let gaussians = 0.875 * self.most_bytes as f64 / self.bytes_each;
        let (cut, estimated) = self.clusters.next(self.next_key, gaussians);
        self.next_key = cut.keys.end;
        self.gaussians = estimated;
        Some(cut)
    }

    /// Records the bytes that the last slab takes.
    fn drew(&mut self, bytes: u64) {
        // A small slab is no basis for the estimate of the next one.
        // Gaussians outside of the image take nothing, and the next slab may have others: with this
        // floor it has at most 16 times as many Gaussians as the first estimate allows.
        if self.halves.is_empty() && self.gaussians >= 4096.0 {
            self.bytes_each =
                (bytes as f64 / self.gaussians).max(limits::SPLAT_BYTES as f64 / 16.0);
        }
    }

    /// Halves the last slab, which had too many splats.
    fn halve(&mut self, cut: &Cut) {
        // The estimate was for the whole slab; its last half is the one that is recorded.
        self.gaussians *= 0.5;
        if let Some([near, far]) = cut.halves() {
            // A stack: the near half is popped first.
            self.halves.extend([far, near]);
        }
    }
}
