//! The work of stage project: a job for each part of a chunk that a view may see.

use std::ops::Range;

use glam::DVec3;

use super::light::Light;
use super::unscented::UnscentedChunkView;
use crate::actor_views::ActorViews;
use crate::cpu::lens::LensProjection;
use crate::layout::{ChunkShadow, ChunkView, Frustum};
use crate::unscented::UnscentedView;
use crate::{FIRST_ACTOR_INSTANCE, Frame, TWIN_INSTANCE, View};
use wildcity_scene::chunk::Cluster;
use wildcity_scene::{Chunk, SemanticClass};

/// Clusters of a unit: 4,096 Gaussians take about 100 µs, long enough to outweigh scheduling them.
pub(in crate::cpu) const UNIT_CLUSTERS: usize = 16;

/// The work of one thread at a time, whose output is one [`Unit`](super::Unit).
pub(in crate::cpu) struct Job<'a> {
    pub(super) view: usize,
    pub(super) chunk: &'a Chunk,
    /// Number of the chunk: those of the twin, then those of actors.
    pub(in crate::cpu) number: usize,
    pub(in crate::cpu) clusters: Range<usize>,
    pub(super) projection: ChunkProjection<'a>,
    pub(super) light: Light<'a>,
    pub(super) instance: u16,
    pub(super) class: SemanticClass,
}

impl Job<'_> {
    /// The Gaussians that it projects: the address of their chunk, and the first cluster. Only the
    /// schedule depends on it.
    pub(super) fn gaussians(&self) -> (usize, usize) {
        (std::ptr::from_ref(self.chunk).addr(), self.clusters.start)
    }

    /// The clusters that the view may see: the number of each in the chunk, and
    /// bounds of the depths of their centres, in metres.
    pub(in crate::cpu) fn visible_clusters(&self) -> impl Iterator<Item = (usize, [f64; 2])> {
        self.clusters.clone().filter_map(|number| {
            let cluster = &self.chunk.clusters()[number];
            // The test of the projection itself, so that slabs have exactly the clusters
            // that are drawn.
            let is_seen = self.projection.may_see(self.chunk, cluster);
            is_seen.then(|| (number, self.projection.depths_m(cluster)))
        })
    }
}

/// The data that the jobs of one chunk in one view share.
#[derive(Clone, Copy)]
struct JobOwner<'a> {
    view: usize,
    number: usize,
    light: Light<'a>,
    instance: u16,
    class: SemanticClass,
}

/// How one view projects the Gaussians of one chunk.
#[derive(Clone, Copy)]
#[allow(clippy::large_enum_variant, reason = "nearly all are the large one")]
pub(super) enum ChunkProjection<'a> {
    /// A static pinhole camera: linearised at each centre.
    Pinhole { chunk_view: ChunkView, frustum: Frustum },
    /// A lens, a windshield, or a rolling shutter: the unscented transform.
    Unscented(UnscentedChunkView<'a>),
}

/// A view that is not a static pinhole.
struct NonPinholeView<'a> {
    unscented: UnscentedView<'a>,
    /// The lens for 16 points at a time; `None` where only the f64 path describes it.
    lens: Option<LensProjection>,
}

/// Runs `work` with the jobs of a frame, or of the part of one that begins with the view
/// `first_view`: one for each unit that a view may see, in order of (view, global id).
pub(in crate::cpu) fn with_jobs<R>(
    frame: &Frame<'_>,
    first_view: usize,
    work: impl FnOnce(&[Job<'_>]) -> R,
) -> R {
    // Compute the data that is the same for all chunks of a view or of an actor.
    let non_pinhole: Vec<Option<NonPinholeView<'_>>> =
        // Per view and not per chunk: a lens has series to be fitted.
        frame.views.iter().map(|view| NonPinholeView::new(view, frame)).collect();
    let actor_views = ActorViews::new(frame);
    let from_actors = non_pinhole_from_actors(frame, &actor_views, &non_pinhole);
    let shadows = ChunkShadow::by_chunk(frame.scene);
    let mut jobs = Vec::new();
    for (index, non_pinhole) in non_pinhole.iter().enumerate() {
        let views = [index, first_view + index];
        add_twin(views, frame, non_pinhole.as_ref(), &shadows, &mut jobs);
        // Without actors the list of lists is empty.
        let from_actors = from_actors.get(index).map_or(&[][..], Vec::as_slice);
        add_actors(views, frame, actor_views.for_view(index), from_actors, &mut jobs);
    }
    // A closure and not a result: the jobs borrow from the locals above.
    work(&jobs)
}

impl<'a> NonPinholeView<'a> {
    /// `None` for a static pinhole.
    fn new(view: &'a View, frame: &Frame<'_>) -> Option<Self> {
        let unscented = UnscentedView::new(view, frame.profile)?;
        Some(Self { unscented, lens: LensProjection::new(view) })
    }

    /// This camera at another pose or in another motion.
    fn moved<'b>(&self, view: &'b View) -> NonPinholeView<'b> {
        let lens = self.lens.as_ref().and_then(|lens| lens.moved(view));
        NonPinholeView { unscented: self.unscented.moved(view), lens }
    }
}

impl<'a> ChunkProjection<'a> {
    /// How a view projects a chunk. Both are in the same axes: the world's, or those of an actor.
    fn new(
        view: &View,
        chunk: &Chunk,
        non_pinhole: Option<&'a NonPinholeView<'a>>,
        frame: &Frame<'_>,
    ) -> Self {
        match non_pinhole {
            Some(NonPinholeView { unscented, lens }) => Self::Unscented(UnscentedChunkView::new(
                view,
                chunk,
                frame.profile,
                unscented,
                lens.as_ref(),
            )),
            None => Self::Pinhole {
                chunk_view: ChunkView::new(view, chunk, frame.profile),
                frustum: Frustum::new(view, chunk, frame.profile),
            },
        }
    }

    /// Whether a Gaussian of the cluster can touch the image; `true` when in doubt.
    #[inline(always)]
    pub(super) fn may_see(&self, chunk: &Chunk, cluster: &Cluster) -> bool {
        let Cluster { min_m, max_m, sigma_m, .. } = *cluster;
        match self {
            Self::Pinhole { frustum, .. } => frustum.may_see(min_m, max_m, sigma_m),
            Self::Unscented(view) => view.may_see(chunk.origin_m(), min_m, max_m, sigma_m),
        }
    }

    /// Bounds of the depths of all centres in a cluster, in metres. They allow for rounding errors
    /// of 1e-5.
    fn depths_m(&self, cluster: &Cluster) -> [f64; 2] {
        let Cluster { min_m, max_m, .. } = *cluster;
        // Interval arithmetic: the middle of the box, and the most that depth varies within it.
        let center_m = (0.5 * (min_m + max_m)).as_dvec3();
        let half_m = (0.5 * (max_m - min_m)).as_dvec3();
        let [depth_m, reach_m] = match self {
            Self::Pinhole {
                chunk_view: ChunkView { forward: [x, y, z, offset_m], .. }, ..
            } => {
                let forward = DVec3::new(*x, *y, *z);
                [forward.dot(center_m) + offset_m, forward.abs().dot(half_m)]
            }
            Self::Unscented(view) => view.depth_m(center_m, half_m.length()),
        };
        // Ten times the rounding of f32 (6e-8 per operation) in the terms' size; 1 um for
        // terms of 0.
        let slack_m = 1e-5 * (depth_m.abs() + reach_m + center_m.length()) + 1e-6;
        [depth_m - reach_m - slack_m, depth_m + reach_m + slack_m]
    }
}

/// The views from actors' axes that are not static pinholes. Data that depends on the lens is taken
/// from `own`, the frame's own views.
fn non_pinhole_from_actors<'a>(
    frame: &Frame<'_>,
    actor_views: &'a ActorViews,
    own: &[Option<NonPinholeView<'_>>],
) -> Vec<Vec<Option<NonPinholeView<'a>>>> {
    let of_view = |(relative, own): (&'a [View], &Option<NonPinholeView<'_>>)| {
        // A static pinhole has no lens yet, and sees actors in motion through its rolling shutter.
        let mut first: Option<NonPinholeView<'a>> = None;
        let mut views = Vec::with_capacity(relative.len());
        for view in relative {
            views.push(match (own, &first) {
                _ if view.is_static_pinhole() => None,
                (Some(own), _) => Some(own.moved(view)),
                (None, Some(first)) => Some(first.moved(view)),
                (None, None) => {
                    first = NonPinholeView::new(view, frame);
                    // The same as `first` itself, which has to stay for the views that follow.
                    first.as_ref().map(|first| first.moved(view))
                }
            });
        }
        views
    };
    actor_views.all().zip(own).map(of_view).collect()
}

/// Adds the jobs of one view and the twin, in order of global ids. A unit that a view cannot see
/// has no job; it costs one visibility test per cluster. The view is given by its index in the part
/// and in the whole frame, by which the scene names its views.
fn add_twin<'a>(
    [index, view]: [usize; 2],
    frame: &Frame<'a>,
    non_pinhole: Option<&'a NonPinholeView<'a>>,
    shadows: &'a [Vec<ChunkShadow>],
    jobs: &mut Vec<Job<'a>>,
) {
    let chunks = frame.scene.chunks.iter().enumerate();
    for (number, chunk) in chunks.filter(|(number, _)| frame.scene.draws(*number, view)) {
        let projection = ChunkProjection::new(&frame.views[index], chunk, non_pinhole, frame);
        let light = match shadows.get(number).map_or(&[][..], Vec::as_slice) {
            [] => Light::AsStored,
            shadows => Light::Shadowed { shadows, view },
        };
        let owner = JobOwner {
            view: index,
            number,
            light,
            instance: TWIN_INSTANCE,
            class: SemanticClass::Unlabelled,
        };
        add_jobs(owner, projection, chunk, jobs);
    }
}

/// Adds the jobs of one view and all actors, in order of global ids. `relative` are the view from
/// the axes of each actor; the indices are as in [`add_twin`].
fn add_actors<'a>(
    [index, view_of_frame]: [usize; 2],
    frame: &Frame<'a>,
    relative: &[View],
    non_pinhole: &'a [Option<NonPinholeView<'a>>],
    jobs: &mut Vec<Job<'a>>,
) {
    let first = frame.scene.chunks.len();
    let placed = (first..).zip(&frame.scene.placed).zip(relative).zip(non_pinhole);
    let drawn = placed.filter(|(((_, placed), _), _)| placed.views.contains(view_of_frame));
    for (((number, placed), view), non_pinhole) in drawn {
        let projection = ChunkProjection::new(view, &placed.chunk, non_pinhole.as_ref(), frame);
        let light = match placed.tint {
            [1.0, 1.0, 1.0] => Light::AsStored,
            tint => Light::Tinted(tint),
        };
        // Actors are bounded by PlacedChunk::MAX_ACTORS, far below the end of u16.
        let instance = FIRST_ACTOR_INSTANCE + placed.actor;
        let class = placed.class;
        let owner = JobOwner { view: index, number, light, instance, class };
        add_jobs(owner, projection, &placed.chunk, jobs);
    }
}

/// Adds the jobs of one view and one chunk.
fn add_jobs<'a>(
    JobOwner { view, number, light, instance, class }: JobOwner<'a>,
    projection: ChunkProjection<'a>,
    chunk: &'a Chunk,
    jobs: &mut Vec<Job<'a>>,
) {
    let visible = |clusters: &Range<usize>| {
        // `any` ends at the first visible cluster; the others are tested when the unit is
        // projected.
        let mut clusters = chunk.clusters()[clusters.clone()].iter();
        clusters.any(|cluster| projection.may_see(chunk, cluster))
    };
    let count = chunk.clusters().len();
    let ranges = (0..count).step_by(UNIT_CLUSTERS).map(|k| k..(k + UNIT_CLUSTERS).min(count));
    let job = |clusters| Job { view, chunk, number, clusters, projection, light, instance, class };
    jobs.extend(ranges.filter(visible).map(job));
}
