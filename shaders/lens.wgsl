// Lenses, windshields, and rolling shutters: projection and its inverse. Twin of
// `src/scene/geometry/camera` and `src/render/view.rs`, where the models are documented.
//
// Iteration counts are small, since Mesa's software devices allow 65,535 iterations for all loops of a
// shader together.

#import angle

@group(0) @binding(12) var<storage, read> lenses: array<Lens>;

// Values of `Lens.model`; 0 is a pinhole.
const OPENCV: u32 = 1;
const FROM_ANGLE: u32 = 2;
const FROM_DISTANCE: u32 = 3;

// Values of `Lens.windshield`: whether its polynomials map outside directions to inside ones (forward)
// or the other way round (backward). 0 means that there is no windshield.
const FORWARD: u32 = 1;
const BACKWARD: u32 = 2;

// The image of a direction (of any length), in pixels. Beyond the lens' field the model is continued
// linearly in the angle.
fn project_extrapolated(view_index: u32, outside: vec3f) -> vec2f {
    let inside = through_windshield(view_index, outside, FORWARD);
    let off_axis = length(inside.xy);
    // Finite also straight behind the camera, where the azimuth is undefined.
    let azimuth = inside.xy / max(off_axis, max(-1e-3 * inside.z, 1e-30));
    let end = lenses[view_index].end;
    var plane: vec2f;
    switch lenses[view_index].model {
        case OPENCV: {
            if off_axis < end * inside.z {
                plane = distort(view_index, inside.xy / inside.z);
            } else {
                let edge = azimuth * end;
                // d(tan a)/da = 1 + tan(a)^2 at the end of the field.
                let beyond_rad = angle(off_axis, inside.z) - lenses[view_index].end_rad;
                let beyond = (1.0 + end * end) * beyond_rad;
                plane = distort(view_index, edge) + jacobian(view_index, edge) * azimuth * beyond;
            }
        }
        case FROM_ANGLE: { plane = azimuth * polynomial_extrapolated(view_index, angle(off_axis, inside.z)); }
        case FROM_DISTANCE: { plane = azimuth * polynomial_inverse(view_index, angle(off_axis, inside.z)); }
        default: {
            if off_axis < end * inside.z {
                plane = inside.xy / inside.z;
            } else {
                let beyond_rad = angle(off_axis, inside.z) - lenses[view_index].end_rad;
                plane = azimuth * (end + (1.0 + end * end) * beyond_rad);
            }
        }
    }
    return lenses[view_index].center_px + linear(view_index) * plane;
}

// The unit direction that lands on a point of the image, in pixels; arbitrary outside of the field.
fn unproject(view_index: u32, at_px: vec2f) -> vec3f {
    let plane = solve(linear(view_index), at_px - lenses[view_index].center_px);
    var inside: vec3f;
    switch lenses[view_index].model {
        case OPENCV: { inside = normalize(vec3f(undistort(view_index, plane), 1.0)); }
        case FROM_ANGLE: { inside = off_axis_by(polynomial_inverse(view_index, length(plane)), plane); }
        case FROM_DISTANCE: { inside = off_axis_by(polynomial_extrapolated(view_index, length(plane)), plane); }
        default: { inside = normalize(vec3f(plane, 1.0)); }
    }
    return through_windshield(view_index, inside, BACKWARD);
}

// The unit direction at an angle off the axis, in radians, along an azimuth (of any length).
fn off_axis_by(angle_rad: f32, azimuth: vec2f) -> vec3f {
    let at = vec4f(angle_rad, 0.0, 0.0, 0.0);
    return vec3f(azimuth * (sine(at, 0.0).x / max(length(azimuth), 1e-30)), sine(at, 0.5).x);
}

// Matrix from the lens' plane (distorted slopes, or a radius along an azimuth) to pixels.
fn linear(view_index: u32) -> mat2x2f {
    let columns = lenses[view_index].linear;
    return mat2x2f(columns.xy, columns.zw);
}

// The lens' rising polynomial, which has no constant term, continued linearly beyond its end. Its
// variable is a fraction of the end.
fn polynomial_extrapolated(view_index: u32, x: f32) -> f32 {
    let end = lenses[view_index].end;
    let beyond = max(x - end, 0.0) * lenses[view_index].end_slope;
    return polynomial(view_index, min(x / end, 1.0)).x + beyond;
}

// Inverse of `polynomial_extrapolated` for a value of at least 0: Newton's method, with a bisection step where
// Newton's would leave the bracket.
fn polynomial_inverse(view_index: u32, y: f32) -> f32 {
    let end = lenses[view_index].end;
    let top = lenses[view_index].end_value;
    if y >= top {
        return end + (y - top) / lenses[view_index].end_slope;
    }
    var low = 0.0;
    var high = 1.0;
    var fraction = clamp(y / lenses[view_index].coefficients[0].x, low, high);
    for (var step = 0u; step < 40u; step++) {
        let at = polynomial(view_index, fraction);
        if at.x > y {
            high = fraction;
        } else {
            low = fraction;
        }
        let newton = fraction - (at.x - y) / at.y;
        let next = select(0.5 * (low + high), newton, newton > low && newton < high);
        let done = abs(next - fraction) <= 6e-8;
        fraction = next;
        if done {
            break;
        }
    }
    return fraction * end;
}

// Value and derivative of `c1 u + .. + c9 u^9`.
fn polynomial(view_index: u32, u: f32) -> vec2f {
    let a = lenses[view_index].coefficients[0];
    let b = lenses[view_index].coefficients[1];
    let c = lenses[view_index].coefficients[2].x;
    let value = u * (a.x + u * (a.y + u * (a.z + u * (a.w
        + u * (b.x + u * (b.y + u * (b.z + u * (b.w + u * c))))))));
    let slope = a.x + u * (2.0 * a.y + u * (3.0 * a.z + u * (4.0 * a.w + u * (5.0 * b.x
        + u * (6.0 * b.y + u * (7.0 * b.z + u * (8.0 * b.w + u * (9.0 * c))))))));
    return vec2f(value, slope);
}

// OpenCV's radial factor `(1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`, called `icD` in its
// source, and the derivative of the factor by r².
fn radial(view_index: u32, r2: f32) -> vec2f {
    let k = lenses[view_index].coefficients[0];
    let l = lenses[view_index].coefficients[1];
    let above = 1.0 + r2 * (k.x + r2 * (k.y + r2 * k.z));
    let below = 1.0 + r2 * (k.w + r2 * (l.x + r2 * l.y));
    let above_rise = k.x + r2 * (2.0 * k.y + r2 * 3.0 * k.z);
    let below_rise = k.w + r2 * (2.0 * l.x + r2 * 3.0 * l.y);
    return vec2f(above / below, (above_rise * below - above * below_rise) / (below * below));
}

// OpenCV's distortion of a slope (x/z, y/z): radial, tangential (p), and thin prism (s).
fn distort(view_index: u32, slope: vec2f) -> vec2f {
    let p = lenses[view_index].coefficients[1].zw;
    let s = lenses[view_index].coefficients[2];
    let r2 = dot(slope, slope);
    let tangential = 2.0 * slope.x * slope.y * p + p.yx * (r2 + 2.0 * slope * slope);
    return slope * radial(view_index, r2).x + tangential + (s.xz + s.yw * r2) * r2;
}

// Jacobian of `distort` by the slope.
fn jacobian(view_index: u32, slope: vec2f) -> mat2x2f {
    let p = lenses[view_index].coefficients[1].zw;
    let s = lenses[view_index].coefficients[2];
    let r2 = dot(slope, slope);
    let factor = radial(view_index, r2);
    let prism = 2.0 * (s.xz + 2.0 * s.yw * r2);
    let across = 2.0 * slope.x * slope.y * factor.y + 2.0 * dot(p, slope);
    let along = factor.x + 2.0 * slope * slope * factor.y + 2.0 * p * slope.yx + 6.0 * p.yx * slope;
    return mat2x2f(
        vec2f(along.x + prism.x * slope.x, across + prism.y * slope.x),
        vec2f(across + prism.x * slope.y, along.y + prism.y * slope.y),
    );
}

// Inverse of `distort`: Newton's method, which starts at the inverse of only the radial part; a step is
// halved until it decreases the residual.
fn undistort(view_index: u32, plane: vec2f) -> vec2f {
    let most = lenses[view_index].end;
    let radius = length(plane);
    var slope = plane * (radial_slope(view_index, radius) / max(radius, 1e-30));
    var off = distort(view_index, slope) - plane;
    for (var step = 0u; step < 32u; step++) {
        var by = solve(jacobian(view_index, slope), off);
        var next = slope;
        var next_off = off;
        for (var halved = 0u; halved < 12u; halved++) {
            next = slope - by;
            next *= min(1.01 * most / max(length(next), 1e-30), 1.0);
            next_off = distort(view_index, next) - plane;
            if length(next_off) < length(off) {
                break;
            }
            by *= 0.5;
        }
        let nearer = length(next_off) < length(off);
        let done = !nearer || distance(next, slope) <= 1e-7;
        if nearer {
            slope = next;
            off = next_off;
        }
        if done {
            break;
        }
    }
    return slope;
}

// The slope r at which `r icD(r)` reaches a radius, at most the end of the field: Newton's method, with a
// bisection step where Newton's would leave the bracket.
fn radial_slope(view_index: u32, radius: f32) -> f32 {
    var low = 0.0;
    var high = lenses[view_index].end;
    var slope = min(radius, high);
    for (var step = 0u; step < 24u; step++) {
        let factor = radial(view_index, slope * slope);
        let off = slope * factor.x - radius;
        if off > 0.0 {
            high = slope;
        } else {
            low = slope;
        }
        let newton = slope - off / (factor.x + 2.0 * slope * slope * factor.y);
        let next = select(0.5 * (low + high), newton, newton > low && newton < high);
        let done = abs(next - slope) <= 1e-6;
        slope = next;
        if done {
            break;
        }
    }
    return slope;
}

// Solution x of `m x = to`.
fn solve(m: mat2x2f, to: vec2f) -> vec2f {
    let adjugate = mat2x2f(vec2f(m[1].y, -m[0].y), vec2f(-m[1].x, m[0].x));
    return adjugate * to / determinant(m);
}

// Direction after refraction by the windshield: into the car (`FORWARD`) or out of it (`BACKWARD`). The
// polynomials give one of both; the other one is found by fixed-point iteration.
fn through_windshield(view_index: u32, direction: vec3f, wanted: u32) -> vec3f {
    let given = lenses[view_index].windshield;
    if given == 0u {
        return direction;
    }
    let unit = normalize(direction);
    if unit.z < 0.05 {
        return unit;
    }
    let from_rad = vec2f(arc_sine(unit.x), arc_sine(unit.y));
    let cosines = sqrt(max((1.0 - unit.xy) * (1.0 + unit.xy), vec2f(0.0)));
    var sines = unit.xy;
    var shift_rad = windshield_shift_rad(view_index, from_rad, sines);
    if wanted != given {
        // Solve for the angles that the polynomials map to `from_rad`. They differ little from it.
        var off_rad = vec2f(0.0);
        for (var step = 0u; step < 26u; step++) {
            let next_rad = -shift_rad;
            let done = distance(next_rad, off_rad) <= 3e-8;
            off_rad = next_rad;
            if done {
                break;
            }
            sines = sines_of_sums(unit.xy, cosines, off_rad);
            shift_rad = windshield_shift_rad(view_index, from_rad + off_rad, sines);
        }
        shift_rad = off_rad;
    }
    sines = sines_of_sums(unit.xy, cosines, shift_rad);
    return normalize(vec3f(sines, sqrt(max(1.0 - dot(sines, sines), 0.0))));
}

// Sines of the sums of two angles, given by sine and cosine, and two increments in radians.
fn sines_of_sums(sines: vec2f, cosines: vec2f, by_rad: vec2f) -> vec2f {
    let by = vec4f(by_rad, 0.0, 0.0);
    return sines * sine(by, 0.5).xy + cosines * sine(by, 0.0).xy;
}

// Change of a direction's two angles by the windshield, in radians. It fades out between 81 and 87 degrees
// off the axis.
fn windshield_shift_rad(view_index: u32, at_rad: vec2f, sines: vec2f) -> vec2f {
    let z = sqrt(max(1.0 - dot(sines, sines), 0.0));
    let c = lenses[view_index].windshield_shift;
    let x = at_rad.x;
    let row0 = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5]))));
    let row1 = c[6] + x * (c[7] + x * (c[8] + x * (c[9] + x * c[10])));
    let row2 = c[11] + x * (c[12] + x * (c[13] + x * c[14]));
    let row3 = c[15] + x * (c[16] + x * c[17]);
    let row4 = c[18] + x * c[19];
    let y = at_rad.y;
    let sum = row0 + y * (row1 + y * (row2 + y * (row3 + y * (row4 + y * c[20]))));
    return saturate((z - 0.05) / 0.1) * sum;
}

// Fraction of the exposure that remains when a point of the image, in pixels, is exposed.
fn remaining_exposure(view_index: u32, at_px: vec2f) -> f32 {
    let plane = lenses[view_index].remaining_exposure;
    return saturate(plane.x * at_px.x + plane.y * at_px.y + plane.z);
}

// Change of a direction or a point when it is transformed from the camera's frame at the end of the
// exposure to the frame when `fraction` of the exposure remained, because of the camera's rotation
// (Rodrigues' formula). With a negative fraction: the inverse.
fn rotation_shift(view_index: u32, v: vec3f, fraction: f32) -> vec3f {
    let axis = lenses[view_index].axis_angle.xyz;
    let sines = sine(vec4f(1.0, 0.5, 0.0, 0.0) * (fraction * lenses[view_index].axis_angle.w), 0.0);
    let across = cross(axis, v);
    return sines.x * across + 2.0 * sines.y * sines.y * cross(axis, across);
}
