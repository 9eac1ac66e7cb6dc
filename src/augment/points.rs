//! Gaussians as the points of a COLMAP model.

use std::collections::BinaryHeap;

use glam::DVec3;

use wildcity_scene::geometry::Bounds;
use wildcity_scene::random::mix;
use wildcity_scene::{Gaussians, sh};

use crate::limits::POINT_REACH_M;
use crate::plan::Place;

/// Least distance of two places that Gaussians are compared with, in metres: that much less than
/// [`POINT_REACH_M`] a Gaussian may be from a view, and be left out.
const APART_M: f64 = 5.0;

/// A point with its colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// In the twin's axes, in metres.
    pub at_m: [f64; 3],
    /// sRGB, without the part of the colour that depends on the direction.
    pub rgb8: [u8; 3],
}

/// The surroundings of some places.
#[derive(Clone, Debug, PartialEq)]
pub struct Surroundings {
    places_m: Vec<DVec3>,
}

impl Surroundings {
    /// The surroundings within [`POINT_REACH_M`] of places.
    pub fn from_places(places: &[Place]) -> Self {
        let mut places_m: Vec<DVec3> = Vec::new();
        for place in places {
            let at_m = place.world_from_rig.position_m;
            // Places come in the order of the drive, so that the last one is usually the nearest.
            if places_m.last().is_none_or(|last_m| last_m.distance(at_m) >= APART_M) {
                places_m.push(at_m);
            }
        }
        Self { places_m }
    }

    /// Whether a part of the bounds is within reach.
    pub fn meet(&self, bounds: &Bounds) -> bool {
        self.places_m.iter().any(|at_m| bounds.distance_m(*at_m) <= POINT_REACH_M)
    }

    /// The part that is in reach of a group of Gaussians, which are tested much faster with it.
    fn near(&self, gaussians: &Gaussians) -> Self {
        let mut means = Bounds::EMPTY;
        // The box of the centres; a Gaussian's size does not count.
        for mean_m in &gaussians.means_m {
            means.add(DVec3::from_array(*mean_m), DVec3::ZERO);
        }
        let is_near = |at_m: &DVec3| means.distance_m(*at_m) <= POINT_REACH_M;
        Self { places_m: self.places_m.iter().copied().filter(is_near).collect() }
    }

    fn contain(&self, point_m: DVec3) -> bool {
        let reach = POINT_REACH_M * POINT_REACH_M;
        // Squares, without a root per place.
        self.places_m.iter().any(|at_m| at_m.distance_squared(point_m) <= reach)
    }
}

/// A uniform sample of opaque Gaussians, seeded: the same Gaussians in the same order give the same
/// points.
#[derive(Debug)]
pub struct PointSample {
    seed: u64,
    most: usize,
    surroundings: Surroundings,
    seen: u64,
    /// The Gaussians with the smallest keys; the largest of these keys is on top.
    kept: BinaryHeap<Keyed>,
}

#[derive(Debug)]
struct Keyed {
    key: u64,
    index: u64,
    point: Point,
}

impl PartialEq for Keyed {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Keyed {}

impl PartialOrd for Keyed {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Keyed {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        // The index makes the order total if two keys should be equal.
        (self.key, self.index).cmp(&(other.key, other.index))
    }
}

impl PointSample {
    /// A sample of at most `most` points in some surroundings.
    pub fn new(seed: u64, most: usize, surroundings: Surroundings) -> Self {
        Self { seed, most, surroundings, seen: 0, kept: BinaryHeap::new() }
    }

    /// Adds Gaussians that are near to each other, except those with an opacity below 1/2, which
    /// are not a surface, and those outside of the surroundings.
    pub fn add(&mut self, gaussians: &Gaussians) {
        let near = self.surroundings.near(gaussians);
        for index in 0..gaussians.len() {
            // The sigmoid of 0 is 1/2.
            let is_surface = gaussians.logit_opacities[index] >= 0.0;
            if !is_surface || !near.contain(DVec3::from_array(gaussians.means_m[index])) {
                continue;
            }
            self.seen += 1;
            // A hash of the number of the Gaussian: those with the smallest keys are a uniform
            // sample, however many there are.
            let key = mix(self.seed ^ mix(self.seen));
            // With `most` 0 the heap is empty, and `is_none_or` leaves every point out.
            let is_full = self.kept.len() >= self.most;
            if is_full && self.kept.peek().is_none_or(|largest| key >= largest.key) {
                continue;
            }
            if is_full {
                self.kept.pop();
            }
            // The colour without direction: 0.5 + C0 c, as in `sh`.
            let dc = &gaussians.sh_at(index)[..3];
            let rgb8 = [0, 1, 2].map(|c| {
                let value = 0.5 + sh::C0 * f64::from(dc[c]);
                (255.0 * value.clamp(0.0, 1.0)).round() as u8
            });
            let point = Point { at_m: gaussians.means_m[index], rgb8 };
            self.kept.push(Keyed { key, index: self.seen, point });
        }
    }

    /// The points, in the order in which they were shown.
    pub fn into_points(self) -> Vec<Point> {
        let mut kept = self.kept.into_vec();
        kept.sort_by_key(|keyed| keyed.index);
        kept.into_iter().map(|keyed| keyed.point).collect()
    }
}

#[cfg(test)]
mod tests {
    use wildcity_scene::Trajectory;
    use wildcity_scene::geometry::Pose;
    use wildcity_scene::trajectory::Keyframe;

    use super::*;
    use crate::Plan;

    fn line(count: u32) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(0, count as usize);
        for at in 0..count {
            gaussians.means_m.push([f64::from(at), 0.0, 0.0]);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([-3.0; 3]);
            // Every second one is a surface.
            gaussians.logit_opacities.push(if at % 2 == 0 { 1.0 } else { -1.0 });
            // 0.5 + 0.28 x 10 is above 1, and 0.5 - 2.8 below 0: clamped to 255 and 0.
            gaussians.sh.extend([0.0, 10.0, -10.0]);
        }
        gaussians
    }

    /// Places at 0, 2, 4, .. m, each to both sides.
    fn surroundings(end_m: f64) -> Surroundings {
        let keyframe = |at_m: f64| Keyframe {
            time_us: at_m as i64,
            world_from_rig: Pose { position_m: at_m * DVec3::X, ..Pose::IDENTITY },
        };
        let keyframes = vec![keyframe(0.0), keyframe(end_m)];
        let drive = Trajectory { name: "log".to_owned(), keyframes };
        Surroundings::from_places(&Plan::new(1, &[1.0], 2.0).unwrap().places(&[drive]).unwrap())
    }

    fn sample(seed: u64, most: usize) -> Vec<Point> {
        let mut sample = PointSample::new(seed, most, surroundings(1000.0));
        sample.add(&line(600));
        sample.add(&line(400));
        sample.into_points()
    }

    #[test]
    fn a_sample_is_uniform_seeded_and_of_opaque_gaussians() {
        let points = sample(1, 100);
        assert_eq!(points.len(), 100);
        assert!(
            points.iter().all(|point| point.at_m[0] % 2.0 == 0.0 && point.rgb8 == [128, 255, 0])
        );
        assert_eq!(points, sample(1, 100));
        assert_ne!(points, sample(2, 100));
        // 300 opaque ones of the first part, 200 of the second: 60 and 40 expected.
        let falls = points.windows(2).position(|pair| pair[1].at_m[0] < pair[0].at_m[0]).unwrap();
        assert!((45..75).contains(&falls), "{falls}");
        assert_eq!(sample(1, 1000).len(), 500);
        assert_eq!(sample(1, 0), []);
    }

    #[test]
    fn points_are_near_the_views() {
        let near = surroundings(30.0);
        // Stations 0 to 30 every 2 m; of these one every 6 m is at least 5 m from the last.
        assert_eq!(near.places_m.len(), 6, "{near:?}");
        let mut sample = PointSample::new(1, 1000, near.clone());
        sample.add(&line(1000));
        let farthest_m = sample.into_points().last().unwrap().at_m[0];
        // The last place kept is near 30 m, and the reach is 100 m.
        assert!((120.0..=131.0).contains(&farthest_m), "{farthest_m}");
        let at = |x_m: f64| {
            let mut bounds = Bounds::EMPTY;
            bounds.add(DVec3::new(x_m, 0.0, 0.0), DVec3::ONE);
            near.meet(&bounds)
        };
        // A box of 1 m to each side: -100.5 + 1 is within 100 m of 0.
        assert!(at(120.0) && at(-100.5) && !at(140.0));
    }
}
