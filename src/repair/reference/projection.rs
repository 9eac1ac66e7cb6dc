//! The projection of a camera in f32, 16 points at a time.
//!
//! A pinhole is projected as it is. All other lenses, and windshields, are a table of the pixels of
//! directions, which is interpolated. Its axes are the direction's stereographic projection: smooth
//! up to 180° off the axis, and without a trigonometric function. With 512 cells across 160° of a
//! lens of 700 px per radian the error is 0.002 px.

use glam::{DVec2, DVec3};

use wildcity_scene::geometry::Camera;

use super::lanes::LANES;

/// Cells of a table along each axis.
const CELLS: usize = 512;

/// Margin of a table around the image, in radians: the largest deflection by a windshield.
const MARGIN_RAD: f64 = 0.1;

/// Largest angle of a table, in radians off the axis.
const WIDEST_RAD: f64 = 2.9;

/// The projection of a camera, for [`super::warp`].
#[derive(Debug)]
pub struct Projection {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Whether its depth is the distance and not z.
    pub(super) depth_is_distance: bool,
    lens: Lens,
}

#[derive(Debug)]
enum Lens {
    /// fx, fy, cx, cy in pixels.
    Pinhole([f32; 4]),
    Table(Table),
}

/// Pixels of directions on a grid, for lenses other than the pinhole.
#[derive(Debug)]
struct Table {
    /// Cells per unit of the stereographic plane, which has `CELLS` / 2 cells in each direction.
    cells_per_unit: f32,
    /// `CELLS + 1` rows of as many positions, in pixels.
    at_px: Vec<[f32; 2]>,
}

/// Points in the axes of the camera, in metres, one per lane.
pub(super) struct Points {
    pub(super) x: [f32; LANES],
    pub(super) y: [f32; LANES],
    pub(super) z: [f32; LANES],
    /// Distances from the camera.
    pub(super) distance: [f32; LANES],
}

/// Positions on the image, in pixels; NaN behind a pinhole, and where a table ends.
pub(super) struct Positions {
    pub(super) u: [f32; LANES],
    pub(super) v: [f32; LANES],
}

impl Projection {
    /// The projection of a camera. For a non-pinhole camera, this fills a table of 513 x 513
    /// directions, in about 10 ms.
    pub fn from_camera(camera: &Camera) -> Self {
        let pinhole = &camera.pinhole;
        let lens = if camera.is_pinhole() {
            Lens::Pinhole(
                [pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy].map(|value| value as f32),
            )
        } else {
            Lens::Table(Table::from_camera(camera))
        };
        Self {
            width: camera.width_px as usize,
            height: camera.height_px as usize,
            depth_is_distance: camera.depth_is_distance(),
            lens,
        }
    }

    /// Projects points. With a table, only the points that are wanted get a position.
    #[inline(always)]
    pub(super) fn project(&self, points: &Points, is_wanted: &[bool; LANES]) -> Positions {
        let mut at = Positions { u: [f32::NAN; LANES], v: [f32::NAN; LANES] };
        match &self.lens {
            Lens::Pinhole([fx, fy, cx, cy]) => {
                for lane in 0..LANES {
                    let z = points.z[lane];
                    // A NaN fails every comparison with the image's edges, so that no branch is
                    // needed later.
                    let inverse = if z > 0.0 { z.recip() } else { f32::NAN };
                    at.u[lane] = fx * points.x[lane] * inverse + cx;
                    at.v[lane] = fy * points.y[lane] * inverse + cy;
                }
            }
            Lens::Table(table) => table.project(points, is_wanted, &mut at),
        }
        at
    }
}

impl Table {
    fn from_camera(camera: &Camera) -> Self {
        // The image's corner and what a windshield may add. 2.9 rad are 166 degrees, where the
        // plane's radius is tan(1.45) = 8.2.
        let widest_rad = (camera.corner_rad() + MARGIN_RAD).min(WIDEST_RAD);
        let reach = (0.5 * widest_rad).tan();
        // The table is a square from -reach to reach along both axes.
        let step = 2.0 * reach / CELLS as f64;
        let mut at_px = Vec::with_capacity((CELLS + 1) * (CELLS + 1));
        for row in 0..=CELLS {
            for column in 0..=CELLS {
                let plane = DVec2::new(column as f64, row as f64) * step - reach;
                let squared = plane.length_squared();
                // The inverse of the stereographic projection: with s = |plane|^2 the unit vector
                // is (2 x, 2 y, 1 - s)/(1 + s).
                let direction = DVec3::new(2.0 * plane.x, 2.0 * plane.y, 1.0 - squared);
                let at = camera.project_extrapolated(direction / (1.0 + squared));
                at_px.push([at.x as f32, at.y as f32]);
            }
        }
        Self { cells_per_unit: step.recip() as f32, at_px }
    }

    #[inline(always)]
    fn project(&self, points: &Points, is_wanted: &[bool; LANES], at: &mut Positions) {
        let middle = (CELLS / 2) as f32;
        for (lane, is_wanted) in is_wanted.iter().enumerate() {
            // (x, y)/(|p| + z) is the tangent of half the angle off the axis, away from it.
            let by = self.cells_per_unit / (points.distance[lane] + points.z[lane]);
            let column = points.x[lane] * by + middle;
            let row = points.y[lane] * by + middle;
            let last = CELLS as f32;
            // A NaN lies in no cell.
            let is_within = column >= 0.0 && row >= 0.0 && column < last && row < last;
            if !is_within || !is_wanted {
                continue;
            }
            let left = column as usize;
            let top = row as usize;
            let x = column - left as f32;
            let y = row - top as f32;
            // A row has one node more than it has cells; `last` is excluded above, so that
            // node + 1 exists.
            let first = top * (CELLS + 1) + left;
            let upper = [self.at_px[first], self.at_px[first + 1]];
            let lower = [self.at_px[first + CELLS + 1], self.at_px[first + CELLS + 2]];
            let mix = |axis: usize| {
                let above = upper[0][axis] + x * (upper[1][axis] - upper[0][axis]);
                let below = lower[0][axis] + x * (lower[1][axis] - lower[0][axis]);
                above + y * (below - above)
            };
            at.u[lane] = mix(0);
            at.v[lane] = mix(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::geometry::camera::{Fisheye, Lens as SceneLens, OpenCv, Pinhole};

    fn non_pinhole(lens: SceneLens) -> Camera {
        let pinhole = Pinhole { fx: 420.0, fy: 430.0, cx: 400.0, cy: 240.0 };
        Camera { lens, ..Camera::from_pinhole(800, 480, pinhole) }
    }

    #[test]
    fn a_table_is_the_lens_within_a_hundredth_of_a_pixel() {
        let fisheye = SceneLens::Fisheye(Fisheye::new([0.02, -0.01, 0.0, 0.0], None));
        let opencv = SceneLens::opencv(OpenCv::new(
            [-0.2, 0.05, 0.0, 0.0, 0.0, 0.0],
            [1e-3, -2e-3],
            [0.0; 4],
        ));
        for camera in [non_pinhole(fisheye), non_pinhole(opencv), non_pinhole(SceneLens::Pinhole)] {
            let projection = Projection::from_camera(&camera);
            let mut seen = 0;
            for step in 0..400 {
                // 2.4 rad are the golden angle: directions are spread over all azimuths.
                let angle = f64::from(step) * 2.4;
                let off_rad = f64::from(step) / 400.0 * 0.9;
                let direction = DVec3::new(
                    off_rad.sin() * angle.cos(),
                    off_rad.sin() * angle.sin(),
                    off_rad.cos(),
                );
                let point = 7.0 * direction;
                let Some(exact) = camera.project(point) else { continue };
                let lanes = |value: f64| [value as f32; LANES];
                let points = Points {
                    x: lanes(point.x),
                    y: lanes(point.y),
                    z: lanes(point.z),
                    distance: lanes(7.0),
                };
                let at = projection.project(&points, &[true; LANES]);
                let [u, v] = [at.u[3], at.v[3]].map(f64::from);
                // Only directions beyond the table have no place.
                if u.is_nan() {
                    assert!(off_rad > 0.8, "{off_rad} rad off the axis is within the image");
                    continue;
                }
                let error_px = (DVec2::new(u, v) - exact).length();
                assert!(error_px < 0.01, "{error_px} px at {off_rad} rad: {camera:?}");
                seen += 1;
            }
            assert!(seen > 300, "{seen} directions");
        }
    }
}
