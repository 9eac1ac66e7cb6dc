//! A cube map: six square grids of colours around the viewer, interpolated bilinearly.
//!
//! Faces are in the order +x, -x, +y, -y, +z, -z, with columns and rows as in OpenGL and most
//! files. x is right, y up, z ahead: in these left-handed axes, seen from inside, each face is
//! upright.

use glam::DVec3;

use super::SkyError;

/// Number of faces of a cube.
pub const FACES: usize = 6;

/// Six grids of `edge` x `edge` values.
///
/// A direction intersects the face of its largest component at `(s, t)` in [0, 1]², and the value
/// is looked up at `(scale s + offset, scale t + offset)`. Baked maps have values on the very
/// edges, shared by neighbouring faces. Images have values at pixel centres, and a border of one
/// value that is looked up from the neighbouring faces. So neither has a visible seam.
#[derive(Clone, Debug, PartialEq)]
pub struct CubeMap {
    edge: usize,
    scale: f64,
    offset: f64,
    error: f64,
    /// 16 bits each: red in the lower and green in the upper half of the first word, blue in the
    /// second.
    texels: Vec<[u32; 2]>,
}

impl CubeMap {
    /// Largest number of values along an edge of a baked map: 50 MB; a texel is 0.09° at the centre
    /// of a face.
    pub const MAX_EDGE: usize = 1025;

    /// Largest width of a face that is read from an image: 113 MB of texels, within the 128 MiB
    /// that any GPU allows per binding.
    pub const MAX_SIDE_PX: usize = 1536;

    /// Largest rounding error of a value in 16 bits.
    pub const STEP: f64 = 0.5 / 65_535.0;

    /// A map from six images of `side_px` x `side_px` pixels, `[face, row, column, 3]`: red, green,
    /// blue.
    ///
    /// # Errors
    /// The faces are empty or too large, or the number of bytes is wrong.
    pub fn from_faces(side_px: usize, rgb8: &[u8]) -> Result<Self, SkyError> {
        if !(1..=Self::MAX_SIDE_PX).contains(&side_px) {
            return Err(SkyError::Side { side_px });
        }
        let wanted = FACES * side_px * side_px * 3;
        let given = rgb8.len();
        if given != wanted {
            return Err(SkyError::Pixels { side_px, wanted, given });
        }
        let pixel = |face: usize, column: usize, row: usize| {
            let first = 3 * ((face * side_px + row) * side_px + column);
            DVec3::new(rgb8[first].into(), rgb8[first + 1].into(), rgb8[first + 2].into()) / 255.0
        };
        // A look-up within one face, whose outermost pixels extend to its edges.
        let clamped = |(face, [s, t]): (usize, [f64; 2])| {
            let last = side_px - 1;
            // From [0, 1] to pixel centres, which are at +0.5.
            let at = |x: f64| (x * side_px as f64 - 0.5).clamp(0.0, last as f64);
            let u = at(s);
            let v = at(t);
            let column = u as usize;
            let row = v as usize;
            let right = (column + 1).min(last);
            let below = (row + 1).min(last);
            let fu = u - column as f64;
            let fv = v - row as f64;
            let upper = pixel(face, column, row).lerp(pixel(face, right, row), fu);
            upper.lerp(pixel(face, column, below).lerp(pixel(face, right, below), fu), fv)
        };
        // A border of one texel on each side.
        let edge = side_px + 2;
        // Texel k is pixel k - 1, whose centre is at (k - 1 + 0.5) / side.
        let at = |k: usize| (k as f64 - 0.5) / side_px as f64;
        let mut texels = Vec::with_capacity(FACES * edge * edge);
        for face in 0..FACES {
            for row in 0..edge {
                for column in 0..edge {
                    let within = (1..=side_px).contains(&row) && (1..=side_px).contains(&column);
                    texels.push(packed(if within {
                        pixel(face, column - 1, row - 1)
                    } else {
                        // A texel of the border is beyond the edge of its face: its direction
                        // belongs to a neighbour.
                        clamped(cube_face(Self::direction(face, [at(column), at(row)])))
                    }));
                }
            }
        }
        Ok(Self { edge, scale: side_px as f64, offset: 0.5, error: 0.0, texels })
    }

    /// A map with the same colour everywhere.
    pub fn uniform(rgb: DVec3) -> Self {
        let texels = vec![packed(rgb); FACES * 4];
        Self { edge: 2, scale: 1.0, offset: 0.0, error: Self::STEP, texels }
    }

    /// A map from values at `i / (edge - 1)`, `[face, row, column]`; `error` is the bound of their
    /// error.
    pub(super) fn from_nodes(edge: usize, nodes: &[[f32; 3]], error: f64) -> Self {
        let texel = |rgb: &[f32; 3]| packed(DVec3::from_array(rgb.map(f64::from)));
        let texels = nodes.iter().map(texel).collect();
        Self { edge, scale: (edge - 1) as f64, offset: 0.0, error, texels }
    }

    /// The colour in [0, 1] along a direction of any length except 0.
    pub fn rgb(&self, direction: DVec3) -> DVec3 {
        let (face, [s, t]) = cube_face(direction);
        let u = self.scale * s + self.offset;
        let v = self.scale * t + self.offset;
        // The last cell begins one before the last node, so that `column + 1` exists, also for s =
        // 1.
        let last = self.edge - 2;
        let column = (u as usize).min(last);
        let row = (v as usize).min(last);
        let fu = u - column as f64;
        let fv = v - row as f64;
        let at = |column: usize, row: usize| {
            let [rg, b] = self.texels[(face * self.edge + row) * self.edge + column];
            DVec3::new((rg & 0xFFFF).into(), (rg >> 16).into(), b.into()) / 65_535.0
        };
        let upper = at(column, row).lerp(at(column + 1, row), fu);
        upper.lerp(at(column, row + 1).lerp(at(column + 1, row + 1), fu), fv)
    }

    /// The direction, not of unit length, of the point `[s, t]` of a face, from its left and top
    /// edges. Outside of [0, 1] the point is on the plane of the face.
    pub fn direction(face: usize, [s, t]: [f64; 2]) -> DVec3 {
        // From [0, 1] to [-1, 1]: a face is at distance 1 and has a half width of 1.
        let right = 2.0 * s - 1.0;
        let down = 2.0 * t - 1.0;
        match face {
            0 => DVec3::new(1.0, -down, -right),
            1 => DVec3::new(-1.0, -down, right),
            2 => DVec3::new(right, 1.0, down),
            3 => DVec3::new(right, -1.0, -down),
            4 => DVec3::new(right, -down, 1.0),
            _ => DVec3::new(-right, -down, -1.0),
        }
    }

    /// Number of values along an edge of a face.
    pub fn edge(&self) -> usize {
        self.edge
    }

    /// `[scale, offset]` of the look-up.
    pub fn lookup_scale_offset(&self) -> [f64; 2] {
        [self.scale, self.offset]
    }

    /// Bound of the error against the network that was baked; 0 for images.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// The values, `[face, row, column]`: red in the lower and green in the upper 16 bits of the
    /// first word, blue in the second.
    pub fn texels(&self) -> &[[u32; 2]] {
        &self.texels
    }

    /// Memory of the texels, in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.texels)
    }
}

fn packed(rgb: DVec3) -> [u32; 2] {
    // Clamped, because a network's rounding may leave [0, 1]; 65,535 is the largest of 16 bits.
    let [r, g, b] = rgb.to_array().map(|c| (c.clamp(0.0, 1.0) * 65_535.0).round() as u32);
    [r | g << 16, b]
}

/// The face that a direction intersects, and the point `[s, t]` in [0, 1], from its left and top
/// edges.
pub(super) fn cube_face(direction: DVec3) -> (usize, [f64; 2]) {
    let DVec3 { x, y, z } = direction;
    let [ax, ay, az] = direction.abs().to_array();
    // Ties go to x, then y: the edge of a cube belongs to one face. `ahead` is not 0 for a
    // direction of any length.
    let (face, right, down, ahead) = if ax >= ay && ax >= az {
        if x >= 0.0 { (0, -z, -y, ax) } else { (1, z, -y, ax) }
    } else if ay >= az {
        if y >= 0.0 { (2, x, z, ay) } else { (3, x, -z, ay) }
    } else if z >= 0.0 {
        (4, x, -y, az)
    } else {
        (5, -x, -y, az)
    };
    (face, [right, down].map(|slope| 0.5 * slope / ahead + 0.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn face_of_inverts_direction() {
        for face in 0..FACES {
            for [s, t] in [[0.5, 0.5], [0.1, 0.9], [0.99, 0.02]] {
                let (met, [u, v]) = cube_face(3.0 * CubeMap::direction(face, [s, t]));
                assert_eq!(met, face);
                assert!((u - s).abs() < 1e-15 && (v - t).abs() < 1e-15, "{face}: {u} {v}");
            }
        }
    }

    #[test]
    fn a_pixel_of_an_image_is_seen_where_it_lies() {
        let side = 4;
        let rgb8: Vec<u8> = (0..FACES * side * side * 3).map(|i| (i * 37 % 251) as u8).collect();
        let map = CubeMap::from_faces(side, &rgb8).unwrap();
        for face in 0..FACES {
            for (row, column) in [(0, 0), (3, 1), (2, 3)] {
                let at = |k: usize| (k as f64 + 0.5) / side as f64;
                let seen = map.rgb(CubeMap::direction(face, [at(column), at(row)]));
                let first = 3 * ((face * side + row) * side + column);
                for (c, seen) in seen.to_array().into_iter().enumerate() {
                    let truth = f64::from(rgb8[first + c]) / 255.0;
                    assert!((seen - truth).abs() < 1e-4, "{face} {row} {column}: {seen}, {truth}");
                }
            }
        }
    }

    #[test]
    fn faces_meet_without_a_seam() {
        // Values that change by at most 8 from pixel to pixel, across edges too: a smooth sky.
        let side = 32;
        let smooth = |d: DVec3| d.normalize().map(|c| 0.5 + 0.4 * (2.0 * c).sin());
        let mut rgb8 = Vec::new();
        for face in 0..FACES {
            for k in 0..side * side {
                let at = |k: usize| (k as f64 + 0.5) / side as f64;
                let rgb = smooth(CubeMap::direction(face, [at(k % side), at(k / side)]));
                rgb8.extend(rgb.to_array().map(|c| (255.0 * c).round() as u8));
            }
        }
        let map = CubeMap::from_faces(side, &rgb8).unwrap();
        let mut worst: f64 = 0.0;
        for i in 0..1000 {
            let along = f64::from(i) / 500.0 - 1.0;
            // Two directions on both sides of an edge, 1e-9 apart, must have nearly one colour.
            for (a, b) in [
                (DVec3::new(1.0, along, 1.0 - 1e-9), DVec3::new(1.0 - 1e-9, along, 1.0)),
                (DVec3::new(along, -1.0, 1.0 - 1e-9), DVec3::new(along, -1.0 + 1e-9, 1.0)),
            ] {
                worst = worst.max((map.rgb(a) - map.rgb(b)).abs().max_element());
            }
        }
        assert!(worst < 0.01, "{worst}");
    }

    #[test]
    fn faces_of_invalid_size_are_refused() {
        assert_eq!(CubeMap::from_faces(0, &[]), Err(SkyError::Side { side_px: 0 }));
        let side_px = CubeMap::MAX_SIDE_PX + 1;
        assert_eq!(CubeMap::from_faces(side_px, &[]), Err(SkyError::Side { side_px }));
        let short = CubeMap::from_faces(2, &[0; 71]);
        assert_eq!(short, Err(SkyError::Pixels { side_px: 2, wanted: 72, given: 71 }));
    }
}
