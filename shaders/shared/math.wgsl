// Integer arithmetic that several stages share.

// Linear index of a workgroup. Dispatches have two dimensions, since one dimension holds at most 65,535
// workgroups.
fn group_index(group: vec3u, groups: vec3u) -> u32 {
    return group.y * groups.x + group.x;
}

// Number of blocks of `size` elements that hold `length` elements.
fn div_ceil(length: u32, size: u32) -> u32 {
    return (length + size - 1u) / size;
}

// Sum that stays at 2^32 - 1 instead of wrapping. It is still associative: the result is always the
// minimum of the true sum and 2^32 - 1.
fn saturating_add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xFFFFFFFFu, sum < a);
}
