// Batches of the touches of macro tiles, and the indices of the instances that each touch stands for. The importing
// shader imports `macro_tile`, and declares `frame`, `macro_ranges`, `touch_masks`, `first_batches` and `offsets`.

const BATCH_WORDS: u32 = EXPAND_BATCH / 32;

// A batch of touches of a macro tile.
struct Batch {
    macro_tile: u32,
    // Its touches are `first..end` of all.
    first: u32,
    end: u32,
    // `offsets[offset + k * stride]` is its count for tile k of the macro tile.
    offset: u32,
    stride: u32,
    is_first: bool,
    is_last: bool,
}

// Batch `number` of the frame: a search for the last macro tile whose first batch is at most `number`.
fn batch(number: u32) -> Batch {
    var macro_tile = 0u;
    var end = frame.macro_tiles;
    while macro_tile + 1u < end {
        let middle = (macro_tile + end) / 2u;
        if first_batches[middle] <= number {
            macro_tile = middle;
        } else {
            end = middle;
        }
    }
    let range = macro_ranges[macro_tile];
    let first_batch = first_batches[macro_tile];
    let index = number - first_batch;
    let first = range.x + index * EXPAND_BATCH;
    let stride = div_ceil(range.y - range.x, EXPAND_BATCH);
    return Batch(
        macro_tile,
        first,
        min(first + EXPAND_BATCH, range.y),
        first_batch * TILES + index,
        stride,
        index == 0u,
        index + 1u == stride,
    );
}

// For each tile, one bit per splat of the batch, set if the splat touches the tile. Word-major.
var<workgroup> tile_splats: array<atomic<u32>, TILES * BATCH_WORDS>;
// Index of the instance of the first set bit of each word.
var<workgroup> word_starts: array<u32, TILES * BATCH_WORDS>;

// Transposes a batch: from one word of tiles per splat to words of splats per tile. Every thread of the workgroup must
// call it.
fn transpose(own: Batch, thread: u32) {
    for (var k = thread; k < TILES * BATCH_WORDS; k += WORKGROUP) {
        atomicStore(&tile_splats[k], 0u);
    }
    workgroupBarrier();
    let own_bit = 1u << (thread % 32u);
    for (var i = own.first + thread; i < own.end; i += WORKGROUP) {
        let word = (i - own.first) / 32u * TILES;
        for (var rest = touch_masks[i]; rest != 0u; rest &= rest - 1u) {
            atomicOr(&tile_splats[word + firstTrailingBit(rest)], own_bit);
        }
    }
    workgroupBarrier();
}

// After `transpose`, for one tile, whose first instance of this batch is `first`: the index of the first instance of each
// word. Returns the index after the last instance. A barrier must follow.
fn find_word_starts(first: u32, tile: u32) -> u32 {
    var next = first;
    for (var word = tile; word < TILES * BATCH_WORDS; word += TILES) {
        word_starts[word] = next;
        next += countOneBits(atomicLoad(&tile_splats[word]));
    }
    return next;
}

// The instance of touch `i` of a batch in one of its tiles: it follows the nearer ones of its word.
fn instance_index(own: Batch, i: u32, tile: u32) -> u32 {
    let own_bit = 1u << ((i - own.first) % 32u);
    let at = (i - own.first) / 32u * TILES + tile;
    return word_starts[at] + countOneBits(atomicLoad(&tile_splats[at]) & (own_bit - 1u));
}
