// Arithmetic that several stages share.

// Groups are folded into two dimensions, since one holds 65,535: the index of a group.
fn group_index(group: vec3u, groups: vec3u) -> u32 {
    return group.y * groups.x + group.x;
}

// Blocks of `size` that hold `length` elements.
fn blocks(length: u32, size: u32) -> u32 {
    return (length + size - 1u) / size;
}

// Stays at the largest number instead of wrapping. Sums are associative all the same: each is the
// smaller of the true sum and the largest number.
fn saturating_add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xFFFFFFFFu, sum < a);
}
