//! Drivable areas along recorded drives, for a twin without a map.

use glam::DVec3;

use wildcity_scene::Trajectory;

use super::file::{Area, AreaKind, Lane, LaneKind, MapFile};

/// Distance between two points of an edge, in metres.
const SPACING_M: f64 = 2.0;

/// A map of one lane and one drivable strip along each drive: from `left_m` to the left of the
/// drive to `right_m` to its right, both above 0. The owner of the twin gives both: a default would
/// be a guess that judges.
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
            let way_m = last_m.map_or(f64::INFINITY, |last_m| pose.position_m.distance(last_m));
            let is_last = index + 1 == count;
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
        let outline = left.iter().chain(right.iter().rev()).copied().collect();
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
