//! Random displacements of actors, as NeuroNCAP draws them (atonderski/neuro-ncap@ecdcf28,
//! `scenario.py`): uniform within plus and minus a bound, along (cos, sin), to the right of it
//! (sin, -cos), and in heading.

use glam::{DQuat, DVec3};

use wildcity_scene::geometry::Pose;
use wildcity_scene::random::Random;

use super::actor_file::{JitterDraw, JitterSection};
use super::error::{FileError, in_range};

/// The displacement of an actor; nothing without jitter. What a resolved file says was drawn is
/// drawn again.
pub(super) fn drawn(
    section: Option<&JitterSection>,
    seed: u64,
    name: &str,
) -> Result<JitterDraw, FileError> {
    let Some(section) = section else { return Ok(JitterDraw::default()) };
    for (field, value, most) in [
        ("longitudinal_m", section.longitudinal_m, 1000.0),
        ("lateral_m", section.lateral_m, 100.0),
        ("yaw_rad", section.yaw_rad, std::f64::consts::PI),
    ] {
        in_range(&format!("jitter.{field}"), value, [0.0, most])?;
    }
    // A record must repeat the episode even if the generator changes, so a given draw wins over the
    // seed.
    if let Some(drawn) = section.drawn {
        for (field, value, most) in [
            ("longitudinal_m", drawn.longitudinal_m, section.longitudinal_m),
            ("lateral_m", drawn.lateral_m, section.lateral_m),
            ("yaw_rad", drawn.yaw_rad, section.yaw_rad),
        ] {
            in_range(&format!("jitter.drawn.{field}"), value, [-most, most])?;
        }
        return Ok(drawn);
    }
    // A stream for each actor, so that the draws of one do not depend on the others or on their
    // order.
    let mut random = Random::new(seed, &format!("jitter/{name}"), 0);
    let mut within = |most: f64| random.range(-most, most);
    Ok(JitterDraw {
        longitudinal_m: within(section.longitudinal_m),
        lateral_m: within(section.lateral_m),
        yaw_rad: within(section.yaw_rad),
    })
}

/// The displacement in the world of a draw, in metres; `along_rad` is the direction that counts as
/// along.
pub(super) fn displacement_m(drawn: &JitterDraw, along_rad: f64) -> DVec3 {
    let (sin, cos) = along_rad.sin_cos();
    drawn.longitudinal_m * DVec3::new(cos, sin, 0.0) + drawn.lateral_m * DVec3::new(sin, -cos, 0.0)
}

/// A pose after a displacement.
pub(super) fn displaced(pose: &Pose, drawn: &JitterDraw, along_rad: Option<f64>) -> Pose {
    // No change at all, because the product of rotations would be normalised and change in its last
    // bits.
    if *drawn == JitterDraw::default() {
        return *pose;
    }
    let heading_rad = heading_rad(pose);
    let position_m = pose.position_m + displacement_m(drawn, along_rad.unwrap_or(heading_rad));
    // About the world's vertical, to the left of the rotation: a tilted pose keeps its tilt.
    let rotation = DQuat::from_rotation_z(drawn.yaw_rad) * pose.rotation;
    Pose { position_m, rotation: rotation.normalize() }
}

/// The heading of a pose in the world, in radians.
pub(super) fn heading_rad(pose: &Pose) -> f64 {
    let forward = pose.rotation * DVec3::X;
    forward.y.atan2(forward.x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_depend_on_seed_and_name_only_and_stay_within() {
        let section = JitterSection { longitudinal_m: 5.0, lateral_m: 0.5, ..Default::default() };
        let draw = |seed, name| drawn(Some(&section), seed, name).unwrap();
        assert_eq!(draw(7, "target"), draw(7, "target"));
        assert_ne!(draw(7, "target"), draw(8, "target"));
        assert_ne!(draw(7, "target"), draw(7, "other"));
        // The first number of stream 7/jitter/target/0 of the vectors.
        let first = draw(7, "target");
        assert!((first.longitudinal_m - (-5.0 + 10.0 * 0.9325253457952264)).abs() < 1e-12);
        assert_eq!(first.yaw_rad, 0.0);
        // The seed 99 would draw other values, so that equality shows that nothing was drawn.
        let again = JitterSection { drawn: Some(first), ..section };
        assert_eq!(drawn(Some(&again), 99, "target").unwrap(), first);
        // The draw of the lateral displacement exceeds the smaller bound.
        let outside = JitterSection { lateral_m: 0.1, ..again };
        let error = drawn(Some(&outside), 99, "target").unwrap_err();
        assert_eq!(error.path, "jitter.drawn.lateral_m");
    }

    #[test]
    fn a_displacement_is_along_and_to_the_right() {
        // NeuroNCAP's own draw (shared vectors, "jitter: one draw").
        let draw = JitterDraw { longitudinal_m: 4.5, lateral_m: -0.3, yaw_rad: 0.21 };
        let pose = Pose {
            position_m: DVec3::new(718.643, 1436.0, -0.25),
            rotation: DQuat::from_rotation_z(2.27),
        };
        let moved = displaced(&pose, &draw, Some(2.62));
        let expected = DVec3::new(714.5919012607703, 1437.9820693744196, -0.25);
        assert!((moved.position_m - expected).length() < 1e-9, "{}", moved.position_m);
        assert!((heading_rad(&moved) - 2.48).abs() < 1e-12);
    }
}
