//! The recorded drive: even, on the road, and with nothing in its way.

use glam::DVec3;

use super::DEMO;

/// Half width and height of what must be free around the drive, in metres: a car and its mirrors.
const CLEAR_M: (f64, f64) = (1.2, 2.5);

#[test]
fn keyframes_are_half_a_metre_and_a_twentieth_of_a_second_apart() {
    let drive = &DEMO.trajectory;
    assert_eq!(drive.check(), Ok(()));
    assert!(drive.length_m() >= 250.0, "{} m", drive.length_m());
    for pair in drive.keyframes.windows(2) {
        let [from, to] = [pair[0].world_from_rig, pair[1].world_from_rig];
        let step_m = to.position_m - from.position_m;
        assert!((step_m.length() - 0.5).abs() < 1e-3, "{step_m}");
        assert_eq!(pair[1].time_us - pair[0].time_us, 50_000);
        // The rig looks where it goes: within half a step of the path's curve, 0.5 m / 138 m.
        assert!((from.rotation * DVec3::X).angle_between(step_m) < 0.004);
        assert_eq!(from.position_m.z, 0.0);
    }
}

#[test]
fn the_wheels_are_on_asphalt() {
    // Within a car's width of the path there is ground at z = 0 and no kerb.
    let heights_m = along_the_drive(|at_m| at_m.y.abs() < 1.0 && at_m.z.abs() < 0.3);
    for (keyframe, heights_m) in heights_m.iter().enumerate() {
        assert!(heights_m.len() >= 10, "{} surfels at {keyframe}", heights_m.len());
        let highest_m = heights_m.iter().fold(0.0_f64, |high_m, at_m| high_m.max(at_m.z));
        assert!(highest_m < 0.02, "{highest_m} m at {keyframe}");
    }
}

#[test]
fn nothing_stands_in_the_way() {
    let (half_width_m, height_m) = CLEAR_M;
    let ahead =
        along_the_drive(|at_m| at_m.y.abs() < half_width_m && (0.3..height_m).contains(&at_m.z));
    for (keyframe, obstacles) in ahead.iter().enumerate() {
        assert_eq!(obstacles.first(), None, "at {keyframe}");
    }
}

#[test]
fn something_stands_beside_the_way() {
    // The same search finds parked cars a little farther out: it can fail.
    let beside = along_the_drive(|at_m| at_m.y.abs() < 3.0 && (0.3..2.5).contains(&at_m.z));
    let keyframes = beside.iter().filter(|found| !found.is_empty()).count();
    assert!(keyframes > beside.len() / 4, "{keyframes} of {}", beside.len());
}

/// Per fourth keyframe (2 m), the Gaussians that the filter wants, of those at most 1.1 m ahead or
/// behind; centres in the rig's frame, in metres.
fn along_the_drive(wanted: impl Fn(DVec3) -> bool) -> Vec<Vec<DVec3>> {
    let means_m: Vec<_> = DEMO
        .gaussians
        .means_m
        .iter()
        .map(|&mean_m| DVec3::from_array(mean_m))
        .filter(|mean_m| (-0.5..3.0).contains(&mean_m.z))
        .collect();
    let at_keyframe = |world_from_rig: &wildcity_scene::geometry::Pose| {
        let rig_from_world = world_from_rig.inverse();
        means_m
            .iter()
            .filter(|mean_m| mean_m.distance_squared(world_from_rig.position_m) < 25.0)
            .map(|&mean_m| rig_from_world.transform_point(mean_m))
            .filter(|at_m| at_m.x.abs() < 1.1 && wanted(*at_m))
            .collect()
    };
    let keyframes = DEMO.trajectory.keyframes.iter().step_by(4);
    keyframes.map(|keyframe| at_keyframe(&keyframe.world_from_rig)).collect()
}
