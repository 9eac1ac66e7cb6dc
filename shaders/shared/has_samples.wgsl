// Views whose pixels have 2 x 2 samples: their tiles are those of the samples.

// Whether a view of the frame may be one.
override SAMPLES: bool;

fn has_samples(view: u32) -> bool {
    return ((frame.sampled >> view) & 1u) == 1u;
}

// Samples of a pixel of a view along each axis.
fn samples(view: u32) -> f32 {
    return select(1.0, 2.0, SAMPLES && has_samples(view));
}
