//! Drivable areas along recorded drives, for a twin without a map.

use std::iter;

use glam::DVec3;

use wildcity_scene::Trajectory;
use wildcity_scene::trajectory::Keyframe;

use super::file::{Area, AreaKind, Lane, LaneKind, MapFile};
use crate::traffic::EgoBox;

/// Distance between two points of an edge, in metres.
const SPACING_M: f64 = 2.0;

/// How far a strip reaches beyond the box of an ego at either end of the drive, in metres. A corner
/// on the edge of an area is outside of it.
const BEYOND_M: f64 = 1.0;

/// A map of one lane and one drivable strip along each drive: from `left_m` to the left of the
/// drive to `right_m` to its right, both above 0. The owner of the twin gives both: a default would
/// be a guess that judges. The strip is longer than the lane, since the ego's box reaches beyond
/// the rear axle, which is on the drive.
pub fn strips_beside(drives: &[Trajectory], left_m: f64, right_m: f64) -> MapFile {
    let mut lanes = Vec::new();
    let mut areas = Vec::new();
    for drive in drives {
        let mut center: Vec<[f64; 3]> = Vec::new();
        let mut left: Vec<[f64; 3]> = Vec::new();
        let mut right: Vec<[f64; 3]> = Vec::new();
        let mut last_m: Option<DVec3> = None;
        let count = drive.keyframes.len();
        for (index, keyframe) in drive.keyframes.iter().enumerate() {
            let pose = &keyframe.world_from_rig;
            // Without a previous point the distance is infinite, so that the first keyframe is
            // always taken.
            let way_m = last_m.map_or(f64::INFINITY, |last_m| pose.position_m.distance(last_m));
            let is_last = index + 1 == count;
            // The last keyframe is kept even if it is close, so that the lane reaches the end of
            // the drive. One that repeats the previous point would make an edge without a
            // direction.
            if way_m < SPACING_M && !(is_last && way_m > 0.01) {
                continue;
            }
            last_m = Some(pose.position_m);
            center.push(pose.position_m.to_array());
            left.push(pose.transform_point(left_m * DVec3::Y).to_array());
            right.push(pose.transform_point(-right_m * DVec3::Y).to_array());
        }
        if center.len() < 2 {
            continue;
        }
        // The box reaches `length / 2 - center` behind the rear axle and `length / 2 + center`
        // ahead of it.
        let EgoBox { box_, center_x_m } = EgoBox::default();
        let behind_m = 0.5 * box_.length_m - center_x_m + BEYOND_M;
        let ahead_m = 0.5 * box_.length_m + center_x_m + BEYOND_M;
        let first = &drive.keyframes[0];
        let last = &drive.keyframes[count - 1];
        let end = |keyframe: &Keyframe, x_m: f64| {
            let corner_m = |y_m: f64| DVec3::new(x_m, y_m, 0.0);
            [left_m, -right_m]
                .map(|y_m| keyframe.world_from_rig.transform_point(corner_m(y_m)).to_array())
        };
        let [rear_left, rear_right] = end(first, -behind_m);
        let [front_left, front_right] = end(last, ahead_m);
        // Around the strip: left side forwards, across the front, right side backwards, across the
        // rear.
        let outline = iter::once(rear_left)
            .chain(left.iter().copied())
            .chain([front_left, front_right])
            .chain(right.iter().rev().copied())
            .chain([rear_right])
            .collect();
        areas.push(Area { kind: AreaKind::Drivable, outline });
        lanes.push(Lane {
            id: drive.name.clone(),
            kind: LaneKind::Driving,
            center,
            left,
            right,
            next: Vec::new(),
            intersection: false,
            limit_mps: None,
        });
    }
    MapFile::new(lanes, areas)
}
