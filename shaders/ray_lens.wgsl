// Directions of pixels, for frames in which some view has a lens or a rolling shutter: each pixel
// inverts the lens model itself. A table of directions would take 16 B per pixel and camera, 107 MB for
// six full images, and would have to be computed again whenever a camera changes.

#import lens

fn sky_rays(view_index: u32, at_px: vec2f) -> Rays {
    if lenses[view_index].non_pinhole == 0u {
        return pinhole_rays(view_index, at_px);
    }
    // For these views the rows transform directions from the camera's frame at the end of the exposure
    // to the sky's axes.
    let rows = background.sky_from_pixel[view_index];
    var directions: Rays;
    for (var k = 0u; k < 4u; k++) {
        // A view of samples has the lens of these.
        let pixel_px = (at_px + vec2f(f32(k), 0.0)) * samples(view_index);
        let in_camera = unproject(view_index, pixel_px);
        let ray = in_camera + rotation_shift(view_index, in_camera, -remaining_exposure(view_index, pixel_px));
        directions.x[k] = dot(rows[0].xyz, ray);
        directions.y[k] = dot(rows[1].xyz, ray);
        directions.z[k] = dot(rows[2].xyz, ray);
    }
    return directions;
}
