// Stage project for pinholes at rest: linearised at the centre.

// What is not in range has no shape, unless it was `decided` that it is.
fn project_shape(own: Geometry, view: ChunkView, decided: bool) -> Projected {
    // Camera space: in range?
    let mean = vec4f(own.mean_m, 1.0);
    let x = dot(view.camera_from_chunk[0], mean);
    let y = dot(view.camera_from_chunk[1], mean);
    let exact_m = exact_z(own.mean_m, view);
    let z = exact_m.x + exact_m.y;
    let in_range = z >= frame.near_m && z <= frame.far_m
        && own.log2_opacity >= frame.log2_alpha_cut;
    if !in_range && !decided {
        return Projected();
    }

    // V = J W R S, with J at the clamped slope. What is wider than f32 can square twice is computed in a
    // larger unit than the pixel, blur and all.
    let slope = vec2f(x, y) / z;
    let mean_px = view.focal_px * slope + view.center_px;
    let clamped = clamp(slope, view.slope_min, view.slope_max);
    let px_per_m = view.focal_px / z;
    let right = view.camera_from_chunk[0].xyz;
    let down = view.camera_from_chunk[1].xyz;
    let forward = view.camera_from_chunk[2].xyz;
    let rotation = rotation_from_quat(own.quat_wxyz);
    var v0 = ((right - clamped.x * forward) * px_per_m.x) * rotation * own.scale_m;
    var v1 = ((down - clamped.y * forward) * px_per_m.y) * rotation * own.scale_m;
    let widest = max(max_component(abs(v0)), max_component(abs(v1)));
    let per_px = min(MAX_SIGMA_PX / max(widest, 1e-30), 1.0);
    v0 *= per_px;
    v1 *= per_px;
    let minors = cross(v0, v1);
    let covariance = vec3f(dot(v0, v0), dot(v0, v1), dot(v1, v1));
    let foot = Footprint(mean_px, covariance, dot(minors, minors), per_px);
    var projected = shape_of(foot, own.log2_opacity, view.view);
    projected.depth_m = z;
    projected.toward_m = own.mean_m - view.camera_m;
    return projected;
}
