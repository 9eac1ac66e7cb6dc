//! Times of two clocks, and poses at times.

use std::f64::consts::FRAC_PI_2;

use glam::{DQuat, DVec3};
use wildcity_scene::route::{Route, RouteError, TimePair, associate};

use super::{drive, straight};

#[test]
fn jittered_times_find_their_own() {
    // A camera every 100 ms against poses every 10 ms that lag by 3 ms and jitter by up to 2.
    let jitter_us = |i: i64| 1000 * ((i * 7) % 5 - 2);
    let poses_us: Vec<i64> = (0..1000).map(|i| 10_000 * i + 3_000 + jitter_us(i)).collect();
    let images_us: Vec<i64> = (0..100).map(|i| 100_000 * i).collect();
    let found = associate(&images_us, &poses_us, 6_000).unwrap();
    assert!(found.unmatched.is_empty());
    for (number, pair) in found.pairs.iter().enumerate() {
        assert_eq!((pair.first, pair.second), (number, 10 * number));
        assert_eq!(pair.residual_us, 3_000 + jitter_us(10 * number as i64));
    }
    // Below the lag there is nothing.
    let none = associate(&images_us, &poses_us, 0).unwrap();
    assert_eq!((none.pairs.len(), none.unmatched.len()), (0, 100));
}

#[test]
fn nothing_is_used_twice() {
    // Two images want the pose at 100; the nearer one has it.
    let found = associate(&[90, 104], &[0, 100], 20).unwrap();
    assert_eq!(found.pairs, [TimePair { first: 1, second: 1, residual_us: -4 }]);
    assert_eq!(found.unmatched, [0]);
    // Equally near: the earlier one.
    let found = associate(&[100], &[90, 110], 20).unwrap();
    assert_eq!(found.pairs, [TimePair { first: 0, second: 0, residual_us: -10 }]);
    // On the tolerance is within it.
    assert_eq!(associate(&[0], &[20], 20).unwrap().pairs.len(), 1);
    assert_eq!(associate(&[0], &[20], 19).unwrap().pairs.len(), 0);
    let nothing = associate(&[], &[1], 5).unwrap();
    assert_eq!((nothing.pairs.len(), nothing.unmatched.len()), (0, 0));
    assert_eq!(associate(&[1], &[], 5).unwrap().unmatched, [0]);
    // Clocks at both ends of time.
    assert_eq!(associate(&[i64::MIN], &[i64::MAX], i64::MAX).unwrap().unmatched, [0]);
}

#[test]
fn times_out_of_order_are_named() {
    let order = |first: &[i64], second: &[i64]| match associate(first, second, 5) {
        Err(RouteError::Order { clock, index, .. }) => (clock, index),
        other => panic!("{other:?}"),
    };
    assert_eq!(order(&[1, 2, 2], &[]), ("first", 2));
    assert_eq!(order(&[], &[5, 4]), ("second", 1));
    let error = associate(&[], &[], -1).unwrap_err();
    assert!(matches!(error, RouteError::Value { field: "tolerance_us", .. }), "{error}");
}

#[test]
fn poses_between_are_linear_and_turn_evenly_and_none_is_beyond() {
    let mut log = drive([(-50, DVec3::ZERO), (50, DVec3::new(10.0, -4.0, 1.0))]);
    log.keyframes[1].world_from_rig.rotation = DQuat::from_rotation_z(FRAC_PI_2);
    let route = Route::new(&log).unwrap();
    for (time_us, t) in [(-50, 0.0), (-25, 0.25), (0, 0.5), (49, 0.99), (50, 1.0)] {
        let pose = route.pose_at(time_us).unwrap();
        assert!((pose.position_m - t * DVec3::new(10.0, -4.0, 1.0)).length() < 1e-12);
        let turned = DQuat::from_rotation_z(t * FRAC_PI_2);
        assert!(pose.rotation.dot(turned).abs() > 1.0 - 1e-12, "at {time_us}");
    }
    for time_us in [-51, 51, i64::MIN, i64::MAX] {
        let refused = route.pose_at(time_us);
        assert!(matches!(refused, Err(RouteError::Outside { from_us: -50, to_us: 50, .. })));
    }
    // The short way round, though the quaternions point apart.
    log.keyframes[1].world_from_rig.rotation = -DQuat::from_rotation_z(FRAC_PI_2);
    let half = Route::new(&log).unwrap().pose_at(0).unwrap();
    let turned = DQuat::from_rotation_z(0.5 * FRAC_PI_2);
    assert!(half.rotation.dot(turned).abs() > 1.0 - 1e-12);

    // On a keyframe it is that keyframe's pose, to the bit.
    let log = straight(10);
    let route = Route::new(&log).unwrap();
    for keyframe in &log.keyframes {
        assert_eq!(route.pose_at(keyframe.time_us).unwrap(), keyframe.world_from_rig);
    }
}
