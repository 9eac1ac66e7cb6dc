// Chunks of the twin that no actor changes. The other choice of `ACTORS` is `actors.wgsl`.

fn index_of_view(view: ChunkView) -> u32 {
    return view.view;
}

fn index_of_lens(view: ChunkView) -> u32 {
    return view.view;
}

fn lit(rgb: vec3f, chunk_view_index: u32, mean_m: vec3f) -> vec3f {
    return rgb;
}
