// The sums over a splat's pixels that its gradients need. Twin of `partial` in `src/render/gradient`, where the formulas
// are.

struct SplatSums {
    g: f32,
    u: f32,
    v: f32,
    uu: f32,
    uv: f32,
    vv: f32,
    red: f32,
    green: f32,
    blue: f32,
    depth: f32,
}

fn plus(a: SplatSums, b: SplatSums) -> SplatSums {
    return SplatSums(
        a.g + b.g,
        a.u + b.u,
        a.v + b.v,
        a.uu + b.uu,
        a.uv + b.uv,
        a.vv + b.vv,
        a.red + b.red,
        a.green + b.green,
        a.blue + b.blue,
        a.depth + b.depth,
    );
}
