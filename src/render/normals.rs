//! Which way the surfaces of a depth image face.
//!
//! Depth alone says so: neighbouring pixels are points of one surface, and the cross product of the ways
//! to them is perpendicular to it. So normals are the same function of the image in every backend, cost
//! nothing that is not asked for, and are as smooth as the depth is.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::View;

/// Of a plane, 1/depth is linear over a pinhole's image. What bends more than this share of itself within
/// three pixels is an edge: at 10 m a step of 10 cm, as a kerb is.
const EDGE: f64 = 0.01;

/// Rows that are one piece of work. The two around them are looked at twice: 3 % more.
const ROWS: usize = 64;

/// Unit normals `[height, width, 3]` in the axes of the camera at the end of its exposure (x right, y down,
/// z forward), on the side that is seen; 0 where there is no depth, or no neighbour with any.
///
/// `depth_m` is `[height, width]`, 0 where nothing is.
pub(super) fn write(view: &View, depth_m: &[f32], normals: &mut [f32]) {
    let (width, height) = (view.camera.width_px as usize, view.camera.height_px as usize);
    normals.par_chunks_mut(3 * width * ROWS).enumerate().for_each(|(band, normals)| {
        let first = band * ROWS;
        let points = |row: usize| points(view, depth_m, row);
        let mut above = first.checked_sub(1).map(points);
        let mut here = points(first);
        for (row, normals) in (first..).zip(normals.chunks_mut(3 * width)) {
            let below = (row + 1 < height).then(|| points(row + 1));
            for (x, normal) in normals.chunks_mut(3).enumerate() {
                let beside = |other: &Option<Vec<Option<Point>>>| other.as_ref().and_then(|o| o[x]);
                let left = x.checked_sub(1).and_then(|x| here[x]);
                let right = here.get(x + 1).copied().flatten();
                let facing = here[x].and_then(|point| {
                    let across = way(left, point, right)?;
                    let down = way(beside(&above), point, beside(&below))?;
                    let facing = down.cross(across).try_normalize()?;
                    Some(if facing.dot(point.ray) > 0.0 { -facing } else { facing })
                });
                normal.copy_from_slice(&facing.unwrap_or_default().as_vec3().to_array());
            }
            match below {
                Some(below) => above = Some(std::mem::replace(&mut here, below)),
                None => break,
            }
        }
    });
}

/// What a pixel shows.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// Where, in the camera's frame at the end of its exposure, in metres.
    at_m: DVec3,
    /// The direction in which it is seen.
    ray: DVec3,
    /// 1 / depth, in 1/m.
    nearness: f64,
}

/// What the pixels of a row show.
fn points(view: &View, depth_m: &[f32], row: usize) -> Vec<Option<Point>> {
    let width = view.camera.width_px as usize;
    let camera_from_world = view.world_from_camera.inverse();
    let point = |(x, &depth_m): (usize, &f32)| {
        let seen = depth_m > 0.0;
        if !seen {
            return None;
        }
        let depth_m = f64::from(depth_m);
        let at_px = DVec2::new(x as f64 + 0.5, row as f64 + 0.5);
        let direction = view.camera.unproject(at_px)?;
        let seen_m = direction * (depth_m / view.camera.depth_m(direction));
        let (at_m, ray) = match view.rolling_shutter {
            None => (seen_m, direction),
            Some(_) => {
                let camera_from_then = camera_from_world * view.world_from_camera_at(at_px);
                let ray = camera_from_then.rotation * direction;
                (camera_from_then.position_m + camera_from_then.rotation * seen_m, ray)
            }
        };
        Some(Point { at_m, ray, nearness: 1.0 / depth_m })
    };
    depth_m[row * width..][..width].iter().enumerate().map(point).collect()
}

/// The way along the surface, from one neighbour to the other, or to the one that is on the same surface.
fn way(before: Option<Point>, here: Point, after: Option<Point>) -> Option<DVec3> {
    let (to, from) = match (before, after) {
        (Some(before), Some(after)) => {
            let [back, forth] = [before, after].map(|other| other.nearness - here.nearness);
            if (back + forth).abs() <= EDGE * here.nearness {
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
