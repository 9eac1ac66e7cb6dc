//! A box on the ground of recorded drives.

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_sim::Ground;

use crate::limits;
use crate::object::raised;
use crate::wire::physics::Status;

/// Puts a box on the ground: moves it vertically and tilts it, so that it stands on the ground's
/// plane, and keeps its heading and the x and y of its middle. `world_from_box` is the pose of its
/// middle.
///
/// The pose is returned unchanged, with the reason, if there is no ground at the box, or if it
/// would move by more than [`limits::PHYSICS_TRANSLATION_M`] or rotate by more than
/// [`limits::PHYSICS_ROTATION_RAD`]: AlpaSim's own service does the same.
pub fn on_ground(ground: &Ground<'_>, world_from_box: &Pose, height_m: f64) -> (Pose, Status) {
    match placed(ground, world_from_box, height_m) {
        None => (*world_from_box, Status::InsufficientPointsFitplane),
        Some(there) => match refused(world_from_box, &there) {
            Some(status) => (*world_from_box, status),
            None => (there, Status::SuccessfulUpdate),
        },
    }
}

fn placed(ground: &Ground<'_>, world_from_box: &Pose, height_m: f64) -> Option<Pose> {
    // The ground is searched from the lower face: a bridge and the street below it are
    // distinguished by height.
    let bottom = raised(world_from_box, -0.5 * height_m);
    let on_plane = ground.find(bottom)?;
    // The middle is half the height away from the ground's plane, along its normal, which is not
    // vertical.
    // With p the middle, g a point of the plane, n its normal and h the height, n (p - g) = h / 2.
    // Solved for the z of p: g.z + (h / 2 - n.x (p - g).x - n.y (p - g).y) / n.z.
    let up = on_plane.rotation * DVec3::Z;
    let aside_m = world_from_box.position_m - on_plane.position_m;
    let rise_m = (0.5 * height_m - aside_m.x * up.x - aside_m.y * up.y) / up.z;
    let z_m = on_plane.position_m.z + rise_m;
    Some(Pose { position_m: world_from_box.position_m.with_z(z_m), rotation: on_plane.rotation })
}

fn refused(from: &Pose, to: &Pose) -> Option<Status> {
    if (to.position_m.z - from.position_m.z).abs() > limits::PHYSICS_TRANSLATION_M {
        return Some(Status::HighTranslation);
    }
    // The heading is kept, so that the tilt is the whole rotation.
    let [up_from, up_to] = [from, to].map(|pose| pose.rotation * DVec3::Z);
    let is_turned = up_from.angle_between(up_to) > limits::PHYSICS_ROTATION_RAD;
    is_turned.then_some(Status::HighRotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::Trajectory;
    use wildcity_scene::trajectory::Keyframe;

    const HEIGHT_M: f64 = 1.5;

    /// A drive uphill along x with a slope of 0.1.
    fn uphill() -> Vec<Trajectory> {
        let keyframe = |i: i64| {
            let x_m = 5.0 * i as f64;
            let rotation = DQuat::from_rotation_y(-(0.1f64.atan()));
            let world_from_rig = Pose { position_m: DVec3::new(x_m, 0.0, 0.1 * x_m), rotation };
            Keyframe { time_us: i, world_from_rig }
        };
        vec![Trajectory { name: "log".into(), keyframes: (0..=10).map(keyframe).collect() }]
    }

    fn at(x_m: f64, y_m: f64, z_m: f64, rotation: DQuat) -> Pose {
        Pose { position_m: DVec3::new(x_m, y_m, z_m), rotation }
    }

    #[test]
    fn a_box_stands_on_the_slope_with_its_heading_and_place() {
        let drives = uphill();
        let ground = Ground::from_drives(&drives);
        // Along the drive, and turned from it; on the ground, above and below it by less than 1.5
        // m. The slope of 0.1 at x = 20 m is 2 m high.
        for (yaw_rad, above_m) in [(0.0, 0.0), (0.3, 0.9), (2.5, -0.4)] {
            let level =
                at(20.0, 2.0, 2.0 + 0.5 * HEIGHT_M + above_m, DQuat::from_rotation_z(yaw_rad));
            let (there, status) = on_ground(&ground, &level, HEIGHT_M);
            assert_eq!(status, Status::SuccessfulUpdate);
            assert_eq!(there.position_m.truncate(), level.position_m.truncate());
            // The middle of the lower face is on the plane z = 0.1 x, and the box is along its
            // normal.
            let bottom = raised(&there, -0.5 * HEIGHT_M).position_m;
            assert!((bottom.z - 0.1 * bottom.x).abs() < 1e-9, "{bottom}");
            let up = there.rotation * DVec3::Z;
            assert!((up - DVec3::new(-0.1, 0.0, 1.0).normalize()).length() < 1e-9, "{up}");
            let forward = there.rotation * DVec3::X;
            let turned = forward.truncate().angle_to(glam::DVec2::from_angle(yaw_rad));
            // A tilt of 0.1 changes a heading in the plane by up to 0.1^2 / 4 = 0.0025 rad.
            assert!(turned.abs() < 0.01, "{forward}");
            let (again, _) = on_ground(&ground, &there, HEIGHT_M);
            assert!((again.position_m - there.position_m).length() < 1e-9);
        }
    }

    #[test]
    fn implausible_corrections_are_refused_with_a_reason() {
        let drives = uphill();
        let ground = Ground::from_drives(&drives);
        let flat = DQuat::IDENTITY;
        // 1.6 m are more than the 1.5 m that a box may move, and 0.2 rad sideways with 0.1 uphill
        // are 0.22, more than 0.17. 80 m aside there is no ground.
        let high = at(20.0, 0.0, 2.0 + 0.5 * HEIGHT_M + 1.6, flat);
        let low = at(20.0, 0.0, 2.0 + 0.5 * HEIGHT_M - 1.6, flat);
        let tilted = at(20.0, 0.0, 2.0 + 0.5 * HEIGHT_M, DQuat::from_rotation_x(0.2));
        let far = at(20.0, 80.0, 2.0, flat);
        for (pose, reason) in [
            (high, Status::HighTranslation),
            (low, Status::HighTranslation),
            (tilted, Status::HighRotation),
            (far, Status::InsufficientPointsFitplane),
        ] {
            assert_eq!(on_ground(&ground, &pose, HEIGHT_M), (pose, reason));
        }
        let bare = Ground::from_drives(&[]);
        assert_eq!(on_ground(&bare, &high, HEIGHT_M).1, Status::InsufficientPointsFitplane);
    }
}
