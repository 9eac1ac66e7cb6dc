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

use std::ops::Range;
use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;
use wgpu::{BufferUsages, ComputePass, ShaderModule};

use super::device::Device;
use super::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use super::kernel::{Groups, Kernel, LazyShader, slot_binding, span_slots};
use super::layout::{ChunkView, ClusterView, Span, SplatColor, SplatShape};
use super::lens::Lenses;
use super::mirror::Mirror;
use super::plan::{Plan, job};
use super::scan::Scan;
use crate::layout::{ChunkView as CpuChunkView, Frustum};
use crate::unscented::UnscentedView;
use crate::{Frame, View};
use wildcity_scene::Chunk;
use wildcity_scene::chunk::Cluster;

/// The clusters that a region projects.
#[derive(Debug, Default)]
pub(super) struct ProjectWork {
    sh_degree: u8,
    cluster_views: Vec<ClusterView>,
    /// Indices into `cluster_views`, page after page of the mirror, since one page is bound at a time.
    page_cluster_views: Vec<u32>,
    dispatches: Vec<ProjectDispatch>,
    chunk_views: Vec<ChunkView>,
}

/// The cluster views of one page that one kernel projects.
#[derive(Clone, Copy, Debug)]
struct ProjectDispatch {
    /// Page of the mirror.
    page: usize,
    projection: Projection,
    /// Range of `page_cluster_views`.
    span: Span,
}

/// How a view projects Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Projection {
    /// A static pinhole camera: linearised at the centre.
    Pinhole,
    /// A lens or a rolling shutter: the unscented transform.
    Unscented,
}

/// A cluster in the mirror.
#[derive(Clone, Copy, Debug)]
struct ClusterPlace {
    page: usize,
    /// First line on the page.
    line: u32,
}

impl ProjectWork {
    /// Tests every cluster of the scene against some views, and keeps those that may be visible.
    pub(super) fn new(frame: &Frame<'_>, views: Range<usize>, mirror: &Mirror) -> Self {
        let pairs: Vec<(usize, &Arc<Chunk>)> = views
            .flat_map(|view| frame.scene.chunks.iter().map(move |chunk| (view, chunk)))
            .collect();
        let unscented: Vec<Option<UnscentedView<'_>>> =
            frame.views.iter().map(|view| UnscentedView::new(view, frame.profile)).collect();
        let visible: Vec<Vec<ClusterPlace>> = pairs
            .par_iter()
            .map(|&(view, chunk)| match &unscented[view] {
                Some(unscented) => visible_unscented(unscented, chunk, mirror),
                None => visible_pinhole(frame, view, chunk, mirror),
            })
            .collect();

        // One chunk view per visible (chunk, view) pair, and the cluster views of each page by projection.
        let mut work = Self { sh_degree: frame.scene.sh_degree(), ..Self::default() };
        let mut pages = vec![[Vec::new(), Vec::new()]; mirror.pages()];
        for ((view, chunk), clusters) in pairs.into_iter().zip(visible) {
            if clusters.is_empty() {
                continue;
            }
            let chunk_view = work.chunk_views.len() as u32;
            let View { camera, world_from_camera, .. } = &frame.views[view];
            let relative = CpuChunkView::new(&frame.views[view], chunk, frame.profile);
            let relative = ChunkView::new(view as u32, &relative);
            work.chunk_views.push(match camera.depth_is_distance() {
                false => relative,
                true => {
                    relative.with_distance_from(world_from_camera.position_m - chunk.origin_m())
                }
            });
            let projection = usize::from(unscented[view].is_some());
            for ClusterPlace { page, line } in clusters {
                pages[page][projection].push(work.cluster_views.len() as u32);
                work.cluster_views.push(ClusterView { line, chunk_view });
            }
        }

        // One dispatch per page and projection.
        for (page, by_projection) in pages.into_iter().enumerate() {
            let projections = [Projection::Pinhole, Projection::Unscented];
            for (cluster_views, projection) in by_projection.into_iter().zip(projections) {
                if !cluster_views.is_empty() {
                    let first = work.page_cluster_views.len() as u32;
                    let span = Span { first, count: cluster_views.len() as u32 };
                    work.dispatches.push(ProjectDispatch { page, projection, span });
                    work.page_cluster_views.extend(cluster_views);
                }
            }
        }
        work
    }

    /// Number of (cluster, view) pairs.
    pub(super) fn cluster_views(&self) -> u32 {
        self.cluster_views.len() as u32
    }
}

/// The clusters of a chunk that a static pinhole camera may see, in order.
fn visible_pinhole(
    frame: &Frame<'_>,
    view: usize,
    chunk: &Arc<Chunk>,
    mirror: &Mirror,
) -> Vec<ClusterPlace> {
    let frustum = Frustum::new(&frame.views[view], chunk, frame.profile);
    visible(chunk, mirror, |min_m, max_m, sigma_m| frustum.may_see(min_m, max_m, sigma_m))
}

/// The clusters of a chunk that a view with a lens or a rolling shutter may see, in order.
fn visible_unscented(
    view: &UnscentedView<'_>,
    chunk: &Arc<Chunk>,
    mirror: &Mirror,
) -> Vec<ClusterPlace> {
    visible(chunk, mirror, |min_m, max_m, sigma_m| {
        view.may_see(chunk.origin_m(), min_m, max_m, sigma_m)
    })
}

/// The clusters of a chunk of which `may_see` is true; its arguments are the smallest and largest centre,
/// and the largest standard deviation, in metres.
fn visible(
    chunk: &Arc<Chunk>,
    mirror: &Mirror,
    may_see: impl Fn(Vec3, Vec3, f32) -> bool,
) -> Vec<ClusterPlace> {
    let places = mirror.places(chunk).iter().zip(chunk.clusters());
    let visible = places.filter(|(_, cluster)| {
        let Cluster { min_m, max_m, sigma_m, .. } = **cluster;
        may_see(min_m, max_m, sigma_m)
    });
    visible.map(|(place, _)| ClusterPlace { page: place.page, line: place.lines.start }).collect()
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
    cluster_views: GrowableBuffer,
    page_cluster_views: GrowableBuffer,
    chunk_views: GrowableBuffer,
    spans: GrowableBuffer,
    /// One bit per Gaussian of each cluster view.
    visible: GrowableBuffer,
    /// For each cluster view, the index of its first splat.
    offsets: GrowableBuffer,
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
        self.visible.reserve(device, 32 * u64::from(work.cluster_views()));
        self.offsets.reserve(device, 4 * u64::from(work.cluster_views()));
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
        let degree = usize::from(work.sh_degree.min(3));
        let needs = |projection| work.dispatches.iter().any(|d| d.projection == projection);
        let compile = |module: &ShaderModule| Kernels::new(device, module, degree);
        let pinhole =
            needs(Projection::Pinhole).then(|| self.pinhole.variant(device, degree, compile));
        let unscented =
            needs(Projection::Unscented).then(|| self.unscented.variant(device, degree, compile));

        // The kernels and the input of each dispatch.
        let mut dispatches = Vec::with_capacity(work.dispatches.len());
        for (index, dispatch) in work.dispatches.iter().enumerate() {
            let ProjectDispatch { page, projection, span } = *dispatch;
            let kernels = match projection {
                Projection::Pinhole => pinhole,
                Projection::Unscented => unscented,
            };
            let Some(kernels) = kernels else { continue };
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
            if projection == Projection::Unscented {
                resources.extend(lenses.bind());
            }
            dispatches.push((kernels, Groups::Count(span.count), resources));
        }

        // Cull, give each cluster view the index of its first splat, and project.
        for (kernels, groups, resources) in &dispatches {
            kernels.cull.run(device, pass, *groups, resources);
        }
        scan.run(device, pass, plan.job(job::CLUSTER_VIEWS), self.offsets.buffer());
        plan.set_splats(device, pass, scan.block_sums());
        for (kernels, groups, mut resources) in dispatches {
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

/// What [`Project::run`] reads, besides the work.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProjectInputs<'a> {
    pub(super) plan: &'a Plan,
    pub(super) scan: &'a Scan,
    pub(super) mirror: &'a Mirror,
    pub(super) lenses: &'a Lenses,
}
