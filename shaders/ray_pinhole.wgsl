// Directions of pixels, for frames in which every view is a static pinhole camera: one matrix per view.

fn sky_rays(of_view: u32, at_px: vec2f) -> Rays {
    return pinhole_rays(of_view, at_px);
}
