// Prefix sum over the 256 threads of a workgroup by doubling (Hillis and Steele 1986): eight rounds. It
// uses no subgroup operations, so the subgroup size does not matter.

var<workgroup> prefix_sums: array<u32, WORKGROUP>;

// Sum of the values of all threads up to and including this one. `prefix_sums` holds the sums of all
// threads until the next call. Every thread of the workgroup must call it.
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

// Sum of the values of all threads before this one; call it after `inclusive_prefix`. The sum is read
// and not computed as inclusive sum minus own value, which is wrong once a sum has saturated.
fn prefix_before(thread: u32) -> u32 {
    if thread == 0u {
        return 0u;
    }
    return prefix_sums[thread - 1u];
}
