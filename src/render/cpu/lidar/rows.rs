//! The rows of a LiDAR: their elevations, once for all sectors.

use std::ops::Range;

use crate::lidar::LidarView;

/// The tangent of a beam that looks straight up or down, which has none. A point 0.1 mm beside such
/// a beam at 100 m has it.
const STEEPEST: f64 = 1e6;

/// Buckets begin and end at most at these tangents: rows that are steeper, of which LiDARs have
/// few, share the outer ones.
const BUCKETS_TO: f32 = 4.0;

/// The rows of a LiDAR.
pub(crate) struct Rows {
    /// Tangents of the elevations, rising.
    tangents: Vec<f32>,
    /// Whether the LiDAR's own rows fall: its first is the last here.
    falls: bool,
    /// The tangents are divided evenly into buckets. For each, the number of rows below the begin
    /// of the bucket before it, so that no rounding of a begin loses a row.
    below: Vec<u16>,
    /// Tangent at which the first bucket begins.
    buckets_from: f32,
    buckets_per_tangent: f32,
    /// Cosine and sine of each row's elevation, and those of its azimuth offset, in the order of
    /// the LiDAR.
    pub(crate) angles: Vec<[f64; 4]>,
}

impl Rows {
    pub(super) fn new(view: &LidarView) -> Self {
        let tangent = |elevation: &f64| elevation.tan().clamp(-STEEPEST, STEEPEST) as f32;
        let mut tangents: Vec<f32> = view.lidar.row_elevations_rad().iter().map(tangent).collect();
        let falls = tangents[0] > tangents[tangents.len() - 1];
        if falls {
            tangents.reverse();
        }
        let buckets_from = tangents[0].clamp(-BUCKETS_TO, BUCKETS_TO);
        let buckets_to = tangents[tangents.len() - 1].clamp(-BUCKETS_TO, BUCKETS_TO);
        let count = 16 * tangents.len();
        // A LiDAR of one row has no span to divide.
        let buckets_per_tangent = count as f32 / (buckets_to - buckets_from).max(1e-6);
        let below = |bucket: usize| {
            // All tangents of the first two buckets may be in question.
            let from = match bucket {
                0 | 1 => f32::NEG_INFINITY,
                _ => buckets_from + (bucket - 1) as f32 / buckets_per_tangent,
            };
            // A LiDAR has at most 256 rows.
            tangents.partition_point(|tangent| *tangent < from) as u16
        };
        Self {
            below: (0..=count).map(below).collect(),
            falls,
            buckets_from,
            buckets_per_tangent,
            angles: (0..view.lidar.rows()).map(|row| row_angles(view, row)).collect(),
            tangents,
        }
    }

    /// The smallest and the largest tangent of the elevations.
    pub(super) fn span(&self) -> [f32; 2] {
        // A LiDAR has rows.
        [self.tangents[0], self.tangents[self.tangents.len() - 1]]
    }

    /// The rows of the LiDAR whose elevations have tangents from `low` to `high`.
    pub(super) fn between(&self, low: f32, high: f32) -> Range<usize> {
        let count = self.tangents.len();
        // Tangents at the clamp are equal to each other, so that a test with equality keeps them.
        let mut first = self.start(low);
        while first < count && self.tangents[first] < low {
            first += 1;
        }
        // Not before `first`, so that a range between two rows is empty.
        let mut end = self.start(high).max(first);
        while end < count && self.tangents[end] <= high {
            end += 1;
        }
        if self.falls { count - end..count - first } else { first..end }
    }

    /// A row that is at most the first one with this tangent.
    fn start(&self, tangent: f32) -> usize {
        // The cast is 0 for what is below, and the largest for what is above.
        let bucket = ((tangent - self.buckets_from) * self.buckets_per_tangent) as usize;
        usize::from(self.below[bucket.min(self.below.len() - 1)])
    }
}

fn row_angles(view: &LidarView, row: usize) -> [f64; 4] {
    let lidar = &view.lidar;
    let (sin_e, cos_e) = lidar.row_elevations_rad()[row].sin_cos();
    let (sin_o, cos_o) = (lidar.azimuth_rad(row, 0) - lidar.azimuth_rad(0, 0)).sin_cos();
    [cos_e, sin_e, cos_o, sin_o]
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;
    use std::sync::Arc;

    use wildcity_options::{LidarBeams, LidarColumns};
    use wildcity_scene::geometry::{Lidar, Pose};
    use wildcity_scene::random::Random;

    use super::*;

    fn rows(elevations: &[f64]) -> Rows {
        let lidar = Lidar::from_options(&LidarBeams {
            row_elevations_rad: elevations.to_vec(),
            row_azimuth_offsets_rad: None,
            column_azimuths_rad: None,
            columns: Some(LidarColumns { count: 1, first_rad: 0.0, last_rad: 0.0 }),
            duration_us: 100_000,
            min_range_m: None,
            max_range_m: None,
        });
        Rows::new(&LidarView::at_rest(Arc::new(lidar.unwrap()), Pose::IDENTITY))
    }

    #[test]
    fn rows_between_tangents_are_those_of_a_search() {
        let mut random = Random::new(1, "rows", 0);
        for count in [1, 2, 3, 40, 128, 256] {
            for widest in [0.01, 0.3, FRAC_PI_2] {
                let even = |row: usize| widest * (1.0 - 2.0 * row as f64 / (count as f64));
                let mut elevations: Vec<f64> = (0..count).map(even).collect();
                for falls in [true, false] {
                    let rows = rows(&elevations);
                    let tangent = |row: usize| elevations[row].tan().clamp(-1e6, 1e6) as f32;
                    for _ in 0..300 {
                        let mut ends = [0, 1].map(|_| {
                            let at = random.below(count);
                            let off = [0.0, 1e-7, -1e-7, 0.003, -1e9, 1e9];
                            tangent(at) + off[random.below(6)]
                        });
                        ends.sort_by(f32::total_cmp);
                        let [low, high] = ends;
                        let wanted: Vec<usize> = (0..count)
                            .filter(|row| (low..=high).contains(&tangent(*row)))
                            .collect();
                        let found: Vec<usize> = rows.between(low, high).collect();
                        assert_eq!(found, wanted, "{count} rows, {low} to {high}, falls {falls}");
                    }
                    elevations.reverse();
                }
            }
        }
    }
}
