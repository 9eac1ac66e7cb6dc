//! Gaussians as the points of a COLMAP model.

use std::collections::BinaryHeap;

use wildcity_scene::random::mix;
use wildcity_scene::{Gaussians, sh};

/// A point with its colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// In the twin's axes, in metres.
    pub at_m: [f64; 3],
    /// sRGB, without the part of the colour that depends on the direction.
    pub rgb8: [u8; 3],
}

/// A uniform sample of opaque Gaussians, seeded: the same Gaussians in the same order give the same points.
#[derive(Debug)]
pub struct PointSample {
    seed: u64,
    most: usize,
    seen: u64,
    /// Those with the smallest keys; the largest of them on top.
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
        (self.key, self.index).cmp(&(other.key, other.index))
    }
}

impl PointSample {
    /// A sample of at most `most` points.
    pub fn new(seed: u64, most: usize) -> Self {
        Self { seed, most, seen: 0, kept: BinaryHeap::new() }
    }

    /// Shows it Gaussians. Those with an opacity below 1/2 are left out, since they are no surface.
    pub fn add(&mut self, gaussians: &Gaussians) {
        for index in 0..gaussians.len() {
            // The sigmoid of 0 is 1/2.
            if gaussians.logit_opacities[index] < 0.0 {
                continue;
            }
            self.seen += 1;
            let key = mix(self.seed ^ mix(self.seen));
            let is_full = self.kept.len() >= self.most;
            if is_full && self.kept.peek().is_none_or(|largest| key >= largest.key) {
                continue;
            }
            if is_full {
                self.kept.pop();
            }
            let dc = &gaussians.sh_of(index)[..3];
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
    use super::*;

    fn line(count: u32) -> Gaussians {
        let mut gaussians = Gaussians::with_capacity(0, count as usize);
        for at in 0..count {
            gaussians.means_m.push([f64::from(at), 0.0, 0.0]);
            gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.ln_scales.push([-3.0; 3]);
            gaussians.logit_opacities.push(if at % 2 == 0 { 1.0 } else { -1.0 });
            gaussians.sh.extend([0.0, 10.0, -10.0]);
        }
        gaussians
    }

    fn sample(seed: u64, most: usize) -> Vec<Point> {
        let mut sample = PointSample::new(seed, most);
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
}
