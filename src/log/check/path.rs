//! The path of the rig: its length, its speeds, leaps of the poses, and poses against satellite
//! fixes.

use glam::DVec3;
use serde::Serialize;

use wildcity_scene::geo::GeoPoint;
use wildcity_scene::trajectory::Keyframe;
use wildcity_sim::map::MapFile;

use crate::error::LogError;
use crate::limits::LARGEST_GAP_US;
use crate::log::Log;
use crate::poses::Poses;
use crate::row::GpsRow;
use crate::table::Rows;

/// A pose leaps where its speed exceeds that of both neighbours by this much, in m/s: a clock that
/// jumps, or a position that was corrected.
const LEAP_M_PER_S: f64 = 5.0;

/// Lanes this far beside the path are drawn, in metres.
const AROUND_M: f64 = 30.0;

/// Lanes that are drawn.
const LANES: usize = 5_000;

/// Points of the path that are kept for its picture.
const DRAWN: usize = 2000;

/// The path of the rig.
#[derive(Clone, Debug, Serialize)]
pub struct PathReport {
    /// Times of the first and the last pose, in microseconds.
    pub span_us: [i64; 2],
    /// Length of the polyline through the poses, in metres.
    pub length_m: f64,
    /// Largest speed between two poses, in m/s.
    pub top_speed_m_per_s: f64,
    /// Time during which the rig was slower than 0.1 m/s, in seconds.
    pub standing_s: f64,
    /// Times at which poses leap, in microseconds; at most 32 of them.
    pub leaps_us: Vec<i64>,
    /// How many leaps there are.
    pub leaps: usize,
    /// Time in gaps of the poses longer than 0.2 s, in seconds: nothing is placed there.
    pub unplaced_s: f64,
    /// Points of the path in the world, in metres, at most 2,000.
    #[serde(skip)]
    pub points_m: Vec<[f64; 2]>,
}

/// Poses against satellite fixes, in the world's plane, in metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GpsReport {
    /// Fixes at times that have a pose.
    pub fixes: usize,
    /// Mean distance of the poses from the fixes, after the mean offset of all is taken away.
    pub mean_m: f64,
    /// Mean offset of the fixes from the poses: a mount off the rig's origin, or a wrong anchor.
    pub offset_m: [f64; 2],
    /// How much the offset changes from the first to the last tenth of the fixes: drift.
    pub drift_m: f64,
}

impl PathReport {
    pub(super) fn measure(poses: &Poses) -> Self {
        let keys = poses.keyframes();
        let speeds: Vec<f64> = keys.windows(2).map(speed_m_per_s).collect();
        let leaps = leaps_us(keys, &speeds);
        let gap_s = |pair: &[Keyframe]| pair[1].time_us.abs_diff(pair[0].time_us) as f64 / 1e6;
        let largest_s = LARGEST_GAP_US as f64 / 1e6;
        // A sum of nothing is -0, which would be printed.
        let long = keys.windows(2).map(gap_s).filter(|s| *s > largest_s);
        let standing = keys.windows(2).zip(&speeds).filter(|(_, speed)| **speed < 0.1);
        // There is at least one pose, so the step is at least 1.
        let step = keys.len().div_ceil(DRAWN);
        let last = keys.len() - 1;
        // The last pose is drawn whatever the step is, or the path would end early.
        let drawn = (0..keys.len()).step_by(step).chain([last]);
        let point = |at: usize| keys[at].world_from_rig.position_m.truncate().to_array();
        Self {
            span_us: poses.span_us(),
            length_m: keys.windows(2).map(|pair| distance_m(&pair[0], &pair[1])).sum(),
            top_speed_m_per_s: speeds.iter().copied().fold(0.0, f64::max),
            standing_s: standing.map(|(pair, _)| gap_s(pair)).fold(0.0, |sum, s| sum + s),
            leaps: leaps.len(),
            leaps_us: leaps.into_iter().take(32).collect(),
            unplaced_s: long.fold(0.0, |sum, s| sum + s),
            points_m: drawn.map(point).collect(),
        }
    }
}

impl PathReport {
    /// The middles of the lanes of a map that are near the path, at most 5,000 of them.
    pub(super) fn lanes_around(&self, map: &MapFile) -> Vec<Vec<[f64; 2]>> {
        let range = |axis: usize| {
            let values = self.points_m.iter().map(|point| point[axis]);
            let least = values.clone().fold(f64::INFINITY, f64::min);
            least - AROUND_M..values.fold(f64::NEG_INFINITY, f64::max) + AROUND_M
        };
        let ranges = [range(0), range(1)];
        let is_near = |point: &[f64; 2]| ranges.iter().zip(point).all(|(r, v)| r.contains(v));
        let lines = map
            .lanes
            .iter()
            .map(|lane| -> Vec<[f64; 2]> { lane.center.iter().map(|&[x, y, _]| [x, y]).collect() });
        lines.filter(|line| line.iter().any(is_near)).take(LANES).collect()
    }
}

fn distance_m(from: &Keyframe, to: &Keyframe) -> f64 {
    from.world_from_rig.position_m.distance(to.world_from_rig.position_m)
}

fn speed_m_per_s(pair: &[Keyframe]) -> f64 {
    distance_m(&pair[0], &pair[1]) / (pair[1].time_us.abs_diff(pair[0].time_us) as f64 / 1e6)
}

/// The times of poses before which the speed is much larger than before and after.
fn leaps_us(keys: &[Keyframe], speeds: &[f64]) -> Vec<i64> {
    let is_leap = |at: &usize| {
        let around = [at.checked_sub(1), Some(at + 1)].into_iter().flatten();
        let beside = around.filter_map(|other| speeds.get(other)).copied();
        let fastest = beside.fold(f64::NEG_INFINITY, f64::max);
        // Of two poses the only step has no neighbour to compare with, and `fastest` is still
        // infinite.
        fastest.is_finite() && speeds[*at] > 2.0 * fastest + LEAP_M_PER_S
    };
    (0..speeds.len()).filter(is_leap).map(|at| keys[at + 1].time_us).collect()
}

/// Compares the poses with satellite fixes; `None` without an anchor, or without a fix at the time
/// of a pose.
pub(super) fn compare_fixes(
    log: &Log,
    poses: &Poses,
    rows: Rows<GpsRow>,
) -> Result<Option<GpsReport>, LogError> {
    let Some(geo) = &log.header.world.geo else { return Ok(None) };
    let mut offsets: Vec<DVec3> = Vec::new();
    super::for_each(rows, |row| {
        let GpsRow { time_us, latitude_deg, longitude_deg, altitude_m } = row;
        let point = GeoPoint { latitude_deg, longitude_deg, altitude_m };
        let at_m = geo
            .position_m(&point)
            .map_err(|error| LogError::malformed(&log.path("log.json"), error))?;
        offsets.extend(poses.at(time_us).map(|pose| at_m - pose.position_m));
        Ok(())
    })?;
    let fixes = offsets.len();
    if fixes == 0 {
        return Ok(None);
    }
    let mean = |part: &[DVec3]| part.iter().sum::<DVec3>().truncate() / part.len() as f64;
    let offset = mean(&offsets);
    // Rounded up: of few fixes a tenth is at least one, and a mean of none would be NaN.
    let tenth = fixes.div_ceil(10);
    // A mean of many, because a single fix is off by metres.
    let drift = mean(&offsets[fixes - tenth..]) - mean(&offsets[..tenth]);
    let off_m = offsets.iter().map(|one| one.truncate().distance(offset));
    Ok(Some(GpsReport {
        fixes,
        mean_m: off_m.sum::<f64>() / fixes as f64,
        offset_m: offset.to_array(),
        drift_m: drift.length(),
    }))
}
