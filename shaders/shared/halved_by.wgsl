// The splats that bring the transmittance of a thread's four pixels to a half or less.

// Index in the tile's list, plus 1, of the splat that halves the transmittance; 0 if none has.
var<private> halved_by: vec4u;

// Records the splat with this index if it brings the transmittance of pixels to a half or less.
fn note_owner(list_index: u32, before: vec4f, after: vec4f, counts: vec4<bool>) {
    let halves = counts & (before > vec4f(0.5)) & (after <= vec4f(0.5));
    halved_by = select(halved_by, vec4u(list_index + 1u), halves);
}

// Takes over what another kernel has recorded.
fn set_owners(list_indices: vec4u) {
    halved_by = list_indices;
}
