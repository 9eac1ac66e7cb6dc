//! What a run begins with: a Gaussian for each point of a capture or a LiDAR.

use glam::DVec3;
use rayon::prelude::*;

use wildcity_scene::{Gaussians, sh};

/// A point with its colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    pub at_m: DVec3,
    /// Red, green and blue, 0 to 1.
    pub rgb: [f64; 3],
}

/// Opacity of a Gaussian at the start, as in gsplat.
const OPACITY: f32 = 0.1;

/// Neighbours whose mean distance is the size of a Gaussian.
const NEIGHBOURS: usize = 3;

/// A ball for each point, as large as the mean distance of its three nearest neighbours.
pub fn gaussians_from_points(points: &[Point]) -> Gaussians {
    let mut order: Vec<usize> = (0..points.len()).collect();
    let at_m: Vec<DVec3> = points.iter().map(|point| point.at_m).collect();
    arrange(&mut order, &at_m, 0);
    let sizes_m: Vec<f64> =
        at_m.par_iter().map(|at_m_of_one| size_m(&order, &at_m, *at_m_of_one)).collect();
    let mut gaussians = Gaussians::with_capacity(0, points.len());
    for (point, size_m) in points.iter().zip(sizes_m) {
        gaussians.means_m.push(point.at_m.to_array());
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([size_m.ln() as f32; 3]);
        gaussians.logit_opacities.push((OPACITY / (1.0 - OPACITY)).ln());
        // The colour of degree 0 is 0.5 + C0 times the coefficient.
        gaussians.sh.extend(point.rgb.map(|value| ((value - 0.5) / sh::C0) as f32));
    }
    gaussians
}

/// The mean distance of the three nearest points to one of them. Points in one place, and a point
/// alone, get 1 mm.
fn size_m(order: &[usize], at_m: &[DVec3], center_m: DVec3) -> f64 {
    // One more: the point itself is its own neighbour.
    let mut nearest2 = [f64::INFINITY; NEIGHBOURS + 1];
    find_nearest(order, at_m, 0, center_m, &mut nearest2);
    let others = nearest2[1..].iter().filter(|d| d.is_finite()).map(|d| d.sqrt());
    let count = others.clone().count().max(1) as f64;
    (others.sum::<f64>() / count).max(1e-3)
}

/// Arranges points as a tree (Bentley 1975): the middle one has those below it along an axis on its
/// left and the others on its right, and so has each half along the next axis.
fn arrange(order: &mut [usize], at_m: &[DVec3], axis: usize) {
    if order.len() < 2 {
        return;
    }
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |&a, &b| {
        // Equal coordinates are ordered by index, so that the tree is the same on every run.
        at_m[a][axis].total_cmp(&at_m[b][axis]).then(a.cmp(&b))
    });
    let (left, right) = order.split_at_mut(middle);
    let next = (axis + 1) % 3;
    // The middle point itself stays where it is.
    rayon::join(|| arrange(left, at_m, next), || arrange(&mut right[1..], at_m, next));
}

/// Keeps the smallest squared distances, in order.
fn find_nearest(
    order: &[usize],
    at_m: &[DVec3],
    axis: usize,
    center_m: DVec3,
    nearest2: &mut [f64; NEIGHBOURS + 1],
) {
    let middle = order.len() / 2;
    let Some(&index) = order.get(middle) else { return };
    let distance2 = at_m[index].distance_squared(center_m);
    let place = nearest2.partition_point(|&other| other <= distance2);
    if place < nearest2.len() {
        // The largest one rotates to `place` and is overwritten there.
        nearest2[place..].rotate_right(1);
        nearest2[place] = distance2;
    }
    let off = center_m[axis] - at_m[index][axis];
    let next = (axis + 1) % 3;
    let mut sides = [&order[..middle], &order[middle + 1..]];
    if off >= 0.0 {
        sides.reverse();
    }
    let [near, far] = sides;
    find_nearest(near, at_m, next, center_m, nearest2);
    // All points on the far side are at least `off` away.
    if off * off <= nearest2[NEIGHBOURS] {
        find_nearest(far, at_m, next, center_m, nearest2);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_all_pairs() {
        let mut random = wildcity_scene::random::Random::new(1, "points", 0);
        let mut number = || random.range(-2.0, 2.0);
        let points: Vec<Point> = (0..500)
            .map(|_| Point { at_m: DVec3::new(number(), number(), 0.1 * number()), rgb: [0.5; 3] })
            .collect();
        let gaussians = gaussians_from_points(&points);
        for (i, point) in points.iter().enumerate() {
            let mut distances: Vec<f64> =
                points.iter().map(|other| other.at_m.distance(point.at_m)).collect();
            distances.sort_by(f64::total_cmp);
            let mean = distances[1..4].iter().sum::<f64>() / 3.0;
            assert!((gaussians.ln_scales[i][0] - mean.ln() as f32).abs() < 1e-5, "{i}");
        }
    }

    #[test]
    fn points_in_one_place_and_a_single_one_have_a_size() {
        let point = Point { at_m: DVec3::ONE, rgb: [0.2, 0.4, 0.6] };
        for count in [1, 2, 5] {
            let gaussians = gaussians_from_points(&vec![point; count]);
            assert!(gaussians.ln_scales.iter().all(|scale| *scale == [1e-3_f64.ln() as f32; 3]));
        }
        assert!(gaussians_from_points(&[]).is_empty());
    }
}
