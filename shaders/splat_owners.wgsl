// The owner of every splat: one workgroup per cluster view, after `project.wgsl`. Only frames with classes run it. The
// class of a Gaussian cannot be looked up by ranges of splats, as its instance is. Twin of `Projected::class` in
// `src/render/cpu/project`.

#import constants
#import layout
#import math
#import splat_slot

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> span: Span;
@group(0) @binding(2) var<storage, read> page_cluster_views: array<u32>;
@group(0) @binding(3) var<storage, read> cluster_views: array<ClusterView>;
@group(0) @binding(4) var<storage, read> gaussians: array<u32>;
@group(0) @binding(5) var<storage, read> visible: array<u32>;
@group(0) @binding(6) var<storage, read> offsets: array<u32>;
// For each chunk view, the instance, and in the high half the class of Gaussians that have none.
@group(0) @binding(7) var<storage, read> chunk_owners: array<u32>;
// The same of each splat, with its own class.
@group(0) @binding(8) var<storage, read_write> splat_owners: array<u32>;

@compute @workgroup_size(CLUSTER)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group, groups);
    if index >= span.count {
        return;
    }
    let cluster_view_index = page_cluster_views[span.first + index];
    let slot = splat_slot(cluster_view_index, thread);
    if slot >= frame.splat_capacity {
        return;
    }
    let cluster_view = cluster_views[cluster_view_index];
    let owner = chunk_owners[cluster_view.chunk_view];
    let own_class = gaussian_class(cluster_view.line, thread);
    splat_owners[slot] = select(owner, (owner & 0xFFFFu) | (own_class << 16u), own_class > UNLABELLED);
}

const UNLABELLED: u32 = 1u;

// The class of a Gaussian, one byte; 0 in a cluster without classes. The header's fourth word is the number of lines
// from the cluster's first line to its classes, or 0.
fn gaussian_class(line: u32, thread: u32) -> u32 {
    let lines = gaussians[line * SOA_BLOCK + 3u];
    if lines == 0u {
        return 0u;
    }
    let word = gaussians[(line + lines) * SOA_BLOCK + thread / 4u];
    return (word >> (8u * (thread % 4u))) & 0xFFu;
}
