// Stage resolve, first part, for frames without a background and without exposures or overlays: the
// sums stay as they are. The other choice is `background.wgsl`.

fn composite(sums: Sums, view: u32, at_px: vec2f, thread: u32) -> Sums {
    return sums;
}
