// Trigonometry accurate to f32 rounding. WGSL allows its own functions an absolute error of 2^-11.

const HALF_TURN: f32 = 3.14159265359;

// Angle of (x, y) from the x axis, in radians, for y >= 0; 0 at the origin.
//
// The argument is folded to at most 22.5 degrees. There an odd polynomial of degree 9 is fitted to the
// arc tangent; its error is 5e-9.
fn angle(y: f32, x: f32) -> f32 {
    let along = abs(x);
    let small = min(y, along);
    let large = max(max(y, along), 1e-30);
    let steep = small > 0.41421356 * large;
    let t = select(small, small - large, steep) / select(large, small + large, steep);
    let square = t * t;
    let fit = ((0.07902598 * square - 0.13824454) * square + 0.19971879) * square - 0.33332756;
    let within = t + fit * square * t + select(0.0, 0.25 * HALF_TURN, steep);
    let folded = select(within, 0.5 * HALF_TURN - within, y > along);
    return select(folded, HALF_TURN - folded, x < 0.0);
}

// Arc sine of a number in [-1, 1], in radians.
fn arc_sine(x: f32) -> f32 {
    return sign(x) * angle(abs(x), sqrt(max((1.0 - x) * (1.0 + x), 0.0)));
}

// Sines (`quarter` = 0) or cosines (`quarter` = 0.5) of four angles in radians, as in
// `src/scene/sky/inference.rs`.
//
// Range reduction to [-pi/2, pi/2] by Cody and Waite: pi is subtracted in three parts. The products
// with the first two parts are exact.
fn sine(x: vec4f, quarter: f32) -> vec4f {
    let whole = floor(fma(x, vec4f(0.31830988618), vec4f(0.5 - quarter)));
    let turns = whole + quarter;
    let near = fma(-turns, vec4f(9.6774101257e-4), fma(-turns, vec4f(3.140625), x));
    let r = fma(turns, vec4f(8.742278e-8), near);
    let square = r * r;
    let cubic = fma(fma(vec4f(2.6000546e-6), square, vec4f(-1.9806615e-4)), square, vec4f(8.333017e-3));
    let fit = fma(cubic, square, vec4f(-1.6666657e-1));
    let value = fma(fit * square, r, r);
    let odd = (vec4i(whole) + i32(2.0 * quarter)) & vec4i(1);
    return select(value, -value, odd != vec4i(0));
}
