//! Lines with fewer points.

use glam::DVec3;

/// A line is simplified so that it stays this near to its points, in metres.
const NEAR_M: f64 = 0.01;

/// The line without the points that are within [`NEAR_M`] of it, or farther if it is very long.
pub(super) fn simplified(points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    // 1 cm, and 1.5 times as much in each further round: the seventh is the first above 0.1 m.
    let mut near_m = NEAR_M;
    loop {
        let line = within(points, near_m);
        // As many as a scenario accepts, with some for what a trajectory adds.
        if line.len() <= wildcity_sim::limits::COURSE_POINTS / 2 || near_m > 0.1 {
            return line;
        }
        near_m *= 1.5;
    }
}

/// The line without the points that are within a distance of it (Douglas and Peucker), with
/// coordinates in tenths of a millimetre.
fn within(points: &[[f64; 3]], near_m: f64) -> Vec<[f64; 3]> {
    let Some(last) = points.len().checked_sub(1) else { return Vec::new() };
    let at = |index: usize| DVec3::from_array(points[index]);
    let mut is_kept = vec![false; points.len()];
    is_kept[0] = true;
    is_kept[last] = true;
    // A stack of spans and no recursion, because a span may be split very unevenly.
    let mut spans = vec![(0, last)];
    while let Some((from, to)) = spans.pop() {
        let way_m = at(to) - at(from);
        let off_m = |index: usize| {
            // The foot of the point on the chord, as a share of its length.
            let t = (at(index) - at(from)).dot(way_m) / way_m.length_squared().max(1e-12);
            (at(from) + t.clamp(0.0, 1.0) * way_m).distance(at(index))
        };
        let farthest = (from + 1..to).map(|index| (off_m(index), index));
        let Some((off_m, index)) = farthest.max_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
        if off_m > near_m {
            is_kept[index] = true;
            spans.extend([(from, index), (index, to)]);
        }
    }
    let kept = points.iter().zip(is_kept).filter(|(_, is_kept)| *is_kept);
    kept.map(|(point, _)| point.map(|axis| (axis * 1e4).round() / 1e4)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_simplified_line_stays_near_its_points() {
        let line: Vec<[f64; 3]> = (0..=1000).map(|i| [f64::from(i), 0.0, 0.0]).collect();
        assert_eq!(simplified(&line), [[0.0; 3], [1000.0, 0.0, 0.0]]);
        let arc = (0..=1000).map(|i| {
            // An arc of 1 rad, which is 100 m long.
            let angle_rad = f64::from(i) * 1e-3;
            [100.0 * angle_rad.sin(), 100.0 - 100.0 * angle_rad.cos(), 0.0]
        });
        let arc: Vec<[f64; 3]> = arc.collect();
        let kept = simplified(&arc);
        // A chord of 2.8 m is 1 cm from an arc of 100 m.
        assert!((30..70).contains(&kept.len()), "{}", kept.len());
    }
}
