//! Actions that depend on another actor's motion: a distance that is kept, and an arrival with
//! another.

use glam::DVec3;
use wildcity_scene::geometry::Pose;

use super::condition::References;
use super::error::{FileError, in_range};
use super::script_file::{ArriveTogetherSection, KeepDistanceSection, SideSection};
use crate::limits;
use crate::traffic::{ArriveTogether, Bounds, FinalSpeed, Gap, KeepDistance, Side};

/// The action of a section of an actor, whose index is `own`.
pub(super) fn keep_distance(
    section: &KeepDistanceSection,
    (references, own): (&References<'_>, usize),
) -> Result<KeepDistance, FileError> {
    let gap = match (section.gap_m, section.headway_s) {
        (Some(gap_m), None) => Gap::Length(in_range("gap_m", gap_m, [0.0, 1e4])?),
        (None, Some(time_s)) => Gap::Headway(in_range("headway_s", time_s, [0.0, 60.0])?),
        _ => return Err(FileError::new("gap_m", "write exactly one of gap_m and headway_s")),
    };
    let most_mps2 = limits::ACTOR_ACCELERATION_M_S2;
    // The acceleration decides between a motion with limits and a jump, so half of the pair is a
    // mistake.
    let bounds = match (section.acceleration, section.braking) {
        (Some(acceleration), Some(braking)) => Some(Bounds {
            acceleration_mps2: in_range("acceleration", acceleration, [0.01, most_mps2])?,
            braking_mps2: in_range("braking", braking, [0.01, most_mps2])?,
            speed_mps: match section.fastest {
                Some(fastest) => in_range("fastest", fastest, [0.0, limits::ACTOR_SPEED_M_S])?,
                None => limits::ACTOR_SPEED_M_S,
            },
        }),
        // A largest speed without the other limits would not apply to a jump.
        (None, None) if section.fastest.is_none() => None,
        _ => {
            let message = "write both acceleration and braking, or neither of them and no fastest";
            return Err(FileError::new("acceleration", message));
        }
    };
    Ok(KeepDistance {
        of: other(section.of.as_deref(), (references, own))?,
        gap,
        side: section.side.map(|side| match side {
            SideSection::Behind => Side::Behind,
            SideSection::Ahead => Side::Ahead,
        }),
        is_free: section.free.unwrap_or(false),
        is_on_course: section.on_course.unwrap_or(false),
        ahead_m: ahead_m("ahead_m", section.ahead_m)?,
        to_ahead_m: ahead_m("to_ahead_m", section.to_ahead_m)?,
        is_once: section.once.unwrap_or(false),
        bounds,
    })
}

/// The action of a section of an actor, whose index is `own`.
pub(super) fn arrive_together(
    section: &ArriveTogetherSection,
    (references, own): (&References<'_>, usize),
) -> Result<ArriveTogether, FileError> {
    let most_mps = limits::ACTOR_SPEED_M_S;
    let speed = match (section.speed, section.factor, section.delta) {
        (None, None, None) => None,
        (Some(speed), None, None) => {
            Some(FinalSpeed::Absolute(in_range("speed", speed, [0.0, most_mps])?))
        }
        // The speed relative to the other's at the time of arrival: each part has a neutral
        // default.
        (None, factor, delta) => Some(FinalSpeed::Relative {
            factor: in_range("factor", factor.unwrap_or(1.0), [0.0, 100.0])?,
            delta_mps: in_range("delta", delta.unwrap_or(0.0), [-most_mps, most_mps])?,
        }),
        _ => return Err(FileError::new("speed", "write speed, or factor and delta")),
    };
    let steady_m = in_range("steady_m", section.steady_m.unwrap_or(0.0), [0.0, 1e4])?;
    // Without a final speed there is none to hold over the last metres.
    if steady_m > 0.0 && speed.is_none() {
        return Err(FileError::new("steady_m", "needs the speed of the arrival: write speed"));
    }
    let within =
        |field: &str, value: Option<f64>| in_range(field, value.unwrap_or(0.0), [0.0, 1e3]);
    Ok(ArriveTogether {
        at_m: point("at", section.at)?,
        of: other(section.of.as_deref(), (references, own))?,
        of_at_m: point("of_at", section.of_at)?,
        ahead_m: ahead_m("ahead_m", section.ahead_m)?,
        to_ahead_m: ahead_m("to_ahead_m", section.to_ahead_m)?,
        speed,
        steady_m,
        within_m: within("within_m", section.within_m)?,
        of_within_m: within("of_within_m", section.of_within_m)?,
    })
}

/// The index of another actor; `None` for the ego.
fn other(
    name: Option<&str>,
    (references, own): (&References<'_>, usize),
) -> Result<Option<usize>, FileError> {
    let Some(name) = name else { return Ok(None) };
    let index = references.actor("of", name)?;
    if index == own {
        let message = format!("{name:?} is this actor itself; name another, or none for the ego");
        return Err(FileError::new("of", message));
    }
    Ok(Some(index))
}

fn ahead_m(field: &str, value: Option<f64>) -> Result<f64, FileError> {
    in_range(field, value.unwrap_or(0.0), [-100.0, 100.0])
}

fn point(field: &str, xyz: [f64; 3]) -> Result<DVec3, FileError> {
    let most_m = Pose::MAX_COORDINATE_M;
    for (axis, value) in xyz.iter().enumerate() {
        in_range(&format!("{field}[{axis}]"), *value, [-most_m, most_m])?;
    }
    Ok(DVec3::from_array(xyz))
}
