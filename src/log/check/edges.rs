//! Edges of an image and of a sweep, after Levinson and Thrun, "Automatic Online Calibration of
//! Cameras and Lasers" (2013): where the distance leaps, the image has an edge more often than
//! elsewhere, if times and mounts are right.

use std::collections::BTreeMap;

use glam::DVec2;
use image::GrayImage;

/// How much an edge counts one pixel beside it: edges attract points from some pixels away.
const DECAY: f32 = 0.4;

/// A point is an edge if its neighbour is this much farther, as a share and in metres.
const LEAP: (f32, f32) = (0.08, 0.5);

/// The edges of a gray image, spread to the pixels around them.
#[derive(Clone, Debug)]
pub(super) struct EdgeMap {
    width: usize,
    height: usize,
    values: Vec<f32>,
    mean: f32,
}

impl EdgeMap {
    pub(super) fn new(gray: &GrayImage) -> Self {
        let width = gray.width() as usize;
        let height = gray.height() as usize;
        let mut values = gradients(gray.as_raw(), width, height);
        spread(&mut values, width, height);
        let mean = values.iter().sum::<f32>() / values.len().max(1) as f32;
        Self { width, height, values, mean }
    }

    /// How much of an edge is at a place, in pixels of the image: 1 is the mean of the image.
    pub(super) fn at(&self, at_px: DVec2) -> Option<f64> {
        let is_positive = at_px.x >= 0.0 && at_px.y >= 0.0;
        // A negative place would become 0.
        let column = at_px.x as usize;
        let row = at_px.y as usize;
        let is_inside = is_positive && column < self.width && row < self.height;
        (is_inside && self.mean > 0.0)
            .then(|| f64::from(self.values[row * self.width + column] / self.mean))
    }
}

/// The largest difference of each pixel to its eight neighbours.
fn gradients(gray: &[u8], width: usize, height: usize) -> Vec<f32> {
    let mut values = vec![0.0; gray.len()];
    // Pixels of the border lack neighbours: they keep 0, no edge.
    for row in 1..height.saturating_sub(1) {
        for column in 1..width.saturating_sub(1) {
            let at = row * width + column;
            let around = [1, width - 1, width, width + 1];
            let differences = around.into_iter().flat_map(|step| [at - step, at + step]);
            let largest = differences.map(|other| gray[at].abs_diff(gray[other])).max();
            values[at] = f32::from(largest.unwrap_or(0));
        }
    }
    values
}

/// Lets each value decay into the pixels around it: one pass from the top left and one from the
/// bottom right reach all eight directions.
fn spread(values: &mut [f32], width: usize, height: usize) {
    // A step from the side of the image leads to its other side. Nothing is an edge there, and what
    // has decayed into the border counts little beyond it.
    let forward = |at: usize| [1, width - 1, width, width + 1].map(|step| at.checked_sub(step));
    for at in 0..width * height {
        let before = forward(at).into_iter().flatten().map(|other| DECAY * values[other]);
        values[at] = before.fold(values[at], f32::max);
    }
    for at in (0..width * height).rev() {
        let steps = [1, width - 1, width, width + 1].into_iter();
        let after = steps.map(|step| at + step).filter(|other| *other < width * height);
        values[at] = after.map(|other| DECAY * values[other]).fold(values[at], f32::max);
    }
}

/// The points of a sweep that are nearer than a neighbour by much. Neighbours are the point before
/// and the point after, of the same laser if lasers are known.
pub(super) fn lidar_edges(ranges_m: &[f32], ring: Option<&[u16]>) -> Vec<bool> {
    let mut is_edge = vec![false; ranges_m.len()];
    let mut last: BTreeMap<u16, usize> = BTreeMap::new();
    for at in 0..ranges_m.len() {
        let laser = ring.map_or(0, |ring| ring[at]);
        let Some(before) = last.insert(laser, at) else { continue };
        // A point without a return may be NaN: then no comparison below holds, and nothing is an
        // edge.
        let (near, far) = if ranges_m[before] < ranges_m[at] { (before, at) } else { (at, before) };
        let (share, least_m) = LEAP;
        if ranges_m[far] - ranges_m[near] > least_m.max(share * ranges_m[near]) {
            // The nearer one is at the border of an object; the farther one is anywhere on the
            // background.
            is_edge[near] = true;
        }
    }
    is_edge
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_near_side_of_a_leap_is_an_edge_of_its_laser() {
        // Two lasers in turn; the first sees a pole at 5 m in front of a wall at 10 m.
        let ranges = [10.0, 30.0, 5.0, 30.1, 5.1, 30.2, 10.0, 30.1];
        let ring = [0, 1, 0, 1, 0, 1, 0, 1];
        let edges = lidar_edges(&ranges, Some(&ring));
        assert_eq!(edges, [false, false, true, false, true, false, false, false]);
        let mixed = lidar_edges(&ranges, None);
        assert_eq!(mixed.iter().filter(|is_edge| **is_edge).count(), 4);
        assert_eq!(lidar_edges(&[f32::NAN, 1.0], None), [false, false]);
    }

    #[test]
    fn an_edge_attracts_from_some_pixels_away() {
        let gray = GrayImage::from_fn(40, 20, |x, _| image::Luma([if x < 20 { 0 } else { 200 }]));
        let map = EdgeMap::new(&gray);
        let at = |x: f64| map.at(DVec2::new(x, 10.5)).unwrap();
        assert!(at(20.5) > at(23.5) && at(23.5) > at(27.5), "{} {}", at(20.5), at(23.5));
        assert_eq!(map.at(DVec2::new(-0.5, 3.0)), None);
        assert_eq!(map.at(DVec2::new(3.0, 20.5)), None);
    }
}
