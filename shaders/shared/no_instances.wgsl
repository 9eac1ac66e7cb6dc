// Frames without instance ids and classes. The other choices of `INSTANCES` are `instances.wgsl` and `owners.wgsl`.

const INSTANCE_PLANES: u32 = 0u;

fn note_owner(list_index: u32, before: vec4f, after: vec4f, counts: vec4<bool>) {}

fn instances() -> vec4u {
    return vec4u(0u);
}

fn set_owners(list_indices: vec4u) {}
