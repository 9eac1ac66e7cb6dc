// A lens, a windshield and a rolling shutter around a point, to second order. Twin of
// `src/render/cpu/lens/expansion.rs`, where the terms are derived; `src/render/expansion.rs` has the bound.

struct Expansion {
    // Rows that take a displacement in the camera's frame at the end of the exposure, in metres, to (a, b, c).
    rows: array<vec3f, 3>,
    // alpha, beta, gamma, kappa.
    terms: vec4f,
    mu: f32,
    // Maps movements away from the axis and around it to pixels.
    plane: mat2x2f,
    // Distance to the end of the lens' field, as a length of (a, b, c).
    room: f32,
}

// The rolling shutter around a point: the exposure time depends on the image position, and the image position
// depends on the exposure time.
struct ShutterTerms {
    // (a, b, c) of the point per unit of the remaining exposure, and their image.
    motion: vec3f,
    motion_px: vec2f,
    // Change of the remaining exposure per pixel, with the feedback of the motion.
    per_px: vec2f,
    // 1 where the exposure time changes with the image position; 0 beyond the first and the last row, where it
    // is clamped.
    rolls: f32,
    to_limit: f32,
}

fn first_order(expansion: Expansion, abc: vec3f) -> vec2f {
    return expansion.plane * (expansion.terms.xy * abc.xy);
}

fn second_order(expansion: Expansion, abc: vec3f) -> vec2f {
    let t = expansion.terms;
    let away = 0.5 * (t.z * abc.x * abc.x + t.w * abc.y * abc.y) - t.x * abc.x * abc.z;
    let around = expansion.mu * abc.x * abc.y - t.y * abc.y * abc.z;
    return expansion.plane * vec2f(away, around);
}

fn components(expansion: Expansion, by_m: vec3f) -> vec3f {
    return vec3f(dot(expansion.rows[0], by_m), dot(expansion.rows[1], by_m), dot(expansion.rows[2], by_m));
}

// The expansion around a point of the camera's frame, by lens and windshield.
fn expand(view_index: u32, point_m: vec3f) -> Expansion {
    if lenses[view_index].windshield == 0u {
        return expand_lens(view_index, point_m);
    }
    let distance_m = length(point_m);
    let unit = point_m / distance_m;
    let inside = through_windshield(view_index, unit, FORWARD);
    // Derivatives of the inside direction by x and y of the outside one: with x = sin φ and x' = sin h(φ, θ),
    // ∂x'/∂x = cos h ∂h/∂φ / cos φ; z follows from the unit length.
    let slopes = windshield_slopes(view_index, vec2f(arc_sine(unit.x), arc_sine(unit.y)));
    let cosines = sqrt(max(1.0 - unit.xy * unit.xy, vec2f(1e-12)));
    let inside_cosines = sqrt(max(1.0 - inside.xy * inside.xy, vec2f(1e-12)));
    let by_x = inside_cosines * slopes[0] / cosines.x;
    let by_y = inside_cosines * slopes[1] / cosines.y;
    let per_z = 1.0 / max(inside.z, 1e-6);
    let column_x = vec3f(by_x, -dot(inside.xy, by_x) * per_z);
    let column_y = vec3f(by_y, -dot(inside.xy, by_y) * per_z);
    var expansion = expand_lens(view_index, inside * distance_m);
    for (var i = 0; i < 3; i++) {
        let row = expansion.rows[i];
        let along_x = dot(row, column_x);
        let along_y = dot(row, column_y);
        let along = dot(row, inside) - unit.x * along_x - unit.y * along_y;
        expansion.rows[i] = unit * along + vec3f(along_x, along_y, 0.0);
    }
    // The refraction fades out from z = 0.15 on.
    expansion.room = min(expansion.room, unit.z - 0.15);
    return expansion;
}

// The expansion by the lens only, of points or of directions behind the windshield.
fn expand_lens(view_index: u32, point_m: vec3f) -> Expansion {
    let end = lenses[view_index].end;
    let model = lenses[view_index].model;
    var expansion: Expansion;
    if model == FROM_ANGLE || model == FROM_DISTANCE {
        let distance_m = length(point_m);
        let off_axis = length(point_m.xy);
        let on_axis = off_axis < 1e-18;
        let azimuth = select(point_m.xy / select(off_axis, 1.0, on_axis), vec2f(1.0, 0.0), on_axis);
        let cosine = point_m.z / distance_m;
        let sine_off = off_axis / distance_m;
        let rad = angle(off_axis, point_m.z);
        // Radius, and its derivatives by the angle.
        var radius: vec3f;
        if model == FROM_ANGLE {
            let p = polynomial_and_derivatives(view_index, min(rad / end, 1.0));
            radius = vec3f(p.x, p.y / end, p.z / (end * end));
            expansion.room = end - rad;
        } else {
            let at = polynomial_inverse(view_index, rad);
            let p = polynomial_and_derivatives(view_index, min(at / end, 1.0));
            let slope = end / p.y;
            radius = vec3f(at, slope, -p.z / (end * end) * slope * slope * slope);
            expansion.room = lenses[view_index].end_value - rad;
        }
        let alpha = radius.y;
        let beta = select(radius.x / sine_off, alpha, sine_off < 1e-4);
        // Below 1e-3 rad off the axis the numerators are of second order and consist of rounding errors only, so
        // the divisor is clamped.
        let per_sine = 1.0 / max(sine_off, 1e-3);
        expansion.terms = vec4f(alpha, beta, radius.z, (alpha * cosine - beta) * per_sine);
        expansion.mu = (alpha - beta * cosine) * per_sine;
        let turn = mat2x2f(azimuth, vec2f(-azimuth.y, azimuth.x));
        expansion.plane = linear(view_index) * turn;
        expansion.rows[0] = vec3f(cosine * azimuth, -sine_off) / distance_m;
        expansion.rows[1] = vec3f(-azimuth.y, azimuth.x, 0.0) / distance_m;
        expansion.rows[2] = point_m / (distance_m * distance_m);
        return expansion;
    }
    let slope = point_m.xy / point_m.z;
    expansion.terms = vec4f(1.0, 1.0, 0.0, 0.0);
    expansion.plane = linear(view_index);
    if model == OPENCV {
        expansion.plane *= jacobian(view_index, slope);
    }
    expansion.room = select(-1.0, end - length(slope), point_m.z > 0.0);
    expansion.rows[0] = vec3f(1.0, 0.0, -slope.x) / point_m.z;
    expansion.rows[1] = vec3f(0.0, 1.0, -slope.y) / point_m.z;
    expansion.rows[2] = vec3f(0.0, 0.0, 1.0 / point_m.z);
    return expansion;
}

// Value, first and second derivative of `c1 u + .. + c9 u^9`.
fn polynomial_and_derivatives(view_index: u32, u: f32) -> vec3f {
    let a = lenses[view_index].coefficients[0];
    let b = lenses[view_index].coefficients[1];
    let c = lenses[view_index].coefficients[2].x;
    let second = 2.0 * a.y + u * (6.0 * a.z + u * (12.0 * a.w + u * (20.0 * b.x
        + u * (30.0 * b.y + u * (42.0 * b.z + u * (56.0 * b.w + u * (72.0 * c)))))));
    return vec3f(polynomial(view_index, u), second);
}

// Derivatives of the refracted angles (h, v) by φ and by θ. The polynomials of a windshield give the change
// of the angles.
fn windshield_slopes(view_index: u32, at_rad: vec2f) -> mat2x2f {
    let c = lenses[view_index].windshield_shift;
    let x = at_rad.x;
    let y = at_rad.y;
    let row1 = c[6] + x * (c[7] + x * (c[8] + x * (c[9] + x * c[10])));
    let row2 = c[11] + x * (c[12] + x * (c[13] + x * c[14]));
    let row3 = c[15] + x * (c[16] + x * c[17]);
    let row4 = c[18] + x * c[19];
    let by_y = row1 + y * (2.0 * row2 + y * (3.0 * row3 + y * (4.0 * row4 + y * 5.0 * c[20])));
    let rise0 = c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5])));
    let rise1 = c[7] + x * (2.0 * c[8] + x * (3.0 * c[9] + x * 4.0 * c[10]));
    let rise2 = c[12] + x * (2.0 * c[13] + x * 3.0 * c[14]);
    let rise3 = c[16] + x * 2.0 * c[17];
    let by_x = rise0 + y * (rise1 + y * (rise2 + y * (rise3 + y * c[19])));
    return mat2x2f(vec2f(1.0, 0.0) + by_x, vec2f(0.0, 1.0) + by_y);
}

// The shutter around a point that was found at `center`; all 0 for a camera at rest.
fn shutter_terms(view_index: u32, expansion: Expansion, center: ProjectedPoint) -> ShutterTerms {
    let axis_angle = lenses[view_index].axis_angle;
    let moved_m = lenses[view_index].moved_m;
    let velocity_m = axis_angle.w * cross(axis_angle.xyz, center.point_m)
        + moved_m + rotation_shift(view_index, moved_m, center.fraction);
    var terms: ShutterTerms;
    terms.motion = components(expansion, velocity_m);
    terms.motion_px = first_order(expansion, terms.motion);
    let plane = lenses[view_index].remaining_exposure;
    terms.per_px = plane.xy / (1.0 - dot(plane.xy, terms.motion_px));
    let unclamped = dot(plane.xyz, vec3f(center.at_px, 1.0));
    terms.rolls = select(0.0, 1.0, unclamped > 0.0 && unclamped < 1.0);
    terms.to_limit = min(abs(unclamped), abs(1.0 - unclamped));
    return terms;
}

// Mean and root of the covariance by the expansion, and whether they are close enough to those of six points.
struct Expanded {
    close: bool,
    shift_px: vec2f,
    // Columns: of the axes, then of the terms of second order.
    root_px: array<vec2f, 6>,
}

// `axes_m` has a Gaussian's axes times their standard deviations, in the camera's frame at the end of the exposure.
fn expand_axes(view_index: u32, center: ProjectedPoint, axes_m: array<vec3f, 3>) -> Expanded {
    let bound = lenses[view_index].expansion;
    var expanded: Expanded;
    if bound.x <= 0.0 {
        return expanded;
    }
    var expansion = expand(view_index, center.point_m);
    let shutter = shutter_terms(view_index, expansion, center);
    for (var i = 0; i < 3; i++) {
        expansion.rows[i] += rotation_shift(view_index, expansion.rows[i], -center.fraction);
    }
    var square = 0.0;
    var longest2 = 0.0;
    var most_moment = 0.0;
    for (var axis = 0; axis < 3; axis++) {
        var abc = components(expansion, axes_m[axis]);
        let moment = dot(shutter.per_px, first_order(expansion, abc));
        abc += moment * shutter.rolls * shutter.motion;
        most_moment = max(most_moment, abs(moment));
        expanded.root_px[axis] = first_order(expansion, abc);
        var bend = second_order(expansion, abc);
        bend += dot(shutter.per_px, bend) * shutter.rolls * shutter.motion_px;
        expanded.root_px[axis + 3] = bend;
        expanded.shift_px += bend;
        square += dot(abc, abc);
        longest2 = max(longest2, dot(abc, abc));
    }
    for (var axis = 3; axis < 6; axis++) {
        expanded.root_px[axis] = ROOT_3 * expanded.root_px[axis] - expanded.shift_px / ROOT_3;
    }
    let longest = sqrt(longest2);
    let scale = max(max_component(vec3f(abs(expansion.plane[0]), 0.0)), max_component(vec3f(abs(expansion.plane[1]), 0.0)));
    let px_per_rad = max(abs(expansion.terms.x), abs(expansion.terms.y)) * scale;
    let beyond = max(ROOT_3 * most_moment - shutter.to_limit, 0.0);
    let shutter_px = px_per_rad * longest * lenses[view_index].axis_angle.w * most_moment
        + beyond * length(shutter.motion_px);
    let error_px = bound.y * square + bound.z * longest2 * longest + shutter_px;
    expanded.close = expansion.room >= 2.5 * longest && error_px <= bound.x;
    return expanded;
}
