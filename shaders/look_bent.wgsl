// Where pixels look if some view has a lens or a rolling shutter: each finds its own way back through it.

#import lens

fn look(of_view: u32, at_px: vec2f) -> Away {
    if lenses[of_view].bent == 0u {
        return by_matrix(of_view, at_px);
    }
    // Of such views, the rows take directions in the camera's frame to the sky's axes.
    let rows = behind.sky_from_pixel[of_view];
    var away: Away;
    for (var k = 0u; k < 4u; k++) {
        let own_px = at_px + vec2f(f32(k), 0.0);
        let then = unproject(of_view, own_px);
        let ray = then + turning(of_view, then, -still_to_come(of_view, own_px));
        away.x[k] = dot(rows[0].xyz, ray);
        away.y[k] = dot(rows[1].xyz, ray);
        away.z[k] = dot(rows[2].xyz, ray);
    }
    return away;
}
