// Instance ids and classes. As `instances.wgsl`, whose place it takes, with the owners that `splat_owners.wgsl` has
// written for each splat.

#import halved_by

const INSTANCE_PLANES: u32 = 1u;

@group(0) @binding(13) var<storage, read> splat_owners: array<u32>;

// The owners of four pixels: the instance in the low half, and the class in the high half; 0 where there is none.
fn instances() -> vec4u {
    return vec4u(
        splat_owner(halved_by.x),
        splat_owner(halved_by.y),
        splat_owner(halved_by.z),
        splat_owner(halved_by.w),
    );
}

fn splat_owner(halved_by: u32) -> u32 {
    if halved_by == 0u {
        return 0u;
    }
    return splat_owners[instance_splats[halved_by - 1u]];
}
