// Buffer layouts shared with Rust. They are documented in `src/render/gpu/layout.rs`;
// `tests/gpu/twins.rs` checks that names, offsets, and sizes are equal.

struct FrameView {
    size_px: vec2u,
    columns: u32,
    first_tile: u32,
    macro_columns: u32,
    first_macro_tile: u32,
    rows: vec2u,
    native_px2: vec2f,
    total_px2: vec2f,
}

struct Frame {
    splat_capacity: u32,
    touch_capacity: u32,
    instance_capacity: u32,
    views: u32,
    tiles: u32,
    macro_tiles: u32,
    near_m: f32,
    far_m: f32,
    antialiased: u32,
    alpha_cap: f32,
    log2_alpha_cut: f32,
    stop: f32,
    batch_limit: u32,
    long_tile_splats: u32,
    long_tiles: u32,
    sampled: u32,
    view: array<FrameView, MAX_VIEWS>,
}

struct Background {
    scale: f32,
    offset: f32,
    edge: u32,
    width: u32,
    octaves: u32,
    encoded: u32,
    identity: u32,
    skip: u32,
    sky_from_pixel: array<array<vec4f, 3>, MAX_VIEWS>,
}

struct CameraAppearance {
    exposure: array<vec4f, 3>,
    overlay_px: vec2u,
    first_overlay: u32,
    has_exposure: u32,
}

struct ChunkView {
    camera_from_chunk: array<vec4f, 3>,
    depth_high: vec4f,
    depth_low: vec4f,
    camera_m: vec3f,
    view: u32,
    focal_px: vec2f,
    center_px: vec2f,
    slope_min: vec2f,
    slope_max: vec2f,
}

struct ChunkLight {
    tint: vec3f,
    first_shadow: u32,
    shadows: u32,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

struct ChunkShadow {
    actor_from_chunk: array<vec4f, 3>,
    half_m: vec2f,
    pad: vec2f,
}

struct Lens {
    center_px: vec2f,
    model: u32,
    windshield: u32,
    linear: vec4f,
    end: f32,
    end_value: f32,
    end_slope: f32,
    end_rad: f32,
    widest_rad: f32,
    by_distance: u32,
    non_pinhole: u32,
    pad0: u32,
    coefficients: array<vec4f, 3>,
    windshield_shift: array<vec2f, 22>,
    remaining_exposure: vec4f,
    moved_m: vec3f,
    pad1: u32,
    moved_world_m: vec3f,
    pad2: u32,
    axis_angle: vec4f,
    expansion: vec4f,
}

struct Owner {
    cluster_view: u32,
    instance: u32,
}

struct ClusterView {
    line: u32,
    chunk_view: u32,
}

struct Span {
    first: u32,
    count: u32,
}

struct MacroRun {
    first_macro_tile: u32,
    macro_tiles: u32,
    tiles: u32,
    continues: u32,
    first_touch: u32,
    touches: u32,
    first_instance: u32,
    first_batch: u32,
    batches: u32,
    first_tile: u32,
}

struct Job {
    length: u32,
    groups: array<u32, 3>,
}

struct JobSlot {
    job: Job,
    pad: array<vec4u, 15>,
}

struct Counters {
    splats: u32,
    touches: u32,
    instances: u32,
}

struct TileCounters {
    block_pairs: atomic<u32>,
    most_batches: atomic<u32>,
}

struct SplatShape {
    mean_px: vec2f,
    extent_px: vec2f,
    factor: vec3f,
    log2_opacity: f32,
}

struct SplatColor {
    rgb: vec3f,
    depth_m: f32,
}
