//! Surface normals of a depth image.
//!
//! Neighbouring pixels are points of one surface, and the cross product of the vectors between them
//! is perpendicular to it. So normals are the same function of the depth image in every backend,
//! cost nothing unless they are requested, and are as smooth as the depth. Rays are those of the
//! camera, with its lens and shutter.
//!
//! Blending the Gaussians' own axes would take three more sums in every backend's inner loop. On a
//! wall made of small discs, half of the pixels are within 0.2° behind a pinhole and 0.7° behind a
//! fisheye.
//!
//! Two neighbours belong to one surface if 1/depth changes linearly, as it does on every plane. So
//! an edge between two surfaces is not mistaken for a slope.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::View;

/// The largest second difference of 1/depth over three pixels, as a share of it, that is not an
/// edge. 1/depth of a plane is linear over a pinhole's image; at 10 m this is a step of 10 cm, such
/// as a kerb.
const EDGE_SHARE: f64 = 0.01;

/// Rows of one parallel job. The points of the two rows around them are computed twice: 3 % more
/// work.
const ROWS: usize = 64;

/// Writes unit normals `[height, width, 3]` in the axes of the camera at the end of its exposure (x
/// right, y down, z forward), towards the camera; 0 where a pixel has no depth.
///
/// A pixel without a neighbour to compare with, in its row or in its column, does not show how its
/// surface is inclined in that direction. The surface is then taken as facing the camera there.
///
/// `depth_m` is `[height, width]`, 0 where there is no surface.
pub(super) fn write(view: &View, depth_m: &[f32], normals: &mut [f32]) {
    let width = view.camera.width_px as usize;
    let height = view.camera.height_px as usize;
    // Each band owns its rows of the output and reads all of the depths.
    normals.par_chunks_mut(3 * width * ROWS).enumerate().for_each(|(band, normals)| {
        let first = band * ROWS;
        // Points of three rows, which move down by one each time.
        let points = |row: usize| points(view, depth_m, row);
        let mut above = first.checked_sub(1).map(points);
        let mut here = points(first);
        for (row, normals) in (first..).zip(normals.chunks_mut(3 * width)) {
            let below = (row + 1 < height).then(|| points(row + 1));
            for (x, normal) in normals.chunks_mut(3).enumerate() {
                let column_of =
                    // Above the first row and below the last there are no points.
                    |other: &Option<Vec<Option<Point>>>| other.as_ref().and_then(|o| o[x]);
                let left = x.checked_sub(1).and_then(|x| here[x]);
                let right = here.get(x + 1).copied().flatten();
                let normal_here = here[x].map(|point| {
                    let across = tangent(left, point, right);
                    let down = tangent(column_of(&above), point, column_of(&below));
                    let of_plane = match (across, down) {
                        // y x x points to -z: towards the camera, for a surface that faces it.
                        (Some(across), Some(down)) => down.cross(across).try_normalize(),
                        (Some(one), None) | (None, Some(one)) => perpendicular(point.ray, one),
                        (None, None) => None,
                    };
                    let facing = of_plane.unwrap_or_else(|| -point.ray.normalize_or_zero());
                    // Take the normal that points towards the camera.
                    if facing.dot(point.ray) > 0.0 { -facing } else { facing }
                });
                normal.copy_from_slice(&normal_here.unwrap_or_default().as_vec3().to_array());
            }
            match below {
                // Every row's points are computed once per band.
                Some(below) => above = Some(std::mem::replace(&mut here, below)),
                None => break,
            }
        }
    });
}

/// The point of a surface that a pixel shows.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// In the camera's frame at the end of its exposure, in metres.
    at_m: DVec3,
    /// The direction from the camera, when the pixel is exposed, to the point.
    ray: DVec3,
    /// 1 / depth, in 1/m.
    inverse_depth: f64,
}

/// The points of a row of pixels; `None` where there is no depth.
fn points(view: &View, depth_m: &[f32], row: usize) -> Vec<Option<Point>> {
    let width = view.camera.width_px as usize;
    let camera_from_world = view.world_from_camera.inverse();
    let point = |(x, &depth_m): (usize, &f32)| {
        let has_depth = depth_m > 0.0;
        if !has_depth {
            return None;
        }
        let depth_m = f64::from(depth_m);
        let at_px = DVec2::new(x as f64 + 0.5, row as f64 + 0.5);
        let direction = view.camera.unproject(at_px)?;
        // Scaled so that the point has this depth, be it z or the distance.
        let at_exposure_m = direction * (depth_m / view.camera.depth_m(direction));
        let (at_m, ray) = match view.rolling_shutter {
            None => (at_exposure_m, direction),
            Some(_) => {
                let end_from_exposure = camera_from_world * view.world_from_camera_at(at_px);
                let ray = end_from_exposure.rotation * direction;
                (end_from_exposure.transform_point(at_exposure_m), ray)
            }
        };
        Some(Point { at_m, ray, inverse_depth: 1.0 / depth_m })
    };
    depth_m[row * width..][..width].iter().enumerate().map(point).collect()
}

/// The unit vector perpendicular to a vector along the surface that is closest to the ray's line.
/// `None` if the surface is along the ray.
fn perpendicular(ray: DVec3, along: DVec3) -> Option<DVec3> {
    let along = along.try_normalize()?;
    (ray - along * ray.dot(along)).try_normalize()
}

/// A vector along the surface: from one neighbour to the other, or between the pixel and the
/// neighbour that is on the same surface.
fn tangent(before: Option<Point>, here: Point, after: Option<Point>) -> Option<DVec3> {
    let (to, from) = match (before, after) {
        (Some(before), Some(after)) => {
            let [back, forth] =
                // On a plane the two differences cancel, as 1/depth is linear along a row.
                [before, after].map(|other| other.inverse_depth - here.inverse_depth);
            // All three on one surface; else on that of the neighbour with the closer depth.
            if (back + forth).abs() <= EDGE_SHARE * here.inverse_depth {
                (after, before)
            } else if forth.abs() <= back.abs() {
                (after, here)
            } else {
                (here, before)
            }
        }
        (None, Some(after)) => (after, here),
        (Some(before), None) => (here, before),
        (None, None) => return None,
    };
    Some(to.at_m - from.at_m)
}
