// Constants shared with Rust. They are documented in `src/render/constants.rs`, `src/scene`, and
// `src/render/gpu/layout.rs`; `tests/gpu/twins.rs` checks that both sides are equal.

const TILE_PX: u32 = 16;
const EXTENT_SLACK_PX: f32 = 2e-3;
const MAX_SIGMA_PX: f32 = 1e9;
const DEPTH_BITS: u32 = 28;
const MAX_VIEWS: u32 = 16;
const VIEW_BITS: u32 = 4;
const SKY_CUT: f32 = 0.003921568627;

const SHADOW_DEPTH: f32 = 0.5;
const SHADOW_FADE_M: f32 = 0.3;
const SHADOW_GROUND_M: f32 = 0.05;
const SHADOW_TOP_M: f32 = 0.3;

const CLUSTER: u32 = 256;
const SOA_BLOCK: u32 = 32;
const GEOMETRY_WORDS: u32 = 9;

const WORKGROUP: u32 = 256;
const SCAN_BLOCK: u32 = 2048;
const SORT_BLOCK: u32 = 4096;
const DIGITS: u32 = 256;
const MAX_GROUPS: u32 = 65535;
const MACRO_COLUMNS: u32 = 8;
const MACRO_ROWS: u32 = 4;
const LARGE_SPLAT_MACRO_TILES: u32 = 16;
const EXPAND_BATCH: u32 = 1024;
const RASTER_BATCH: u32 = 128;
const BLOCK_PX: u32 = 4;
