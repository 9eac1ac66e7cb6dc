// Where the splat of a Gaussian lies. The importing shader binds `visible`, one bit per Gaussian of each cluster view,
// and `offsets`, the index of the first splat of each.

const MASK_WORDS: u32 = CLUSTER / 32;
const INVISIBLE: u32 = 0xffffffffu;

// The index of a Gaussian's splat, or `INVISIBLE`: by the decision of `cull`, even where this pipeline rounds
// differently.
fn splat_slot(cluster_view_index: u32, thread: u32) -> u32 {
    let own_word = visible[cluster_view_index * MASK_WORDS + thread / 32u];
    let own_bit = 1u << (thread % 32u);
    if (own_word & own_bit) == 0u {
        return INVISIBLE;
    }
    var slot = offsets[cluster_view_index] + countOneBits(own_word & (own_bit - 1u));
    for (var word = 0u; word < thread / 32u; word++) {
        slot += countOneBits(visible[cluster_view_index * MASK_WORDS + word]);
    }
    return slot;
}
