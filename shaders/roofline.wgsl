// Measures the device's peak rates of copying memory and of multiply-adds. This is not a stage of the
// renderer; only `wildcity-bench gpu` runs it.

#import constants
#import layout
#import math

@group(0) @binding(0) var<storage, read> source: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> copied: array<vec4f>;

@compute @workgroup_size(WORKGROUP)
fn copy(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, groups) * WORKGROUP + thread;
    if i < arrayLength(&source) {
        copied[i] = source[i];
    }
}

@group(0) @binding(2) var<uniform> span: Span;

// `span.count` rounds of 64 multiply-adds per thread: four vectors of four components, four times.
@compute @workgroup_size(WORKGROUP)
fn multiply_add(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, groups) * WORKGROUP + thread;
    var a = vec4f(f32(thread));
    var b = a + 1.0;
    var c = a + 2.0;
    var d = a + 3.0;
    let factor = vec4f(0.999);
    let addend = vec4f(0.5);
    for (var round = 0u; round < span.count; round++) {
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
    }
    if i < arrayLength(&copied) {
        copied[i] = a + b + c + d;
    }
}
