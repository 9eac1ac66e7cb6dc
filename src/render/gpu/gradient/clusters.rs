//! Where the gradients of each cluster lie on the device, and how they come back to the chunks.

use std::collections::BTreeMap;

use crate::gpu::layout::Span;
use crate::gpu::mirror::{Mirror, largest_component};
use crate::gpu::project_work::{ProjectDispatch, ProjectWork, Projection};
use crate::gradient::{ChunkGradients, chunks};
use wildcity_scene::Scene;
use wildcity_scene::chunk::{CLUSTER, LANES, Lanes, column, columns};

/// Words of visible Gaussians of a cluster view.
const MASK_WORDS: usize = CLUSTER / 32;

/// The clusters that some view of a frame may see.
#[derive(Debug)]
pub(in crate::gpu) struct GradientClusters {
    /// For each cluster view, its cluster.
    by_view: Vec<u32>,
    clusters: Vec<GradientCluster>,
    /// Lines of [`CLUSTER`] values of all clusters.
    pub(in crate::gpu) lines: u64,
    /// The dispatches of static pinholes, view by view.
    pub(in crate::gpu) dispatches: Vec<ProjectDispatch>,
}

/// A cluster of a chunk.
#[derive(Clone, Copy, Debug)]
struct GradientCluster {
    /// Number of the chunk: those of the twin, then those of actors.
    chunk: usize,
    cluster: usize,
    first_line: u32,
}

impl GradientClusters {
    pub(in crate::gpu) fn new(work: &ProjectWork, scene: &Scene, mirror: &Mirror) -> Self {
        let chunks = chunks(scene);
        // A cluster view has its line in a page of the mirror, and only the dispatches name the
        // page.
        let mut pages = vec![0; work.cluster_views.len()];
        for dispatch in &work.dispatches {
            for &cluster_view in work.cluster_views_in(dispatch.span) {
                pages[cluster_view as usize] = dispatch.page;
            }
        }
        // The clusters of each chunk that is seen, by their place in the mirror.
        let mut places: BTreeMap<usize, BTreeMap<(usize, u32), usize>> = BTreeMap::new();
        let mut found: BTreeMap<(usize, usize), u32> = BTreeMap::new();
        let mut clusters = Self {
            by_view: Vec::with_capacity(pages.len()),
            clusters: Vec::new(),
            lines: 0,
            dispatches: Vec::new(),
        };
        for (cluster_view, page) in work.cluster_views.iter().zip(pages) {
            let chunk = work.chunk_numbers[cluster_view.chunk_view as usize] as usize;
            let of_chunk = places.entry(chunk).or_insert_with(|| {
                let places = mirror.places(chunks[chunk]).iter().enumerate();
                places.map(|(index, place)| ((place.page, place.lines.start), index)).collect()
            });
            let cluster = of_chunk[&(page, cluster_view.line)];
            let index = *found.entry((chunk, cluster)).or_insert_with(|| {
                let first_line = clusters.lines as u32;
                clusters.clusters.push(GradientCluster { chunk, cluster, first_line });
                clusters.lines += columns(chunks[chunk].sh_degree()) as u64;
                clusters.clusters.len() as u32 - 1
            });
            clusters.by_view.push(index);
        }
        clusters.dispatches = by_view(work);
        clusters
    }

    /// For each cluster view, the first line of its cluster.
    pub(in crate::gpu) fn first_lines(&self) -> Vec<u32> {
        let first_line = |&cluster: &u32| self.clusters[cluster as usize].first_line;
        self.by_view.iter().map(first_line).collect()
    }

    /// The number of the chunk of a cluster view, and the index of its first Gaussian there.
    pub(in crate::gpu) fn first_gaussian(&self, cluster_view: usize) -> (usize, usize) {
        let GradientCluster { chunk, cluster, .. } =
            self.clusters[self.by_view[cluster_view] as usize];
        (chunk, cluster * CLUSTER)
    }

    /// Copies the lines to the chunks. `visible` are the words of each cluster view.
    pub(in crate::gpu) fn copy_to(
        &self,
        scene: &Scene,
        work: &ProjectWork,
        lines: &[f32],
        visible: &[u32],
        gradients: &mut [ChunkGradients],
    ) {
        let chunks = chunks(scene);
        // What the device has projected backwards: lenses come later.
        let mut seen = vec![[0; MASK_WORDS]; self.clusters.len()];
        let (words, _) = visible.as_chunks::<MASK_WORDS>();
        for dispatch in &self.dispatches {
            for &cluster_view in work.cluster_views_in(dispatch.span) {
                let seen = &mut seen[self.by_view[cluster_view as usize] as usize];
                for (seen, word) in seen.iter_mut().zip(words[cluster_view as usize]) {
                    // A cluster may be seen by several views, and each sees other Gaussians of it.
                    *seen |= word;
                }
            }
        }
        for (cluster, seen) in self.clusters.iter().zip(seen) {
            let chunk = chunks[cluster.chunk];
            let gradients = &mut gradients[cluster.chunk];
            let width = columns(chunk.sh_degree());
            let lines = &lines[cluster.first_line as usize * CLUSTER..][..width * CLUSTER];
            for group in 0..CLUSTER / LANES {
                // A word has the bits of two groups of 16 lanes.
                let bits = (seen[group / 2] >> (16 * (group % 2))) as u16;
                if bits == 0 {
                    continue;
                }
                let index = cluster.cluster * CLUSTER / LANES + group;
                gradients.visible[index] |= bits;
                let lanes = &mut gradients.lanes[index * width..][..width];
                for (column, lanes) in lanes.iter_mut().enumerate() {
                    lanes.0.copy_from_slice(&lines[column * CLUSTER + group * LANES..][..LANES]);
                }
                turn_back(chunk.lane_group(index), lanes);
            }
        }
    }
}

/// The device has some quaternions with the other sign, and so the derivatives by them.
fn turn_back(columns: &[Lanes], gradients: &mut [Lanes]) {
    for lane in 0..LANES {
        let quat = [0, 1, 2, 3].map(|k| columns[column::QUAT + k].0[lane]);
        let (_, sign) = largest_component(quat);
        for gradient in &mut gradients[column::QUAT..][..4] {
            gradient.0[lane] *= sign;
        }
    }
}

/// The dispatches of static pinholes, in the order of their views.
fn by_view(work: &ProjectWork) -> Vec<ProjectDispatch> {
    let mut dispatches = Vec::new();
    for dispatch in &work.dispatches {
        if dispatch.variant.projection != Projection::Pinhole {
            continue;
        }
        let mut first = dispatch.span.first;
        let cluster_views = work.cluster_views_in(dispatch.span);
        // A dispatch has the cluster views of several views one after the other.
        for run in cluster_views.chunk_by(|&a, &b| work.view(a) == work.view(b)) {
            let span = Span { first, count: run.len() as u32 };
            first += span.count;
            dispatches.push((work.view(run[0]), ProjectDispatch { span, ..*dispatch }));
        }
    }
    // Stable: the order of pages and kernels stays.
    dispatches.sort_by_key(|(view, _)| *view);
    dispatches.into_iter().map(|(_, dispatch)| dispatch).collect()
}
