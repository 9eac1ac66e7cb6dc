//! Collision courses: through timed positions, or straight towards a place on a recorded drive.

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;

use super::actor_file::{CollideSection, JitterDraw};
use super::around::{Surroundings, drive_named};
use super::error::{FileError, in_range};
use super::jitter::{displaced, displacement_m, heading_rad};
use crate::limits;
use crate::traffic::{Track, TrackKeyframe};

/// The track of a collision course, displaced by its jitter.
pub(super) fn collide_from(
    section: &CollideSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    match (&section.positions, &section.along) {
        (Some(_), None) => through_positions(section, drawn, along_rad, around),
        (None, Some(name)) => meeting(section, name, drawn, along_rad, around),
        _ => Err(FileError::new("positions", "write exactly one of positions and along")),
    }
}

/// Through timed positions, all displaced alike.
fn through_positions(
    section: &CollideSection,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    let positions = section.positions.as_deref().unwrap_or_default();
    if !(1..=limits::POSITIONS).contains(&positions.len()) {
        let message = format!("{}; 1 to {} are accepted", positions.len(), limits::POSITIONS);
        return Err(FileError::new("positions", message));
    }
    let mut points_m = Vec::with_capacity(positions.len());
    let mut times_us: Vec<i64> = Vec::with_capacity(positions.len());
    for (index, position) in positions.iter().enumerate() {
        let path = format!("positions[{index}]");
        let end_s = limits::END_S;
        // Before the start of the episode is allowed: the actor may be on its way at time 0.
        let time_s = in_range(&format!("{path}.time_s"), position.time_s, [-end_s, end_s])?;
        let time_us = (time_s * 1e6).round() as i64;
        // Compared after rounding, because two times within the same microsecond have no speed
        // between them.
        if times_us.last().is_some_and(|before_us| time_us <= *before_us) {
            let message = format!("{time_s:?} s; later than the position before it is accepted");
            return Err(FileError::new(format!("{path}.time_s"), message));
        }
        times_us.push(time_us);
        let pose = Pose::checked(position.xyz, [1.0, 0.0, 0.0, 0.0]).map_err(|error| {
            FileError::new(format!("{path}.{}", error.field()), error.to_string())
        })?;
        points_m.push(pose.position_m);
    }
    let yaw_rad = in_range("yaw_rad", section.yaw_rad.unwrap_or(0.0), [-100.0, 100.0])?;
    // The jitter needs one direction for all positions, so that the shape of the way stays.
    let first_rad = facing_rad(&points_m, 0).unwrap_or(yaw_rad);
    let shift_m = displacement_m(drawn, along_rad.unwrap_or(first_rad));
    let ground = around.ground();
    let mut heading_rad = first_rad;
    let keyframes =
        points_m.iter().zip(&times_us).enumerate().map(|(index, (point_m, time_us))| {
            // An actor that stands keeps its heading; the first one has the given heading.
            heading_rad = facing_rad(&points_m, index).unwrap_or(heading_rad);
            let rotation = DQuat::from_rotation_z(heading_rad + drawn.yaw_rad);
            let pose = Pose { position_m: *point_m + shift_m, rotation };
            TrackKeyframe { time_us: *time_us, world_from_actor: ground.place(pose) }
        });
    track_from(keyframes.collect())
}

/// The direction of the motion at a point: towards the next point; at the last, from the previous
/// one.
fn facing_rad(points_m: &[DVec3], index: usize) -> Option<f64> {
    let last = points_m.len() - 1;
    // Central differences would turn the actor before it reaches a corner.
    let way_m = match index == last {
        false => points_m[index + 1] - points_m[index],
        true if last == 0 => return None,
        true => points_m[last] - points_m[last - 1],
    };
    // Below 1 mm the direction is rounding and not motion.
    (way_m.truncate().length() > 1e-3).then(|| way_m.y.atan2(way_m.x))
}

/// A straight line at constant speed that meets a recorded drive at a place and a time.
fn meeting(
    section: &CollideSection,
    name: &str,
    drawn: &JitterDraw,
    along_rad: Option<f64>,
    around: &Surroundings<'_>,
) -> Result<Track, FileError> {
    let drive = drive_named("along", name, around.drives)?;
    let needed = |field: &str, value: Option<f64>| {
        value.ok_or_else(|| FileError::new(field, "is missing; write it beside along"))
    };
    let given_m = needed("station_m", section.station_m)?;
    let station_m = in_range("station_m", given_m, [0.0, drive.length_m()])?;
    let time_s = in_range("time_s", needed("time_s", section.time_s)?, [0.0, 3600.0])?;
    let angle_rad = in_range("angle_rad", needed("angle_rad", section.angle_rad)?, [-10.0, 10.0])?;
    let given_mps = needed("speed", section.speed)?;
    let speed_mps = in_range("speed", given_mps, [0.0, limits::ACTOR_SPEED_M_S])?;
    let meeting = drive.at_station(station_m);
    let turned = meeting.rotation * DQuat::from_rotation_z(angle_rad);
    let crossing = Pose { rotation: turned.normalize(), ..meeting };
    // Without a direction, along is the heading of the actor itself, after it was turned.
    let meeting = displaced(&crossing, drawn, Some(along_rad.unwrap_or(heading_rad(&crossing))));
    let ahead = meeting.rotation * DVec3::X;
    let at = |time_us: i64| {
        let way_m = speed_mps * (time_us as f64 * 1e-6 - time_s) * ahead;
        let world_from_actor = Pose { position_m: meeting.position_m + way_m, ..meeting };
        TrackKeyframe { time_us, world_from_actor }
    };
    // As long again after the meeting, and at least 10 s.
    let end_us = ((2.0 * time_s).max(time_s + 10.0) * 1e6).round() as i64;
    track_from(vec![at(0), at(end_us)])
}

fn track_from(keyframes: Vec<TrackKeyframe>) -> Result<Track, FileError> {
    Track::new(keyframes)
        // A collision course stands before its first and after its last keyframe; a plain track
        // would be absent.
        .map(Track::held)
        .map_err(|error| FileError::new("positions", error.to_string()))
}
