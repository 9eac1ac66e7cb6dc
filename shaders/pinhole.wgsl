// Stage project for static pinhole cameras: the projection is linearised at the Gaussian's centre (EWA
// splatting). The other choice of `PROJECTION` is `unscented.wgsl`.

// The splat of a Gaussian. A Gaussian that is out of range is returned as not visible, unless `decided`: then
// `cull` has already found it visible, and the range is not tested again. The pipeline `project` may round
// differently, and its splats must be those that `cull` counted.
fn project_shape(gaussian: Geometry, view: ChunkView, decided: bool) -> Projected {
    // Camera space, in metres: reject what is too near, too far, or too transparent.
    let mean = vec4f(gaussian.mean_m, 1.0);
    let x = dot(view.camera_from_chunk[0], mean);
    let y = dot(view.camera_from_chunk[1], mean);
    let exact_m = exact_z(gaussian.mean_m, view);
    let z = exact_m.x + exact_m.y;
    let in_range = z >= frame.near_m && z <= frame.far_m
        && gaussian.log2_opacity >= frame.log2_alpha_cut;
    if !in_range && !decided {
        return Projected();
    }

    // V = J W R S, with the Jacobian J at the clamped slope; the covariance is V V^T. A splat wider than
    // MAX_SIGMA_PX is computed in a unit larger than a pixel, since the determinant is of fourth order
    // and would overflow f32.
    let slope = vec2f(x, y) / z;
    let mean_px = view.focal_px * slope + view.center_px;
    let clamped = clamp(slope, view.slope_min, view.slope_max);
    let px_per_m = view.focal_px / z;
    let right = view.camera_from_chunk[0].xyz;
    let down = view.camera_from_chunk[1].xyz;
    let forward = view.camera_from_chunk[2].xyz;
    let rotation = rotation_from_quat(gaussian.quat_wxyz);
    var v0 = ((right - clamped.x * forward) * px_per_m.x) * rotation * gaussian.scale_m;
    var v1 = ((down - clamped.y * forward) * px_per_m.y) * rotation * gaussian.scale_m;
    let widest = max(max_component(abs(v0)), max_component(abs(v1)));
    let units_per_px = min(MAX_SIGMA_PX / max(widest, 1e-30), 1.0);
    v0 *= units_per_px;
    v1 *= units_per_px;
    let minors = cross(v0, v1);
    let covariance = vec3f(dot(v0, v0), dot(v0, v1), dot(v1, v1));
    let foot = Footprint(mean_px, covariance, dot(minors, minors), units_per_px);
    var projected = splat_shape(foot, gaussian.log2_opacity, index_of_view(view));
    projected.depth_m = z;
    projected.from_camera_m = gaussian.mean_m - view.camera_m;
    return projected;
}
