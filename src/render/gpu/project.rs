//! Stage project: the host culls clusters, the device projects the rest, in order of (view, global
//! id). Twin of `render/cpu/project.rs`; WGSL: `shaders/project.wgsl`.

use std::ops::Range;
use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;
use wgpu::{BufferUsages, ComputePass, ShaderModule};

use super::device::Device;
use super::growing::{Growing, HANDED_OVER};
use super::kernel::{Groups, Kernel, SLOT_BYTES, module, slot};
use super::layout::{ChunkView, Item, Span, SplatColor, SplatShape};
use super::lens::Lenses;
use super::mirror::Mirror;
use super::plan::{Plan, job};
use super::scan::Scan;
use super::shaders::Shaders;
use crate::layout::{ChunkView as CpuChunkView, Frustum};
use crate::unscented::UnscentedView;
use crate::{Frame, View};
use wildcity_scene::Chunk;
use wildcity_scene::chunk::Cluster;

/// What a frame projects.
#[derive(Debug, Default)]
pub(super) struct Work {
    sh_degree: u8,
    items: Vec<Item>,
    /// Indices of items, page after page of the mirror, since one page is bound at a time.
    page_items: Vec<u32>,
    /// Each page that is needed, whether what follows is for lenses and rolling shutters, and its part of
    /// `page_items`.
    spans: Vec<(usize, bool, Span)>,
    chunk_views: Vec<ChunkView>,
}

impl Work {
    /// Tests every cluster against some views, and keeps what may be seen.
    pub(super) fn new(frame: &Frame<'_>, views: Range<usize>, mirror: &Mirror) -> Self {
        let pairs: Vec<(usize, &Arc<Chunk>)> = views
            .flat_map(|view| frame.scene.chunks.iter().map(move |chunk| (view, chunk)))
            .collect();
        let bent: Vec<Option<UnscentedView<'_>>> =
            frame.views.iter().map(|view| UnscentedView::new(view, frame.profile)).collect();
        let visible: Vec<Vec<(usize, u32)>> = pairs
            .par_iter()
            .map(|(view, chunk)| visible(frame, (*view, bent[*view].as_ref()), chunk, mirror))
            .collect();
        let mut work = Self { sh_degree: frame.scene.sh_degree(), ..Self::default() };
        // Of each page, those of pinholes at rest and the others: each has a kernel of its own.
        let mut pages = vec![[Vec::new(), Vec::new()]; mirror.pages()];
        for ((view, chunk), clusters) in pairs.into_iter().zip(visible) {
            if clusters.is_empty() {
                continue;
            }
            let chunk_view = work.chunk_views.len() as u32;
            let View { camera, world_from_camera, .. } = &frame.views[view];
            let from = ChunkView::new(view as u32, &CpuChunkView::new(&frame.views[view], chunk));
            work.chunk_views.push(match camera.depth_is_distance() {
                false => from,
                true => from.by_distance(world_from_camera.position_m - chunk.origin_m()),
            });
            let bent = usize::from(!frame.views[view].is_static_pinhole());
            for (page, line) in clusters {
                pages[page][bent].push(work.items.len() as u32);
                work.items.push(Item { line, chunk_view });
            }
        }
        for (page, kinds) in pages.into_iter().enumerate() {
            for (items, bent) in kinds.into_iter().zip([false, true]) {
                if !items.is_empty() {
                    let first = work.page_items.len() as u32;
                    let span = Span { first, count: items.len() as u32 };
                    work.spans.push((page, bent, span));
                    work.page_items.extend(items);
                }
            }
        }
        work
    }

    /// Clusters in views.
    pub(super) fn items(&self) -> u32 {
        self.items.len() as u32
    }
}

/// Page and first line of the clusters that one view may see of a chunk, in order.
fn visible(
    frame: &Frame<'_>,
    (view, bent): (usize, Option<&UnscentedView<'_>>),
    chunk: &Arc<Chunk>,
    mirror: &Mirror,
) -> Vec<(usize, u32)> {
    let of = |may_see: &dyn Fn(Vec3, Vec3, f32) -> bool| {
        let places = mirror.places(chunk).iter().zip(chunk.clusters());
        let seen = places.filter(|(_, cluster)| {
            let Cluster { min_m, max_m, sigma_m, .. } = **cluster;
            may_see(min_m, max_m, sigma_m)
        });
        seen.map(|(place, _)| (place.page, place.lines.start)).collect()
    };
    match bent {
        Some(bent) => {
            of(&|min_m, max_m, sigma_m| bent.may_see(chunk.origin_m(), min_m, max_m, sigma_m))
        }
        None => {
            let frustum = Frustum::new(&frame.views[view], chunk, frame.profile);
            of(&|min_m, max_m, sigma_m| frustum.may_see(min_m, max_m, sigma_m))
        }
    }
}

/// The splats of a frame, and the keys that they are sorted by.
#[derive(Debug)]
pub(super) struct Splats {
    pub(super) shapes: Growing,
    pub(super) colors: Growing,
    /// View and depth, before and after each pass of the sort.
    pub(super) keys: [Growing; 2],
    /// Indices into `shapes` and `colors`.
    pub(super) places: [Growing; 2],
}

impl Splats {
    pub(super) fn new(device: &Device) -> Self {
        let growing = |label| Growing::new(device, label, HANDED_OVER);
        Self {
            shapes: growing("shapes"),
            colors: growing("colors"),
            keys: [growing("depth keys"), growing("depth keys")],
            places: [growing("places"), growing("places")],
        }
    }

    /// Makes room for `count` splats, and tells how many fit then.
    pub(super) fn reserve(&mut self, device: &Device, count: u64) -> u32 {
        self.shapes.reserve(device, count * size_of::<SplatShape>() as u64);
        self.colors.reserve(device, count * size_of::<SplatColor>() as u64);
        for words in self.keys.iter_mut().chain(&mut self.places) {
            words.reserve(device, 4 * count);
        }
        let bytes = [(&self.shapes, size_of::<SplatShape>()), (&self.keys[0], 4)];
        let held = bytes.map(|(growing, each)| growing.buffer().size() / each as u64);
        held[0].min(held[1]).min(Self::limit(device)) as u32
    }

    /// Most splats that a device can hold: the largest array decides.
    pub(super) fn limit(device: &Device) -> u64 {
        device.binding_bytes() / size_of::<SplatShape>() as u64
    }
}

/// The stage on the device.
#[derive(Debug)]
pub(super) struct Project {
    shaders: Shaders,
    straight: Kernels,
    /// For lenses and rolling shutters.
    bent: Kernels,
    items: Growing,
    page_items: Growing,
    chunk_views: Growing,
    spans: Growing,
    visible: Growing,
    offsets: Growing,
}

/// One variant of the stage.
#[derive(Debug)]
struct Kernels {
    variant: &'static str,
    module: Option<ShaderModule>,
    /// By SH degree, compiled when the first scene needs it: cull, project.
    by_degree: [Option<[Kernel; 2]>; 4],
}

impl Kernels {
    /// Compiled when first needed.
    fn new(variant: &'static str) -> Self {
        Self { variant, module: None, by_degree: [const { None }; 4] }
    }

    fn of_degree(&mut self, device: &Device, shaders: &Shaders, degree: u8) -> &[Kernel; 2] {
        let degree = usize::from(degree.min(3));
        let module = self.module.get_or_insert_with(|| module(device, shaders, self.variant));
        self.by_degree[degree].get_or_insert_with(|| {
            let constants = [("SH_DEGREE", degree as f64)];
            ["cull", "project"].map(|entry| Kernel::new(device, module, entry, &constants))
        })
    }
}

impl Project {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        Self {
            shaders: shaders.clone(),
            straight: Kernels {
                module: Some(module(device, shaders, "project")),
                ..Kernels::new("project")
            },
            bent: Kernels::new("project_bent"),
            items: Growing::new(device, "items", storage),
            page_items: Growing::new(device, "page items", storage),
            chunk_views: Growing::new(device, "chunk views", storage),
            spans: Growing::new(device, "project spans", uniform),
            visible: Growing::new(device, "visible", storage),
            offsets: Growing::new(device, "item offsets", storage),
        }
    }

    /// Most items, clusters in views, that a device can hold: 32 bytes of bits each, and if every
    /// one is of a chunk of its own, that chunk's 128 bytes.
    pub(super) fn limit(device: &Device) -> u64 {
        device.binding_bytes() / size_of::<ChunkView>() as u64
    }

    /// Sends a frame's work to the device.
    pub(super) fn upload(&mut self, device: &Device, work: &Work) {
        let spans: Vec<[u32; SLOT_BYTES as usize / 4]> = (work.spans.iter())
            .map(|(_, _, span)| {
                let mut slot = [0; SLOT_BYTES as usize / 4];
                slot[..2].copy_from_slice(&[span.first, span.count]);
                slot
            })
            .collect();
        self.items.fill(device, bytemuck::cast_slice(&work.items));
        self.page_items.fill(device, bytemuck::cast_slice(&work.page_items));
        self.chunk_views.fill(device, bytemuck::cast_slice(&work.chunk_views));
        self.spans.fill(device, bytemuck::cast_slice(&spans));
        self.visible.reserve(device, 32 * u64::from(work.items()));
        self.offsets.reserve(device, 4 * u64::from(work.items()));
    }

    /// Projects what was uploaded.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (work, mirror): (&Work, &Mirror),
        (plan, scan): (&Plan, &Scan),
        (splats, lenses): (&Splats, &Lenses),
    ) {
        let Self { shaders, straight, bent, .. } = self;
        let degree = work.sh_degree;
        let any = |is_bent| work.spans.iter().any(|(_, bent, _)| *bent == is_bent);
        let straight = any(false).then(|| straight.of_degree(device, shaders, degree));
        let bent = any(true).then(|| bent.of_degree(device, shaders, degree));
        let mut pages = Vec::with_capacity(work.spans.len());
        for (index, (page, is_bent, span)) in work.spans.iter().enumerate() {
            let Some(page) = mirror.page(*page) else { continue };
            let Some(kernels) = (if *is_bent { bent } else { straight }) else { continue };
            let mut resources = vec![
                (0, plan.frame().as_entire_binding()),
                (1, slot(self.spans.buffer(), index as u64, size_of::<Span>())),
                (2, self.page_items.bind()),
                (3, self.items.bind()),
                (4, self.chunk_views.bind()),
                (5, page.as_entire_binding()),
                (6, self.visible.bind()),
                (7, self.offsets.bind()),
            ];
            if *is_bent {
                resources.extend(lenses.bind());
            }
            pages.push((kernels, Groups::Count(span.count), resources));
        }
        for ([cull, _], groups, resources) in &pages {
            cull.run(device, pass, *groups, resources);
        }
        scan.run(device, pass, (plan.jobs(), job::ITEMS), self.offsets.buffer());
        plan.splats(device, pass, scan.block_sums());
        for ([_, project], groups, mut resources) in pages {
            resources.extend([
                (8, splats.shapes.bind()),
                (9, splats.colors.bind()),
                (10, splats.keys[0].bind()),
                (11, splats.places[0].bind()),
            ]);
            project.run(device, pass, groups, &resources);
        }
    }
}
