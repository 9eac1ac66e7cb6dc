// Where pixels look if every view is a pinhole at rest: a matrix knows.

fn look(of_view: u32, at_px: vec2f) -> Away {
    return by_matrix(of_view, at_px);
}
