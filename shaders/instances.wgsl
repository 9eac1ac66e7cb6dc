// Instance ids: whose splat brings a pixel's transmittance to a half or less. The other choices of `INSTANCES`
// are `owners.wgsl`, which has classes, too, and `no_instances.wgsl`. Twin of `Wants::owners` in `src/render/cpu/rasterize.rs`.
//
// Splats are in order of (view, global id), so the chunks of each owner are one range of them. A pixel keeps
// the index of the splat in its tile's list, and looks up the owner once, at its end.

#import halved_by

const INSTANCE_PLANES: u32 = 1u;

@group(0) @binding(13) var<storage, read> owners: array<Owner>;
// For each cluster view, the index of its first splat.
@group(0) @binding(14) var<storage, read> first_splats: array<u32>;

// The instances of four pixels: 0 none, 1 the twin, k + 2 actor k.
fn instances() -> vec4u {
    return vec4u(
        owner_instance(halved_by.x),
        owner_instance(halved_by.y),
        owner_instance(halved_by.z),
        owner_instance(halved_by.w),
    );
}

fn owner_instance(halved_by: u32) -> u32 {
    if halved_by == 0u {
        return 0u;
    }
    let splat = instance_splats[halved_by - 1u];
    // The last owner whose first splat is not after this one.
    var low = 0u;
    var high = owners[0].instance;
    while low + 1u < high {
        let middle = (low + high) / 2u;
        if first_splats[owners[middle + 1u].cluster_view] <= splat {
            low = middle;
        } else {
            high = middle;
        }
    }
    return owners[low + 1u].instance;
}
