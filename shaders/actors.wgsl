// Chunks of actors, and those of the twin on which the contact shadows of actors fall. The other choice of
// `ACTORS` is `no_actors.wgsl`. Twin of `src/render/cpu/project/light.rs`.

@group(0) @binding(13) var<storage, read> chunk_lights: array<ChunkLight>;
@group(0) @binding(14) var<storage, read> chunk_shadows: array<ChunkShadow>;

fn index_of_view(view: ChunkView) -> u32 {
    return view.view & ((1u << VIEW_BITS) - 1u);
}

fn index_of_lens(view: ChunkView) -> u32 {
    return view.view >> VIEW_BITS;
}

// The colour of a Gaussian with its actor's tint, or beneath contact shadows.
fn lit(rgb: vec3f, chunk_view_index: u32, mean_m: vec3f) -> vec3f {
    let light = chunk_lights[chunk_view_index];
    var factor = 1.0;
    for (var k = 0u; k < light.shadows; k++) {
        factor *= shadow_factor(chunk_shadows[light.first_shadow + k], vec4f(mean_m, 1.0));
    }
    return rgb * light.tint * factor;
}

// The factor of one shadow on a colour at a point of the chunk, in metres.
fn shadow_factor(shadow: ChunkShadow, at_m: vec4f) -> f32 {
    let rows = shadow.actor_from_chunk;
    let from_actor_m = abs(vec3f(dot(rows[0], at_m), dot(rows[1], at_m), dot(rows[2], at_m)));
    let low_m = vec3f(shadow.half_m - SHADOW_FADE_M, SHADOW_GROUND_M);
    let high_m = vec3f(shadow.half_m + SHADOW_FADE_M, SHADOW_TOP_M);
    let share = 1.0 - smoothstep(low_m, high_m, from_actor_m);
    return 1.0 - SHADOW_DEPTH * share.x * share.y * share.z;
}
