//! Routes: stations, chunks, pieces and clocks, against drives whose answers are known; the ground
//! of captures.

#[path = "../support/drives.rs"]
mod drives;

mod clock;
mod ground;

use std::f64::consts::{PI, TAU};

use drives::{drive, straight};
use glam::DVec3;
use wildcity_scene::Trajectory;
use wildcity_scene::route::{Route, RouteError, SUB_TRAJECTORY_LENGTHS_M, sub_trajectories};

#[test]
fn stations_of_a_circle_are_its_arc() {
    // 3,600 chords of a circle of 100 m: each is 2 r sin(π / 3600) long.
    let at = |i: i64| TAU * i as f64 / 3600.0;
    let circle = drive((0..=3600).map(|i| {
        (1000 * i, 100.0 * DVec3::new(at(i).cos(), at(i).sin(), 0.0) + DVec3::new(2e4, -3e4, 0.0))
    }));
    let route = Route::new(&circle).unwrap();
    let chord_m = 200.0 * (PI / 3600.0).sin();
    for (index, station_m) in route.stations_m().iter().enumerate() {
        assert!((station_m - chord_m * index as f64).abs() < 1e-7, "{station_m} at {index}");
    }
    assert!((route.length_m() - 200.0 * PI).abs() < 1e-3);
    // A quarter of the way is a quarter of the circle.
    let quarter = route.at(0.25 * route.length_m());
    let from_m = quarter.world_from_rig.position_m - DVec3::new(2e4, -3e4 + 100.0, 0.0);
    assert!(from_m.length() < 1e-6, "{from_m}");
    assert!((quarter.time_us - 900_000).abs() <= 1);
}

#[test]
fn stations_clamp_and_standing_still_is_no_distance() {
    let east = |m: f64| DVec3::new(m, 0.0, 0.0);
    let log = drive([
        (0, east(0.0)),
        (10, east(0.0)),
        (20, east(2.0)),
        (30, east(2.0)),
        (40, east(2.0)),
        (50, east(3.0)),
    ]);
    let route = Route::new(&log).unwrap();
    assert_eq!(route.stations_m(), [0.0, 0.0, 2.0, 2.0, 2.0, 3.0]);
    // Where it stood, the moment it got there.
    let moment = |station_m: f64| {
        let at = route.at(station_m);
        (at.time_us, at.world_from_rig.position_m.x)
    };
    assert_eq!(moment(-1.0), (0, 0.0));
    assert_eq!(moment(1.0), (15, 1.0));
    assert_eq!(moment(2.0), (20, 2.0));
    assert_eq!(moment(2.5), (45, 2.5));
    assert_eq!(moment(9.0), (50, 3.0));

    let stood = drive([(0, east(5.0)), (10, east(5.0))]);
    let route = Route::new(&stood).unwrap();
    assert_eq!((route.length_m(), route.chunks().len()), (0.0, 1));
    assert_eq!(route.at(1.0).world_from_rig.position_m, east(5.0));
    assert_eq!(sub_trajectories(&route, 50.0, 50.0).unwrap().count(), 0);
}

#[test]
fn chunks_are_5_km_and_hold_every_keyframe_once() {
    let log = straight(12_000);
    let chunks = Route::new(&log).unwrap().chunks();
    let of = |i: usize| (chunks[i].number, chunks[i].keyframes.clone(), chunks[i].stations_m);
    assert_eq!(chunks.len(), 3);
    assert_eq!(of(0), (0, 0..5000, [0.0, 4999.0]));
    assert_eq!(of(1), (1, 5000..10_000, [5000.0, 9999.0]));
    assert_eq!(of(2), (2, 10_000..12_001, [10_000.0, 12_000.0]));
    // A leap over a chunk leaves it out.
    let leap = drive([(0, DVec3::ZERO), (1, DVec3::new(0.0, 11_000.0, 0.0))]);
    let numbers: Vec<_> = Route::new(&leap).unwrap().chunks().iter().map(|c| c.number).collect();
    assert_eq!(numbers, [0, 2]);
}

#[test]
fn a_subsampled_drive_is_recorded_poses_half_a_metre_apart() {
    // 0.2 m a keyframe, and a while of standing still whose position jitters by a centimetre.
    let mut at_m = 0.0;
    let log = drive((0..400).map(|i| {
        let standing = (100..300).contains(&i);
        at_m += if standing { 0.0 } else { 0.2 };
        let jitter_m = if standing { 0.01 * f64::from(i as i32 % 3 - 1) } else { 0.0 };
        (10 * i, DVec3::new(at_m, jitter_m, 0.0))
    }));
    let kept = Route::new(&log).unwrap().subsample(0.5).unwrap();
    assert_eq!(kept.check(), Ok(()));
    assert!(kept.keyframes.iter().all(|keyframe| log.keyframes.contains(keyframe)));
    assert_eq!(kept.keyframes[0], log.keyframes[0]);
    for pair in kept.keyframes.windows(2) {
        let step_m = pair[0].world_from_rig.position_m.distance(pair[1].world_from_rig.position_m);
        assert!((0.4995..0.7).contains(&step_m), "{step_m}");
    }
    // 40 m in steps of 0.6 m.
    assert!((65..=68).contains(&kept.keyframes.len()), "{}", kept.keyframes.len());

    // Half a metre of rounded numbers is half a metre.
    let even = drive((0..100).map(|i| (i, DVec3::new(1e4 + 0.1 * (5 * i) as f64, 0.0, 0.0))));
    assert_eq!(Route::new(&even).unwrap().subsample(0.5).unwrap(), even);
}

#[test]
fn pieces_are_as_long_as_asked_and_meet() {
    // Keyframes of 0.3 m, which no length is a multiple of; the world far from the origin.
    let log = drive((0..20_000).map(|i| (30_000 * i, DVec3::new(4e4, 0.3 * i as f64, 10.0))));
    let route = Route::new(&log).unwrap();
    for (length_m, count) in SUB_TRAJECTORY_LENGTHS_M.into_iter().zip([119, 23, 11, 5, 2, 1]) {
        let pieces: Vec<_> =
            sub_trajectories(&route, length_m, length_m).unwrap().map(Result::unwrap).collect();
        assert_eq!(pieces.len(), count, "of {length_m} m");
        for (number, piece) in pieces.iter().enumerate() {
            let keyframes = &piece.trajectory.keyframes;
            assert!((piece.trajectory.length_m() - length_m).abs() < 1e-6);
            assert_eq!(piece.stations_m, [0.0, 1.0].map(|t| length_m * (number as f64 + t)));
            assert_eq!(keyframes[0].time_us, 0);
            // 10 m/s, and in the drive's own world.
            let at_m = keyframes[0].world_from_rig.position_m;
            assert!((at_m - DVec3::new(4e4, piece.stations_m[0], 10.0)).length() < 1e-6);
            assert!((piece.from_us as f64 - 1e5 * piece.stations_m[0]).abs() <= 1.0);
        }
        for pair in pieces.windows(2) {
            let (last, first) =
                (pair[0].trajectory.keyframes.last(), pair[1].trajectory.keyframes[0]);
            assert_eq!(last.unwrap().world_from_rig, first.world_from_rig);
        }
    }
    let named = |length_m| {
        let last = sub_trajectories(&route, length_m, length_m).unwrap().last().unwrap().unwrap();
        last.trajectory.name
    };
    assert_eq!([named(250.0), named(2500.0)], ["log-250m-0022", "log-2.5km-0001"]);

    // With a stride they overlap.
    let starts: Vec<f64> = sub_trajectories(&route, 5000.0, 400.0)
        .unwrap()
        .map(|piece| piece.unwrap().stations_m[0])
        .collect();
    assert_eq!(starts, [0.0, 400.0, 800.0]);
}

#[test]
fn what_is_no_length_is_refused() {
    let log = straight(100);
    let route = Route::new(&log).unwrap();
    let field = |error: RouteError| match error {
        RouteError::Value { field, .. } => field,
        other => panic!("{other}"),
    };
    let cut =
        |length_m, stride_m| sub_trajectories(&route, length_m, stride_m).map(Iterator::count);
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(field(cut(bad, 50.0).unwrap_err()), "length_m");
        assert_eq!(field(cut(50.0, bad).unwrap_err()), "stride_m");
        assert_eq!(field(route.subsample(bad).unwrap_err()), "step_m");
    }
    // A stride of nothing would be pieces without end.
    assert_eq!(field(cut(50.0, 1e-300).unwrap_err()), "stride_m");

    let mut unsorted = straight(100);
    unsorted.keyframes.swap(3, 4);
    assert!(matches!(Route::new(&unsorted), Err(RouteError::Trajectory(_))));
    let long = Trajectory { name: "a".repeat(60), ..straight(100) };
    let error = sub_trajectories(&Route::new(&long).unwrap(), 50.0, 50.0).unwrap().next().unwrap();
    assert!(matches!(error, Err(RouteError::Trajectory(_))), "{error:?}");
}
