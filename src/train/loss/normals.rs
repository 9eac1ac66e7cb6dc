//! The normals of the expected depth against given ones.
//!
//! The point of a pixel is its ray times its expected depth. The normal of a pixel is the cross
//! product of the differences of the points to its left and right, and above and below: the normal
//! of the surface that these four pixels show.

use super::Real;
use super::depth::{DepthLoss, LEAST_OPACITY};

/// The mean of `1 - n · given` over the pixels that have four neighbours with depths, and a given
/// normal (0, 0, 0 is none).
///
/// `rays` are those of the pixels' centres in the camera's axes, scaled so that a ray times a depth
/// is the point: with z = 1 for cameras whose depth is z. Given normals are unit vectors in the
/// camera's axes that point towards the camera.
pub fn normals<T: Real>(
    size_px: [usize; 2],
    rays: &[[T; 3]],
    opacity: &[T],
    depth_sum_m: &[T],
    given: &[[T; 3]],
) -> DepthLoss<T> {
    let [width, height] = size_px;
    let least = T::from_f64(LEAST_OPACITY);
    let mut loss = DepthLoss {
        value: 0.0,
        by_opacity: vec![T::zero(); opacity.len()],
        by_depth_sum: vec![T::zero(); opacity.len()],
        pixels: 0,
    };
    let mut by_depth = vec![T::zero(); opacity.len()];
    let has_depth = |i: usize| opacity[i] > least && depth_sum_m[i] > T::zero();
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            // Left, right, above, below.
            let around = [i - 1, i + 1, i - width, i + width];
            let is_given = given[i].iter().any(|&value| value != T::zero());
            if !is_given || !around.iter().all(|&k| has_depth(k)) {
                continue;
            }
            let points = around.map(|k| scaled(rays[k], depth_sum_m[k] / opacity[k]));
            let across = minus(points[1], points[0]);
            let down = minus(points[3], points[2]);
            // Towards the camera: x to the right, y down, z ahead.
            let normal = cross(down, across);
            let length = dot(normal, normal).sqrt();
            if length == T::zero() {
                continue;
            }
            let unit = scaled(normal, T::one() / length);
            let cosine = dot(unit, given[i]);
            loss.value += 1.0 - cosine.to_double();
            loss.pixels += 1;
            // d(n/|n|) = (I - n nᵀ)/|n|; and of c = a × b, v_a = b × v_c and v_b = v_c × a.
            let by_normal = scaled(minus(scaled(unit, cosine), given[i]), T::one() / length);
            let by_down = cross(across, by_normal);
            let by_across = cross(by_normal, down);
            for (k, by_point) in [(0, by_across), (1, by_across), (2, by_down), (3, by_down)] {
                let sign = if k % 2 == 0 { -T::one() } else { T::one() };
                by_depth[around[k]] += sign * dot(by_point, rays[around[k]]);
            }
        }
    }
    // Known only now: pixels without a normal do not count.
    let share = T::from_f64(1.0 / loss.pixels.max(1) as f64);
    loss.value *= share.to_double();
    for (i, &by) in by_depth.iter().enumerate() {
        if by != T::zero() {
            // Of the expected depth D/A.
            let by = by * share / opacity[i];
            loss.by_depth_sum[i] = by;
            loss.by_opacity[i] = -by * depth_sum_m[i] / opacity[i];
        }
    }
    loss
}

pub(super) fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn scaled<T: Real>(a: [T; 3], by: T) -> [T; 3] {
    a.map(|value| value * by)
}

fn minus<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
