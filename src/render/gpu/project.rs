//! Stage project: the host culls clusters of Gaussians, and the device projects those that are left, in
//! order of (view, global id). Twin of `render/cpu/project`; WGSL: `shaders/project.wgsl`.
//!
//! Splats stay where they were projected, in order of (view, global id). Sorting and binning move
//! indices of splats: 8 B each in the sort of splats, 4 B each in the lists of tiles. A copy of the splats
//! in depth order was no faster to read, and doubled the memory of a frame.
//!
//! Depth is computed in f32 together with its rounding errors, and rounded once (`exact_z` in
//! `shaders/project.wgsl`). Thousands of surfels of one facade have equal depths; without compensation
//! they would be blended in the order of rounding errors. Distance, the depth of wide lenses, is computed
//! in the same way (`depth` in `shaders/unscented.wgsl`).
//!
//! Static pinhole cameras have their own kernels, which are identical to those of frames without other cameras.
//! The kernels for lenses and rolling shutters are compiled with the first view that needs them.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::Zeroable;
use glam::Vec3;
use rayon::prelude::*;
use wgpu::{BindingResource, BufferUsages, ComputePass, ShaderModule};

use super::device::Device;
use super::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use super::kernel::{Groups, Kernel, LazyShader, slot_binding, span_slots};
use super::layout::{
    ChunkLight, ChunkShadow, ChunkView, ClusterView, Span, SplatColor, SplatShape, VIEW_BITS,
};
use super::lens::{LensIndices, Lenses};
use super::mirror::{ClusterLocation, Mirror};
use super::plan::{Plan, job};
use super::scan::Scan;
use crate::actor_views::ActorViews;
use crate::layout::{ChunkShadow as CpuChunkShadow, ChunkView as CpuChunkView, Frustum};
use crate::unscented::UnscentedView;
use crate::{FIRST_ACTOR_INSTANCE, Frame, TWIN_INSTANCE, View};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::chunk::Cluster;
use wildcity_scene::{Chunk, RenderProfile};

/// The clusters that a region projects.
#[derive(Debug, Default)]
pub(super) struct ProjectWork {
    cluster_views: Vec<ClusterView>,
    /// Indices into `cluster_views`, page after page of the mirror, since one page is bound at a time.
    page_cluster_views: Vec<u32>,
    dispatches: Vec<ProjectDispatch>,
    chunk_views: Vec<ChunkView>,
    /// One per chunk view if the frame has actors; empty otherwise.
    lights: Vec<ChunkLight>,
    shadows: Vec<ChunkShadow>,
    /// The owners (twin or actor) of the cluster views, as ranges in order of cluster views.
    owners: Vec<super::layout::Owner>,
}

/// The cluster views of one page that one kernel projects.
#[derive(Clone, Copy, Debug)]
struct ProjectDispatch {
    /// Page of the mirror.
    page: usize,
    variant: Variant,
    /// Range of `page_cluster_views`.
    span: Span,
}

/// The kernels that project a chunk in a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Variant {
    projection: Projection,
    /// Whether it is an actor's chunk, or one with an actor above it.
    actors: bool,
    sh_degree: u8,
}

/// How a view projects Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Projection {
    /// A static pinhole camera: linearised at the centre.
    Pinhole,
    /// A lens or a rolling shutter: the unscented transform.
    Unscented,
}

/// A chunk in one view.
#[derive(Clone, Copy, Debug)]
struct ChunkInView<'a> {
    chunk: &'a Arc<Chunk>,
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
            let twin = frame.scene.chunks.iter().enumerate().map(move |(index, chunk)| {
                let shadows = shadows.get(index).map_or(&[][..], Vec::as_slice);
                let relative = &frame.views[view];
                ChunkInView { chunk, view, relative, of: Owner::Twin { shadows } }
            });
            let lenses = &lenses;
            let placed = frame.scene.placed.iter().zip(actors.for_view(view)).enumerate();
            let placed = placed.map(move |(index, (placed, relative))| {
                let of = Owner::Actor { placed, lens: lenses.of(view, index) };
                ChunkInView { chunk: &placed.chunk, view, relative, of }
            });
            twin.chain(placed)
        };
        let pairs: Vec<ChunkInView<'_>> = views.flat_map(in_view).collect();

        // The visible clusters of each.
        let unscented: Vec<Option<UnscentedView<'_>>> =
            frame.views.iter().map(|view| UnscentedView::new(view, frame.profile)).collect();
        let visible: Vec<Vec<ClusterPlace>> = pairs
            .par_iter()
            .map(|pair| pair.visible(frame, unscented[pair.view].as_ref(), mirror))
            .collect();

        // Chunk views, and the cluster views of each page by kernel.
        let mut work = Self::default();
        let has_actors = !frame.scene.placed.is_empty();
        let mut by_kernel: BTreeMap<(usize, Variant), Vec<u32>> = BTreeMap::new();
        for (pair, clusters) in pairs.into_iter().zip(visible) {
            let mut chunk_views = [None; 2];
            if !clusters.is_empty() {
                work.add_owner(&pair);
            }
            for ClusterPlace { page, line, shadowed } in clusters {
                let variant = pair.variant(shadowed);
                let chunk_view = *chunk_views[usize::from(shadowed)].get_or_insert_with(|| {
                    work.chunk_views.push(pair.chunk_view(variant, frame.profile));
                    if has_actors {
                        work.add_light(&pair, shadowed);
                    }
                    work.chunk_views.len() as u32 - 1
                });
                let cluster_view = work.cluster_views.len() as u32;
                by_kernel.entry((page, variant)).or_default().push(cluster_view);
                work.cluster_views.push(ClusterView { line, chunk_view });
            }
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

    /// Number of (cluster, view) pairs.
    pub(super) fn cluster_views(&self) -> u32 {
        self.cluster_views.len() as u32
    }

    /// The owners (twin or actor) of the cluster views, as ranges in order of cluster views.
    pub(super) fn owners(&self) -> &[super::layout::Owner] {
        &self.owners
    }

    /// Adds the owner of the next cluster view if it differs from that of the last one.
    fn add_owner(&mut self, pair: &ChunkInView<'_>) {
        let instance = match pair.of {
            Owner::Twin { .. } => TWIN_INSTANCE.into(),
            Owner::Actor { placed, .. } => (FIRST_ACTOR_INSTANCE + placed.actor).into(),
        };
        let cluster_view = self.cluster_views.len() as u32;
        if self.owners.last().is_none_or(|last| last.instance != instance) {
            self.owners.push(super::layout::Owner { cluster_view, instance });
        }
    }

    /// Adds the light of the last chunk view.
    fn add_light(&mut self, pair: &ChunkInView<'_>, shadowed: bool) {
        let first_shadow = self.shadows.len() as u32;
        let mut tint = [1.0; 3];
        match pair.of {
            Owner::Actor { placed, .. } => tint = placed.tint,
            Owner::Twin { shadows } if shadowed => {
                self.shadows.extend(shadows.iter().map(ChunkShadow::new));
            }
            Owner::Twin { .. } => {}
        }
        let shadows = self.shadows.len() as u32 - first_shadow;
        self.lights.push(ChunkLight { tint, first_shadow, shadows, ..ChunkLight::zeroed() });
    }
}

impl ChunkInView<'_> {
    /// The clusters that may be visible, in order. `unscented` is that of the frame's view.
    fn visible(
        &self,
        frame: &Frame<'_>,
        unscented: Option<&UnscentedView<'_>>,
        mirror: &Mirror,
    ) -> Vec<ClusterPlace> {
        let Self { chunk, relative, of, .. } = *self;
        if relative.is_static_pinhole() {
            let frustum = Frustum::new(relative, chunk, frame.profile);
            return self.visible_if(mirror, |min_m, max_m, sigma_m| {
                frustum.may_see(min_m, max_m, sigma_m)
            });
        }
        let moved = match (of, unscented) {
            (Owner::Twin { .. }, unscented) => unscented.copied(),
            (Owner::Actor { .. }, Some(unscented)) => Some(unscented.moved(relative)),
            (Owner::Actor { .. }, None) => UnscentedView::new(relative, frame.profile),
        };
        self.visible_if(mirror, |min_m, max_m, sigma_m| {
            moved.is_none_or(|view| view.may_see(chunk.origin_m(), min_m, max_m, sigma_m))
        })
    }

    /// The clusters of which `may_see` is true; its arguments are the smallest and largest centre, and the largest
    /// standard deviation, in metres.
    fn visible_if(
        &self,
        mirror: &Mirror,
        may_see: impl Fn(Vec3, Vec3, f32) -> bool,
    ) -> Vec<ClusterPlace> {
        let shadows = match self.of {
            Owner::Twin { shadows } => shadows,
            Owner::Actor { .. } => &[],
        };
        let places = mirror.places(self.chunk).iter().zip(self.chunk.clusters());
        let visible = places.filter(|(_, cluster)| {
            let Cluster { min_m, max_m, sigma_m, .. } = **cluster;
            may_see(min_m, max_m, sigma_m)
        });
        let place = |(place, cluster): (&ClusterLocation, &Cluster)| {
            let touches = |s: &CpuChunkShadow| s.may_touch(cluster.min_m, cluster.max_m);
            let shadowed = shadows.iter().any(touches);
            ClusterPlace { page: place.page, line: place.lines.start, shadowed }
        };
        visible.map(place).collect()
    }

    fn variant(&self, shadowed: bool) -> Variant {
        let projection = match self.relative.is_static_pinhole() {
            true => Projection::Pinhole,
            false => Projection::Unscented,
        };
        let actors = shadowed || matches!(self.of, Owner::Actor { .. });
        Variant { projection, actors, sh_degree: self.chunk.sh_degree() }
    }

    /// The view relative to the chunk.
    fn chunk_view(&self, variant: Variant, profile: &RenderProfile) -> ChunkView {
        let Self { chunk, relative, .. } = *self;
        let view = self.view as u32;
        let view = match self.of {
            _ if !variant.actors => view,
            Owner::Twin { .. } => view | view << VIEW_BITS,
            Owner::Actor { lens, .. } => view | lens << VIEW_BITS,
        };
        let chunk_view = ChunkView::new(view, &CpuChunkView::new(relative, chunk, profile));
        if !relative.camera.depth_is_distance() {
            return chunk_view;
        }
        let position_m = relative.world_from_camera.position_m;
        chunk_view.with_distance_from(position_m - chunk.origin_m())
    }
}

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
    /// By SH degree.
    pinhole: LazyShader<Kernels, 4>,
    /// By SH degree.
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
            visible: buffer("visible", storage),
            offsets: buffer("cluster view offsets", storage),
        }
    }

    /// Most cluster views that a device can hold. Each takes 32 B of visibility bits and, if every one
    /// is of a chunk of its own, 128 B of that chunk's [`ChunkView`], which decides.
    pub(super) fn limit(device: &Device) -> u64 {
        device.binding_bytes() / size_of::<ChunkView>() as u64
    }

    /// Uploads the work of a region.
    pub(super) fn upload(&mut self, device: &Device, work: &ProjectWork) {
        let spans = span_slots(work.dispatches.iter().map(|dispatch| dispatch.span));
        self.cluster_views.fill(device, bytemuck::cast_slice(&work.cluster_views));
        self.page_cluster_views.fill(device, bytemuck::cast_slice(&work.page_cluster_views));
        self.chunk_views.fill(device, bytemuck::cast_slice(&work.chunk_views));
        self.spans.fill(device, &spans);
        if !work.lights.is_empty() {
            let Lights { lights, shadows } = self.lights.get_or_insert_with(|| Lights::new(device));
            lights.fill(device, bytemuck::cast_slice(&work.lights));
            shadows.fill(device, bytemuck::cast_slice(&work.shadows));
        }
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
            let mut resources = vec![
                (0, plan.frame().as_entire_binding()),
                (1, slot_binding(self.spans.buffer(), index as u64, size_of::<Span>())),
                (2, self.page_cluster_views.bind()),
                (3, self.cluster_views.bind()),
                (4, self.chunk_views.bind()),
                (5, page.as_entire_binding()),
                (6, self.visible.bind()),
                (7, self.offsets.bind()),
            ];
            if variant.projection == Projection::Unscented {
                resources.extend(lenses.bind());
            }
            dispatches.push((kernels, variant, Groups::Count(span.count), resources));
        }

        // Cull, give each cluster view the index of its first splat, and project.
        for (kernels, _, groups, resources) in &dispatches {
            kernels.cull.run(device, pass, *groups, resources);
        }
        scan.run(device, pass, plan.job(job::CLUSTER_VIEWS), self.offsets.buffer());
        plan.set_splats(device, pass, scan.block_sums());
        for (kernels, variant, groups, mut resources) in dispatches {
            if variant.actors {
                resources.extend(self.lights.iter().flat_map(Lights::bind));
            }
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

impl Variant {
    fn degree(self) -> usize {
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
