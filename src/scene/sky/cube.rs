//! A cube map: six square grids of colours around the viewer.
//!
//! Faces are in the order +x, -x, +y, -y, +z, -z, their columns and rows as OpenGL and most files have
//! them. x is right, y up, z ahead: in these left-handed axes, seen from within, each face is upright. Between the values of a grid, colours are
//! bilinear.

use glam::DVec3;

use super::SkyError;

/// Faces of a cube.
pub const FACES: usize = 6;

/// Six grids of `edge` x `edge` values.
///
/// A direction whose largest component is that of a face meets it at `(s, t)` in [0, 1]², and looks up
/// the value at `(scale s + offset, scale t + offset)`. What was baked has values on the very edges,
/// which neighbours share; images have values in the middle of their pixels, and one more all around
/// that is looked up from the neighbours. So no seam is to be seen in either.
#[derive(Clone, Debug, PartialEq)]
pub struct CubeMap {
    edge: usize,
    scale: f64,
    offset: f64,
    error: f64,
    /// 16 bits each of red, green; and of blue.
    texels: Vec<[u32; 2]>,
}

impl CubeMap {
    /// Most values along an edge of what is baked: 50 MB, and a texel is 0.09° in the middle of a face.
    pub const MAX_EDGE: usize = 1025;

    /// Widest face of images: 113 MB of texels, within the 128 MiB that a binding of any GPU holds.
    pub const MAX_SIDE_PX: usize = 1536;

    /// How far 16 bits are off at most.
    pub const STEP: f64 = 0.5 / 65_535.0;

    /// From six images of `side_px` x `side_px` pixels of RGB, face by face, row by row.
    ///
    /// # Errors
    /// The faces are empty or too large, or there are not as many pixels.
    pub fn from_faces(side_px: usize, rgb8: &[u8]) -> Result<Self, SkyError> {
        if !(1..=Self::MAX_SIDE_PX).contains(&side_px) {
            return Err(SkyError::Side { side_px });
        }
        let (wanted, given) = (FACES * side_px * side_px * 3, rgb8.len());
        if given != wanted {
            return Err(SkyError::Pixels { side_px, wanted, given });
        }
        let pixel = |face: usize, column: usize, row: usize| {
            let first = 3 * ((face * side_px + row) * side_px + column);
            DVec3::new(rgb8[first].into(), rgb8[first + 1].into(), rgb8[first + 2].into()) / 255.0
        };
        // Within a face alone, its outermost pixels going on to its edges.
        let clamped = |(face, [s, t]): (usize, [f64; 2])| {
            let last = side_px - 1;
            let at = |x: f64| (x * side_px as f64 - 0.5).clamp(0.0, last as f64);
            let (u, v) = (at(s), at(t));
            let (column, row) = (u as usize, v as usize);
            let (right, below) = ((column + 1).min(last), (row + 1).min(last));
            let (fu, fv) = (u - column as f64, v - row as f64);
            let upper = pixel(face, column, row).lerp(pixel(face, right, row), fu);
            upper.lerp(pixel(face, column, below).lerp(pixel(face, right, below), fu), fv)
        };
        let edge = side_px + 2;
        let at = |k: usize| (k as f64 - 0.5) / side_px as f64;
        let mut texels = Vec::with_capacity(FACES * edge * edge);
        for face in 0..FACES {
            for row in 0..edge {
                for column in 0..edge {
                    let within = (1..=side_px).contains(&row) && (1..=side_px).contains(&column);
                    texels.push(packed(if within {
                        pixel(face, column - 1, row - 1)
                    } else {
                        clamped(face_of(Self::direction(face, [at(column), at(row)])))
                    }));
                }
            }
        }
        Ok(Self { edge, scale: side_px as f64, offset: 0.5, error: 0.0, texels })
    }

    /// The same colour everywhere.
    pub fn uniform(rgb: DVec3) -> Self {
        let texels = vec![packed(rgb); FACES * 4];
        Self { edge: 2, scale: 1.0, offset: 0.0, error: Self::STEP, texels }
    }

    /// From values at `i / (edge - 1)`, face by face, row by row; `error` is how far off they are.
    pub(super) fn from_nodes(edge: usize, nodes: &[[f32; 3]], error: f64) -> Self {
        let texel = |rgb: &[f32; 3]| packed(DVec3::from_array(rgb.map(f64::from)));
        let texels = nodes.iter().map(texel).collect();
        Self { edge, scale: (edge - 1) as f64, offset: 0.0, error, texels }
    }

    /// The colour towards a direction of any length but 0, in [0, 1].
    pub fn rgb(&self, direction: DVec3) -> DVec3 {
        let (face, [s, t]) = face_of(direction);
        let (u, v) = (self.scale * s + self.offset, self.scale * t + self.offset);
        let last = self.edge - 2;
        let (column, row) = ((u as usize).min(last), (v as usize).min(last));
        let (fu, fv) = (u - column as f64, v - row as f64);
        let at = |column: usize, row: usize| {
            let [rg, b] = self.texels[(face * self.edge + row) * self.edge + column];
            DVec3::new((rg & 0xFFFF).into(), (rg >> 16).into(), b.into()) / 65_535.0
        };
        let upper = at(column, row).lerp(at(column + 1, row), fu);
        upper.lerp(at(column, row + 1).lerp(at(column + 1, row + 1), fu), fv)
    }

    /// The direction, not of unit length, in which a face has the point `[s, t]`, from the left and from
    /// the top; beyond [0, 1] the face's plane goes on.
    pub fn direction(face: usize, [s, t]: [f64; 2]) -> DVec3 {
        let (right, down) = (2.0 * s - 1.0, 2.0 * t - 1.0);
        match face {
            0 => DVec3::new(1.0, -down, -right),
            1 => DVec3::new(-1.0, -down, right),
            2 => DVec3::new(right, 1.0, down),
            3 => DVec3::new(right, -1.0, -down),
            4 => DVec3::new(right, -down, 1.0),
            _ => DVec3::new(-right, -down, -1.0),
        }
    }

    /// Values along an edge of a face.
    pub fn edge(&self) -> usize {
        self.edge
    }

    /// `[scale, offset]` of the look-up.
    pub fn lookup_scale_offset(&self) -> [f64; 2] {
        [self.scale, self.offset]
    }

    /// How far it is off what it was baked from, at most; 0 of images.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// The values, `[face, row, column]`: red in the lower and green in the upper 16 bits, and blue.
    pub fn texels(&self) -> &[[u32; 2]] {
        &self.texels
    }

    /// Memory that it takes, in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.texels)
    }
}

fn packed(rgb: DVec3) -> [u32; 2] {
    let [r, g, b] = rgb.to_array().map(|c| (c.clamp(0.0, 1.0) * 65_535.0).round() as u32);
    [r | g << 16, b]
}

/// The face that a direction meets, and where: `[s, t]` in [0, 1], from the left and from the top.
pub(super) fn face_of(direction: DVec3) -> (usize, [f64; 2]) {
    let DVec3 { x, y, z } = direction;
    let [ax, ay, az] = direction.abs().to_array();
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
    fn a_face_and_back() {
        for face in 0..FACES {
            for [s, t] in [[0.5, 0.5], [0.1, 0.9], [0.99, 0.02]] {
                let (met, [u, v]) = face_of(3.0 * CubeMap::direction(face, [s, t]));
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
    fn faces_of_absurd_size_are_refused() {
        assert_eq!(CubeMap::from_faces(0, &[]), Err(SkyError::Side { side_px: 0 }));
        let side_px = CubeMap::MAX_SIDE_PX + 1;
        assert_eq!(CubeMap::from_faces(side_px, &[]), Err(SkyError::Side { side_px }));
        let short = CubeMap::from_faces(2, &[0; 71]);
        assert_eq!(short, Err(SkyError::Pixels { side_px: 2, wanted: 72, given: 71 }));
    }
}
