//! The work of stage project: which clusters of Gaussians the host does not cull, and which kernel
//! projects each.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::Zeroable;
use glam::Vec3;
use rayon::prelude::*;

use super::layout::{self, ChunkLight, ChunkShadow, ChunkView, ClusterView, Span, VIEW_BITS};
use super::lens::LensIndices;
use super::mirror::{ClusterLocation, Mirror};
use crate::actor_views::ActorViews;
use crate::layout::{ChunkShadow as CpuChunkShadow, ChunkView as CpuChunkView, Frustum};
use crate::unscented::UnscentedView;
use crate::{FIRST_ACTOR_INSTANCE, Frame, TWIN_INSTANCE, View};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::chunk::Cluster;
use wildcity_scene::{Chunk, RenderProfile, SemanticClass};

/// Clusters of a chunk that are tested at a time: a few microseconds. Chunks have 1 to 50,000
/// clusters, so one that is tested as a whole would keep a single thread busy.
const CLUSTERS_AT_A_TIME: usize = 512;

/// The clusters that a region projects.
#[derive(Debug, Default)]
pub(super) struct ProjectWork {
    pub(super) cluster_views: Vec<ClusterView>,
    /// Indices into `cluster_views`, page after page of the mirror, since one page is bound at a
    /// time.
    pub(super) page_cluster_views: Vec<u32>,
    pub(super) dispatches: Vec<ProjectDispatch>,
    pub(super) chunk_views: Vec<ChunkView>,
    /// For each chunk view the number of its chunk: those of the twin, then those of actors.
    pub(super) chunk_numbers: Vec<u32>,
    /// For each chunk view the instance, and in the high half the class of Gaussians without one.
    pub(super) chunk_owners: Vec<u32>,
    /// One per chunk view if the frame has actors; empty otherwise.
    pub(super) lights: Vec<ChunkLight>,
    pub(super) shadows: Vec<ChunkShadow>,
    /// The owners (twin or actor) of the cluster views, as ranges in order of cluster views.
    owners: Vec<layout::Owner>,
}

/// The cluster views of one page that one kernel projects.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProjectDispatch {
    /// Page of the mirror.
    pub(super) page: usize,
    pub(super) variant: Variant,
    /// Range of [`ProjectWork::page_cluster_views`] that it projects.
    pub(super) span: Span,
}

/// The kernels that project a chunk in a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Variant {
    pub(super) projection: Projection,
    /// Whether it is an actor's chunk, or one with an actor above it.
    pub(super) actors: bool,
    pub(super) sh_degree: u8,
}

/// How a view projects Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Projection {
    /// A static pinhole camera: linearised at the centre.
    Pinhole,
    /// A lens or a rolling shutter: the unscented transform.
    Unscented,
}

/// A chunk in one view.
#[derive(Clone, Copy, Debug)]
struct ChunkInView<'a> {
    chunk: &'a Arc<Chunk>,
    /// Its number: those of the twin, then those of actors.
    number: u32,
    /// Index of the view.
    view: usize,
    /// The view in the chunk's axes: the world's, or those of an actor.
    relative: &'a View,
    of: Owner<'a>,
}

/// The owner of a chunk's Gaussians.
#[derive(Clone, Copy, Debug)]
enum Owner<'a> {
    /// The twin, with the contact shadows that may fall on the chunk.
    Twin { shadows: &'a [CpuChunkShadow] },
    /// An actor, with the index of the lens that sees it.
    Actor { placed: &'a PlacedChunk, lens: u32 },
}

/// A cluster in the mirror.
#[derive(Clone, Copy, Debug)]
struct ClusterPlace {
    page: usize,
    /// First line on the page.
    line: u32,
    /// Whether a contact shadow may fall on it.
    shadowed: bool,
}

impl ProjectWork {
    /// Tests every cluster of the scene against some views, and keeps those that may be visible.
    pub(super) fn new(
        frame: &Frame<'_>,
        views: Range<usize>,
        actors: &ActorViews,
        mirror: &Mirror,
    ) -> Self {
        // All chunks in each view, in order of global ids.
        let lenses = LensIndices::new(frame, actors);
        let shadows = CpuChunkShadow::by_chunk(frame.scene);
        let in_view = |view: usize| {
            let shadows = &shadows;
            let chunks = frame.scene.chunks.iter().enumerate();
            let drawn = chunks.filter(move |(index, _)| frame.scene.draws(*index, view));
            let twin = drawn.map(move |(index, chunk)| {
                let shadows = shadows.get(index).map_or(&[][..], Vec::as_slice);
                let relative = &frame.views[view];
                let number = index as u32;
                ChunkInView { chunk, number, view, relative, of: Owner::Twin { shadows } }
            });
            let lenses = &lenses;
            let actors = frame.scene.placed.iter().zip(actors.for_view(view)).enumerate();
            let drawn = actors.filter(move |(_, (placed, _))| placed.views.contains(view));
            let placed = drawn.map(move |(index, (placed, relative))| {
                let of = Owner::Actor { placed, lens: lenses.index(view, index) };
                let number = (frame.scene.chunks.len() + index) as u32;
                ChunkInView { chunk: &placed.chunk, number, view, relative, of }
            });
            twin.chain(placed)
        };
        let pairs: Vec<ChunkInView<'_>> = views.flat_map(in_view).collect();

        // The visible clusters of each.
        let unscented: Vec<Option<UnscentedView<'_>>> =
            frame.views.iter().map(|view| UnscentedView::new(view, frame.profile)).collect();
        let parts: Vec<(usize, Range<usize>)> = pairs.iter().enumerate().flat_map(parts).collect();
        let visible: Vec<Vec<ClusterPlace>> = parts
            .par_iter()
            .with_max_len(1)
            .map(|(pair, clusters)| {
                let pair = &pairs[*pair];
                pair.visible(clusters.clone(), frame, unscented[pair.view].as_ref(), mirror)
            })
            .collect();

        // Chunk views, and the cluster views of each page by kernel.
        let mut work = Self::default();
        // Ordered, so that the dispatches are the same in every run.
        let mut by_kernel: BTreeMap<(usize, Variant), Vec<u32>> = BTreeMap::new();
        let mut last = None;
        let mut chunk_views = [None; 2];
        for ((pair, _), clusters) in parts.iter().zip(&visible) {
            // The parts of a pair follow each other and share its chunk views.
            if last != Some(*pair) {
                last = Some(*pair);
                chunk_views = [None; 2];
            }
            work.add(&pairs[*pair], clusters, frame, &mut chunk_views, &mut by_kernel);
        }

        // One dispatch per page and kernel.
        for ((page, variant), cluster_views) in by_kernel {
            let first = work.page_cluster_views.len() as u32;
            let span = Span { first, count: cluster_views.len() as u32 };
            work.dispatches.push(ProjectDispatch { page, variant, span });
            work.page_cluster_views.extend(cluster_views);
        }
        work
    }

    /// Adds some visible clusters of a chunk in a view. `chunk_views` are those of the pair without
    /// and with shadows.
    fn add(
        &mut self,
        pair: &ChunkInView<'_>,
        clusters: &[ClusterPlace],
        frame: &Frame<'_>,
        chunk_views: &mut [Option<u32>; 2],
        by_kernel: &mut BTreeMap<(usize, Variant), Vec<u32>>,
    ) {
        // Neighbouring clusters have the same kernel, mostly: it is looked up once for them.
        let runs = clusters.chunk_by(|a, b| (a.page, a.shadowed) == (b.page, b.shadowed));
        for run in runs {
            let ClusterPlace { page, shadowed, .. } = run[0];
            // The first visible cluster of the pair: owners are ranges of cluster views.
            if *chunk_views == [None; 2] {
                self.add_owner(pair);
            }
            let variant = pair.variant(shadowed);
            let chunk_view = *chunk_views[usize::from(shadowed)].get_or_insert_with(|| {
                self.chunk_views.push(pair.chunk_view(variant, frame.profile));
                self.chunk_numbers.push(pair.number);
                self.chunk_owners.push(pair.owner());
                if !frame.scene.placed.is_empty() {
                    self.add_light(pair, shadowed);
                }
                self.chunk_views.len() as u32 - 1
            });
            let first = self.cluster_views.len() as u32;
            let views = run.iter().map(|place| ClusterView { line: place.line, chunk_view });
            self.cluster_views.extend(views);
            let kernel = by_kernel.entry((page, variant)).or_default();
            kernel.extend(first..first + run.len() as u32);
        }
    }

    /// Number of (cluster, view) pairs.
    pub(super) fn cluster_views(&self) -> u32 {
        self.cluster_views.len() as u32
    }

    /// The cluster views of a dispatch.
    pub(super) fn cluster_views_in(&self, span: Span) -> &[u32] {
        &self.page_cluster_views[span.first as usize..][..span.count as usize]
    }

    /// The index of the view of a cluster view.
    pub(super) fn view(&self, cluster_view: u32) -> usize {
        let chunk_view = self.cluster_views[cluster_view as usize].chunk_view;
        // There are at most 16 views, so that the low bits are the view in all kernels.
        let view = self.chunk_views[chunk_view as usize].view;
        (view & ((1 << VIEW_BITS) - 1)) as usize
    }

    /// The owners (twin or actor) of the cluster views, as ranges in order of cluster views.
    pub(super) fn owners(&self) -> &[layout::Owner] {
        &self.owners
    }

    /// Adds the owner of the next cluster view if it differs from that of the last one.
    fn add_owner(&mut self, pair: &ChunkInView<'_>) {
        let instance = pair.owner() & 0xFFFF;
        let cluster_view = self.cluster_views.len() as u32;
        if self.owners.last().is_none_or(|last| last.instance != instance) {
            self.owners.push(layout::Owner { cluster_view, instance });
        }
    }

    /// Adds the light of the last chunk view.
    fn add_light(&mut self, pair: &ChunkInView<'_>, shadowed: bool) {
        let first_shadow = self.shadows.len() as u32;
        let mut tint = [1.0; 3];
        match pair.of {
            Owner::Actor { placed, .. } => tint = placed.tint,
            Owner::Twin { shadows } if shadowed => {
                let shown = shadows.iter().filter(|shadow| shadow.views.contains(pair.view));
                self.shadows.extend(shown.map(ChunkShadow::new));
            }
            Owner::Twin { .. } => {}
        }
        let shadows = self.shadows.len() as u32 - first_shadow;
        self.lights.push(ChunkLight { tint, first_shadow, shadows, ..ChunkLight::zeroed() });
    }
}

impl ChunkInView<'_> {
    /// The instance, and in the high half the class of Gaussians that have none.
    fn owner(&self) -> u32 {
        let (instance, class) = match self.of {
            Owner::Twin { .. } => (TWIN_INSTANCE, SemanticClass::Unlabelled),
            Owner::Actor { placed, .. } => (FIRST_ACTOR_INSTANCE + placed.actor, placed.class),
        };
        layout::packed_owner(instance, class)
    }

    /// Those of some clusters that may be visible, in order. `unscented` is that of the frame's
    /// view.
    fn visible(
        &self,
        clusters: Range<usize>,
        frame: &Frame<'_>,
        unscented: Option<&UnscentedView<'_>>,
        mirror: &Mirror,
    ) -> Vec<ClusterPlace> {
        let Self { chunk, relative, of, .. } = *self;
        if relative.is_static_pinhole() {
            let frustum = Frustum::new(relative, chunk, frame.profile);
            return self.visible_if(clusters, mirror, |min_m, max_m, sigma_m| {
                frustum.may_see(min_m, max_m, sigma_m)
            });
        }
        let moved = match (of, unscented) {
            (Owner::Twin { .. }, unscented) => unscented.copied(),
            (Owner::Actor { .. }, Some(unscented)) => Some(unscented.moved(relative)),
            (Owner::Actor { .. }, None) => UnscentedView::new(relative, frame.profile),
        };
        self.visible_if(clusters, mirror, |min_m, max_m, sigma_m| {
            // Where there is no test for a view, the device tests each Gaussian.
            moved.is_none_or(|view| view.may_see(chunk.origin_m(), min_m, max_m, sigma_m))
        })
    }

    /// Those of some clusters of which `may_see` is true; its arguments are the smallest and
    /// largest centre, and the largest standard deviation, in metres.
    fn visible_if(
        &self,
        clusters: Range<usize>,
        mirror: &Mirror,
        may_see: impl Fn(Vec3, Vec3, f32) -> bool,
    ) -> Vec<ClusterPlace> {
        let shadows = match self.of {
            Owner::Twin { shadows } => shadows,
            Owner::Actor { .. } => &[],
        };
        // A chunk that is not resident has no places.
        let places = mirror.places(self.chunk).get(clusters.clone()).unwrap_or_default();
        let own = places.iter().zip(self.chunk.clusters().iter().skip(clusters.start));
        let visible = own.filter(|(_, cluster)| {
            let Cluster { min_m, max_m, sigma_m, .. } = **cluster;
            may_see(min_m, max_m, sigma_m)
        });
        let place = |(place, cluster): (&ClusterLocation, &Cluster)| {
            let shadowed = shadows.iter().any(|shadow| shadow.falls_on(cluster, self.view));
            ClusterPlace { page: place.page, line: place.lines.start, shadowed }
        };
        visible.map(place).collect()
    }

    fn variant(&self, shadowed: bool) -> Variant {
        let projection = if self.relative.is_static_pinhole() {
            Projection::Pinhole
        } else {
            Projection::Unscented
        };
        let actors = shadowed || matches!(self.of, Owner::Actor { .. });
        Variant { projection, actors, sh_degree: self.chunk.sh_degree() }
    }

    /// The view relative to the chunk.
    fn chunk_view(&self, variant: Variant, profile: &RenderProfile) -> ChunkView {
        let Self { chunk, relative, .. } = *self;
        let number = self.view as u32;
        let view = match self.of {
            _ if !variant.actors => number,
            // The twin is seen with the lens of the view, which has the same index.
            Owner::Twin { .. } => number | number << VIEW_BITS,
            Owner::Actor { lens, .. } => number | lens << VIEW_BITS,
        };
        let chunk_view = ChunkView::new(view, &CpuChunkView::new(relative, chunk, profile));
        if !relative.camera.depth_is_distance() {
            return chunk_view;
        }
        let position_m = relative.world_from_camera.position_m;
        chunk_view.with_distance_from(position_m - chunk.origin_m())
    }
}

/// The parts of a pair's clusters that are tested at a time, with the pair's index.
fn parts((index, pair): (usize, &ChunkInView<'_>)) -> impl Iterator<Item = (usize, Range<usize>)> {
    let count = pair.chunk.clusters().len();
    let starts = (0..count).step_by(CLUSTERS_AT_A_TIME);
    starts.map(move |start| (index, start..count.min(start + CLUSTERS_AT_A_TIME)))
}
