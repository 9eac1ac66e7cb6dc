//! A drive through a few points: what a person clicks on the ground.

use glam::{DQuat, DVec2, DVec3};

use crate::Trajectory;
use crate::geometry::Pose;
use crate::rig::is_name;
use crate::trajectory::Keyframe;

/// Speed of a drive that no vehicle drove, in m/s.
pub const DEFAULT_SPEED_M_S: f64 = 5.0;
/// Distance between two keyframes, in metres; a short drive has at least [`LEAST_STEPS`].
const STEP_M: f64 = 0.5;
const LEAST_STEPS: f64 = 8.0;
/// Most steps between keyframes: 100 km at [`STEP_M`].
const MOST_STEPS: f64 = 200_000.0;
/// Most points that a path may be drawn through.
const MOST_POINTS: usize = 1_000;
/// Points that are closer together than this are one, in metres.
const SAME_M: f64 = 1e-3;

/// Why no drive through the points can be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PathError {
    /// Too few or too many points.
    #[error("{count} different points; a drive goes through 2 to {MOST_POINTS}")]
    Points { count: usize },
    /// A coordinate is not finite or too large.
    #[error("point {index} is not a place: its coordinates must be finite, and below 1e8 m")]
    Place {
        /// Index of the point.
        index: usize,
    },
    /// The speed is out of range.
    #[error("a speed of {0:?} m/s; from 0.1 to 100 are accepted")]
    Speed(f64),
    /// A name is empty, too long, or has other characters than `[a-z0-9._-]`.
    #[error(
        "{0:?} is not a name of a trajectory: a name has 1 to 64 of a-z 0-9 . _ - and does not start with ."
    )]
    Name(String),
    /// Longer than a drive may be.
    #[error(
        "the drive is {length_m:?} m long; at most {most_m:?} m are accepted: is the unit metres?"
    )]
    Length {
        /// Its length, in metres.
        length_m: f64,
        /// The most, in metres.
        most_m: f64,
    },
}

/// A drive at constant speed through points, in metres: a centripetal Catmull-Rom curve (Yuksel,
/// Schaefer and Keyser 2011), which has no loops between close points. The rig stands level, its x
/// axis along the curve.
///
/// # Errors
/// Names what cannot be used.
pub fn drive_through(
    name: &str,
    points_m: &[DVec3],
    speed_m_s: f64,
) -> Result<Trajectory, PathError> {
    if !is_name(name) {
        return Err(PathError::Name(name.to_owned()));
    }
    if !(0.1..=100.0).contains(&speed_m_s) {
        return Err(PathError::Speed(speed_m_s));
    }
    let is_place =
        |point: &DVec3| point.is_finite() && point.abs().max_element() < Pose::MAX_COORDINATE_M;
    if let Some(index) = points_m.iter().position(|point| !is_place(point)) {
        return Err(PathError::Place { index });
    }
    let mut knots: Vec<DVec3> = points_m.to_vec();
    // Only neighbours: a drive may come back to a point later. A double click would make an
    // interval of zero length, which divides by 0 in the curve.
    knots.dedup_by(|a, b| a.distance(*b) < SAME_M);
    if !(2..=MOST_POINTS).contains(&knots.len()) {
        return Err(PathError::Points { count: knots.len() });
    }
    // The length of the polygon bounds the memory before the curve is computed. The curve is rarely
    // more than half as long again; a factor of 2 is the margin.
    let straight_m: f64 = knots.windows(2).map(|pair| pair[0].distance(pair[1])).sum();
    let most_m = MOST_STEPS * STEP_M;
    if straight_m > 0.5 * most_m {
        return Err(PathError::Length { length_m: straight_m, most_m: 0.5 * most_m });
    }

    // 1. The curve, finely.
    let fine_m = STEP_M.min(straight_m / LEAST_STEPS) / 8.0;
    let mut curve = vec![knots[0]];
    for at in 0..knots.len() - 1 {
        let from = knots[at];
        let to = knots[at + 1];
        // Beyond the ends the curve goes on as it came.
        let before = if at > 0 { knots[at - 1] } else { 2.0 * from - to };
        let after = knots.get(at + 2).copied().unwrap_or(2.0 * to - from);
        let steps = (from.distance(to) / fine_m).ceil().max(1.0) as usize;
        let point = |step| catmull_rom([before, from, to, after], step as f64 / steps as f64);
        curve.extend((1..=steps).map(point));
    }

    // 2. Keyframes at equal distances.
    // Stations rise, because knots differ by at least SAME_M: the division in `at_m` is safe.
    let mut stations_m = vec![0.0];
    for pair in curve.windows(2) {
        stations_m.push(stations_m[stations_m.len() - 1] + pair[0].distance(pair[1]));
    }
    let length_m = stations_m[stations_m.len() - 1];
    let steps = (length_m / STEP_M).ceil().max(LEAST_STEPS) as usize;
    let at_m = |station_m: f64| {
        let next = stations_m.partition_point(|&m| m < station_m).clamp(1, curve.len() - 1);
        let from_m = stations_m[next - 1];
        let to_m = stations_m[next];
        curve[next - 1].lerp(curve[next], ((station_m - from_m) / (to_m - from_m)).clamp(0.0, 1.0))
    };
    let mut heading_rad = 0.0;
    let keyframe = |step: usize| {
        let station_m = length_m * step as f64 / steps as f64;
        // Half a step to both sides: a central difference, without the lag of a one-sided one. At
        // the ends `at_m` clamps, and the difference is one-sided.
        let reach_m = 0.5 * length_m / steps as f64;
        let way = at_m(station_m + reach_m) - at_m(station_m - reach_m);
        let flat = DVec2::new(way.x, way.y);
        if flat.length() > 1e-9 {
            heading_rad = flat.y.atan2(flat.x);
        }
        Keyframe {
            time_us: (1e6 * station_m / speed_m_s).round() as i64,
            world_from_rig: Pose {
                position_m: at_m(station_m),
                rotation: DQuat::from_rotation_z(heading_rad),
            },
        }
    };
    let mut keyframes: Vec<Keyframe> = (0..=steps).map(keyframe).collect();
    // A drive of millimetres: times still rise.
    for at in 1..keyframes.len() {
        keyframes[at].time_us = keyframes[at].time_us.max(keyframes[at - 1].time_us + 1);
    }
    Ok(Trajectory { name: name.to_owned(), keyframes })
}

/// The curve between the middle two of four knots, at t from 0 to 1 (Barry and Goldman 1988).
fn catmull_rom([a, b, c, d]: [DVec3; 4], t: f64) -> DVec3 {
    // Knots of the parameter: centripetal, the square root of the distance. Distances of 0 do not
    // occur, since neighbours differ.
    let t1 = a.distance(b).sqrt();
    let t2 = t1 + b.distance(c).sqrt();
    let t3 = t2 + c.distance(d).sqrt();
    let t = t1 + t * (t2 - t1);
    let mix = |from: DVec3, to: DVec3, start: f64, end: f64| {
        from + (to - from) * ((t - start) / (end - start))
    };
    let ab = mix(a, b, 0.0, t1);
    let bc = mix(b, c, t1, t2);
    let cd = mix(c, d, t2, t3);
    mix(mix(ab, bc, 0.0, t2), mix(bc, cd, t1, t3), t1, t2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_drive_goes_through_the_points_and_looks_ahead() {
        let corner = [DVec3::ZERO, DVec3::new(20.0, 0.0, 0.0), DVec3::new(20.0, 20.0, 0.0)];
        let drive = drive_through("path", &corner, 5.0).unwrap();
        drive.check().unwrap();
        assert!((40.0..44.0).contains(&drive.length_m()), "{}", drive.length_m());
        for point in corner {
            let nearest =
                drive.keyframes.iter().map(|k| k.world_from_rig.position_m.distance(point));
            assert!(nearest.fold(f64::MAX, f64::min) < 0.3, "{point}");
        }
        let ahead = |at: usize| drive.keyframes[at].world_from_rig.rotation * DVec3::X;
        assert!(ahead(0).dot(DVec3::X) > 0.9, "{}", ahead(0));
        assert!(ahead(drive.keyframes.len() - 1).dot(DVec3::Y) > 0.9);
        let last = drive.keyframes[drive.keyframes.len() - 1];
        assert!((last.time_us as f64 * 1e-6 - drive.length_m() / 5.0).abs() < 0.02);
        for pair in drive.keyframes.windows(2) {
            let step_m =
                pair[0].world_from_rig.position_m.distance(pair[1].world_from_rig.position_m);
            assert!((0.3..0.51).contains(&step_m), "{step_m}");
        }
    }

    #[test]
    fn a_tiny_path_is_a_drive_too_and_bad_ones_are_refused() {
        let tiny = drive_through("path", &[DVec3::ZERO, DVec3::new(0.01, 0.0, 0.0)], 5.0).unwrap();
        tiny.check().unwrap();
        assert_eq!(tiny.keyframes.len(), 9);
        let two = [DVec3::ZERO, DVec3::X];
        let refused =
            |name, points: &[DVec3], speed| drive_through(name, points, speed).unwrap_err();
        assert_eq!(refused("path", &[DVec3::X; 3], 5.0), PathError::Points { count: 1 });
        assert_eq!(refused("path", &two, 0.0), PathError::Speed(0.0));
        assert!(matches!(refused("../p", &two, 5.0), PathError::Name(_)));
        let bad = [DVec3::ZERO, DVec3::new(f64::NAN, 0.0, 0.0)];
        assert_eq!(refused("path", &bad, 5.0), PathError::Place { index: 1 });
        let far = [DVec3::ZERO, DVec3::new(1e7, 0.0, 0.0)];
        assert!(matches!(refused("path", &far, 5.0), PathError::Length { .. }));
    }
}
