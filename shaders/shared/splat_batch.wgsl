// A batch of a tile's splats in workgroup memory: what every thread of the tile reads of them, and how far the tile is.
// The importing kernel defines `BATCH`, the splats of a batch.

// Blocks of a tile: four by four.
const BLOCKS: u32 = 16;
// Index of a splat of no opacity, after those of a batch.
const NO_SPLAT: u32 = BATCH;

// Mean, and the first row of the Cholesky factor (l0, l1).
var<workgroup> mean_factors: array<vec4f, BATCH + 1>;
// l2 of the Cholesky factor, and base-2 logarithm of the peak opacity.
var<workgroup> opacities: array<vec2f, BATCH + 1>;
// Colour, and depth in metres.
var<workgroup> color_depths: array<vec4f, BATCH + 1>;
// Number of (splat, block) pairs in all loaded batches.
var<workgroup> block_pairs: atomic<u32>;
// Threads whose pixels are all done. The loop over batches ends when `done_threads`, which one thread copies from it,
// counts all of them.
var<workgroup> done_count: atomic<u32>;
var<workgroup> done_threads: u32;

// Before the first batch, by one thread; a barrier must follow.
fn begin_batches() {
    atomicStore(&done_count, 0u);
    atomicStore(&block_pairs, 0u);
    mean_factors[NO_SPLAT] = vec4f(0.0);
    opacities[NO_SPLAT] = vec2f(0.0, -1e30);
    color_depths[NO_SPLAT] = vec4f(0.0);
}

// Stores splat `k` of the batch.
fn store_splat(k: u32, shape: SplatShape, color: SplatColor) {
    mean_factors[k] = vec4f(shape.mean_px, shape.factor.xy);
    opacities[k] = vec2f(shape.factor.z, shape.log2_opacity);
    color_depths[k] = vec4f(color.rgb, color.depth_m);
}
