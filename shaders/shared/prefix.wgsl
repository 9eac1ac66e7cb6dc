// Prefix sum over the 256 threads of a workgroup, by doubling (Hillis and Steele 1986): eight
// rounds, for subgroups of any size.

var<workgroup> prefix_sums: array<u32, WORKGROUP>;

// The sum up to and including this thread; `prefix_sums` holds all of them until the next call.
// Every thread of the workgroup calls it.
fn inclusive_prefix(thread: u32, value: u32) -> u32 {
    workgroupBarrier();
    prefix_sums[thread] = value;
    workgroupBarrier();
    var sum = value;
    for (var distance = 1u; distance < WORKGROUP; distance *= 2u) {
        var before = 0u;
        if thread >= distance {
            before = prefix_sums[thread - distance];
        }
        workgroupBarrier();
        sum = saturating_add(sum, before);
        prefix_sums[thread] = sum;
        workgroupBarrier();
    }
    return sum;
}

// The sum before this thread, after `inclusive_prefix`: not a difference, which saturation falsifies.
fn prefix_before(thread: u32) -> u32 {
    if thread == 0u {
        return 0u;
    }
    return prefix_sums[thread - 1u];
}
