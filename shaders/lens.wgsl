// What is no pinhole at rest: lenses, windshields, rolling shutters, there and back. Twin of
// `src/geometry/camera` and `src/render/view.rs`, where the models are documented. Loops are short: some
// devices in software have 65,535 iterations for all of a shader's.

#import angle

@group(0) @binding(12) var<storage, read> lenses: array<Lens, MAX_VIEWS>;

// `Lens.model`. A pinhole is 0.
const OPENCV: u32 = 1;
const FROM_ANGLE: u32 = 2;
const FROM_DISTANCE: u32 = 3;

// `Lens.windshield`: which way its polynomials go. There is none at 0.
const INWARDS: u32 = 1;
const OUTWARDS: u32 = 2;

// Where a direction of any length lands, in pixels; beyond the field the model goes on straight.
fn land(of_view: u32, outside: vec3f) -> vec2f {
    let inside = turn(of_view, outside, INWARDS);
    let off_axis = length(inside.xy);
    // Straight behind there is none.
    let azimuth = inside.xy / max(off_axis, max(-1e-3 * inside.z, 1e-30));
    let end = lenses[of_view].end;
    var plane: vec2f;
    switch lenses[of_view].model {
        case OPENCV: {
            if off_axis < end * inside.z {
                plane = distort(of_view, inside.xy / inside.z);
            } else {
                let edge = azimuth * end;
                let beyond_rad = angle(off_axis, inside.z) - lenses[of_view].end_rad;
                let beyond = (1.0 + end * end) * beyond_rad;
                plane = distort(of_view, edge) + jacobian(of_view, edge) * azimuth * beyond;
            }
        }
        case FROM_ANGLE: { plane = azimuth * rise(of_view, angle(off_axis, inside.z)); }
        case FROM_DISTANCE: { plane = azimuth * fall(of_view, angle(off_axis, inside.z)); }
        default: {
            if off_axis < end * inside.z {
                plane = inside.xy / inside.z;
            } else {
                let beyond_rad = angle(off_axis, inside.z) - lenses[of_view].end_rad;
                plane = azimuth * (end + (1.0 + end * end) * beyond_rad);
            }
        }
    }
    return lenses[of_view].center_px + linear(of_view) * plane;
}

// The unit direction that lands on a place of the image, in pixels; any one outside of the field.
fn unproject(of_view: u32, at_px: vec2f) -> vec3f {
    let plane = solve(linear(of_view), at_px - lenses[of_view].center_px);
    var inside: vec3f;
    switch lenses[of_view].model {
        case OPENCV: { inside = normalize(vec3f(undistort(of_view, plane), 1.0)); }
        case FROM_ANGLE: { inside = off_axis_by(fall(of_view, length(plane)), plane); }
        case FROM_DISTANCE: { inside = off_axis_by(rise(of_view, length(plane)), plane); }
        default: { inside = normalize(vec3f(plane, 1.0)); }
    }
    return turn(of_view, inside, OUTWARDS);
}

// The unit direction at an angle off the axis, in radians, along an azimuth.
fn off_axis_by(angle_rad: f32, azimuth: vec2f) -> vec3f {
    let at = vec4f(angle_rad, 0.0, 0.0, 0.0);
    return vec3f(azimuth * (sine(at, 0.0).x / max(length(azimuth), 1e-30)), sine(at, 0.5).x);
}

// Pixels of a distorted slope, or of a distance along an azimuth.
fn linear(of_view: u32) -> mat2x2f {
    let columns = lenses[of_view].linear;
    return mat2x2f(columns.xy, columns.zw);
}

// A rising polynomial without a constant, in shares of where it ends; beyond, it goes on straight.
fn rise(of_view: u32, x: f32) -> f32 {
    let end = lenses[of_view].end;
    let beyond = max(x - end, 0.0) * lenses[of_view].end_slope;
    return polynomial(of_view, min(x / end, 1.0)).x + beyond;
}

// Where it reaches a value of at least 0: Newton's steps, and halves of what is left where one would
// leave it.
fn fall(of_view: u32, y: f32) -> f32 {
    let end = lenses[of_view].end;
    let top = lenses[of_view].end_value;
    if y >= top {
        return end + (y - top) / lenses[of_view].end_slope;
    }
    var low = 0.0;
    var high = 1.0;
    var share = clamp(y / lenses[of_view].c[0].x, low, high);
    for (var step = 0u; step < 40u; step++) {
        let at = polynomial(of_view, share);
        if at.x > y {
            high = share;
        } else {
            low = share;
        }
        let newton = share - (at.x - y) / at.y;
        let next = select(0.5 * (low + high), newton, newton > low && newton < high);
        let done = abs(next - share) <= 6e-8;
        share = next;
        if done {
            break;
        }
    }
    return share * end;
}

// Value and slope of `c1 u + .. + c9 u^9`.
fn polynomial(of_view: u32, u: f32) -> vec2f {
    let a = lenses[of_view].c[0];
    let b = lenses[of_view].c[1];
    let c = lenses[of_view].c[2].x;
    let value = u * (a.x + u * (a.y + u * (a.z + u * (a.w
        + u * (b.x + u * (b.y + u * (b.z + u * (b.w + u * c))))))));
    let slope = a.x + u * (2.0 * a.y + u * (3.0 * a.z + u * (4.0 * a.w + u * (5.0 * b.x
        + u * (6.0 * b.y + u * (7.0 * b.z + u * (8.0 * b.w + u * (9.0 * c))))))));
    return vec2f(value, slope);
}

// OpenCV's factor `icD` and its derivative by r².
fn radial(of_view: u32, r2: f32) -> vec2f {
    let k = lenses[of_view].c[0];
    let l = lenses[of_view].c[1];
    let above = 1.0 + r2 * (k.x + r2 * (k.y + r2 * k.z));
    let below = 1.0 + r2 * (k.w + r2 * (l.x + r2 * l.y));
    let above_rise = k.x + r2 * (2.0 * k.y + r2 * 3.0 * k.z);
    let below_rise = k.w + r2 * (2.0 * l.x + r2 * 3.0 * l.y);
    return vec2f(above / below, (above_rise * below - above * below_rise) / (below * below));
}

fn distort(of_view: u32, slope: vec2f) -> vec2f {
    let p = lenses[of_view].c[1].zw;
    let s = lenses[of_view].c[2];
    let r2 = dot(slope, slope);
    let tangential = 2.0 * slope.x * slope.y * p + p.yx * (r2 + 2.0 * slope * slope);
    return slope * radial(of_view, r2).x + tangential + (s.xz + s.yw * r2) * r2;
}

// How `distort` changes with the slope.
fn jacobian(of_view: u32, slope: vec2f) -> mat2x2f {
    let p = lenses[of_view].c[1].zw;
    let s = lenses[of_view].c[2];
    let r2 = dot(slope, slope);
    let factor = radial(of_view, r2);
    let prism = 2.0 * (s.xz + 2.0 * s.yw * r2);
    let across = 2.0 * slope.x * slope.y * factor.y + 2.0 * dot(p, slope);
    let along = factor.x + 2.0 * slope * slope * factor.y + 2.0 * p * slope.yx + 6.0 * p.yx * slope;
    return mat2x2f(
        vec2f(along.x + prism.x * slope.x, across + prism.y * slope.x),
        vec2f(across + prism.x * slope.y, along.y + prism.y * slope.y),
    );
}

// The slope that is distorted to this one: Newton's steps from where the radial part alone would be, halved
// until they lead nearer.
fn undistort(of_view: u32, plane: vec2f) -> vec2f {
    let most = lenses[of_view].end;
    let away = length(plane);
    var slope = plane * (radial_slope(of_view, away) / max(away, 1e-30));
    var off = distort(of_view, slope) - plane;
    for (var step = 0u; step < 32u; step++) {
        var by = solve(jacobian(of_view, slope), off);
        var next = slope;
        var next_off = off;
        for (var halved = 0u; halved < 12u; halved++) {
            next = slope - by;
            next *= min(1.01 * most / max(length(next), 1e-30), 1.0);
            next_off = distort(of_view, next) - plane;
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

// Where `r icD(r)` reaches a distance, or the end if that is sooner: Newton's steps, and halves of what is
// left where one would leave it.
fn radial_slope(of_view: u32, away: f32) -> f32 {
    var low = 0.0;
    var high = lenses[of_view].end;
    var slope = min(away, high);
    for (var step = 0u; step < 24u; step++) {
        let factor = radial(of_view, slope * slope);
        let off = slope * factor.x - away;
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

// What `m` takes to `to`.
fn solve(m: mat2x2f, to: vec2f) -> vec2f {
    let adjugate = mat2x2f(vec2f(m[1].y, -m[0].y), vec2f(-m[1].x, m[0].x));
    return adjugate * to / determinant(m);
}

// What the windshield makes of a direction on its way in or out.
fn turn(of_view: u32, direction: vec3f, way: u32) -> vec3f {
    let has = lenses[of_view].windshield;
    if has == 0u {
        return direction;
    }
    let unit = normalize(direction);
    if unit.z < 0.05 {
        return unit;
    }
    let from_rad = vec2f(arc_sine(unit.x), arc_sine(unit.y));
    let cosines = sqrt(max((1.0 - unit.xy) * (1.0 + unit.xy), vec2f(0.0)));
    var sines = unit.xy;
    var bent_rad = bend(of_view, from_rad, sines);
    if way != has {
        // What is bent to `from_rad`: nearly that itself.
        var off_rad = vec2f(0.0);
        for (var step = 0u; step < 26u; step++) {
            let next_rad = -bent_rad;
            let done = distance(next_rad, off_rad) <= 3e-8;
            off_rad = next_rad;
            if done {
                break;
            }
            sines = turned(unit.xy, cosines, off_rad);
            bent_rad = bend(of_view, from_rad + off_rad, sines);
        }
        bent_rad = off_rad;
    }
    sines = turned(unit.xy, cosines, bent_rad);
    return normalize(vec3f(sines, sqrt(max(1.0 - dot(sines, sines), 0.0))));
}

// Sines of two angles after each has grown.
fn turned(sines: vec2f, cosines: vec2f, by_rad: vec2f) -> vec2f {
    let by = vec4f(by_rad, 0.0, 0.0);
    return sines * sine(by, 0.5).xy + cosines * sine(by, 0.0).xy;
}

// By how much two angles change, whose sines are these. It fades out from 81 degrees off the axis to 87.
fn bend(of_view: u32, at_rad: vec2f, sines: vec2f) -> vec2f {
    let z = sqrt(max(1.0 - dot(sines, sines), 0.0));
    let c = lenses[of_view].bend;
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

// The share of the exposure that is still to come when a place of the image, in pixels, is exposed.
fn still_to_come(of_view: u32, at_px: vec2f) -> f32 {
    let along = lenses[of_view].rolls;
    return saturate(along.x * at_px.x + along.y * at_px.y + along.z);
}

// By how much a direction or a point changes from the camera's frame at the exposure's end to that while
// such a share of it was still to come; with a negative share, the other way.
fn turning(of_view: u32, v: vec3f, share: f32) -> vec3f {
    let axis = lenses[of_view].turned.xyz;
    let sines = sine(vec4f(1.0, 0.5, 0.0, 0.0) * (share * lenses[of_view].turned.w), 0.0);
    let across = cross(axis, v);
    return sines.x * across + 2.0 * sines.y * sines.y * cross(axis, across);
}
