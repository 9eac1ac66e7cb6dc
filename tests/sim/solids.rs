//! Contact with the twin's Gaussians, where a drive meets them.

use glam::{DQuat, DVec3};
use wildcity_scene::ActorBox;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::{Keyframe, Trajectory};
use wildcity_sim::contact::{SolidPoint, Solids, solid_area_m2};
use wildcity_sim::traffic::EgoBox;

const EGO: EgoBox =
    EgoBox { box_: ActorBox { length_m: 4.0, width_m: 2.0, height_m: 1.5 }, center_x_m: 1.3 };

/// A place as far from the origin as the coordinates of a twin may be.
const FAR_M: DVec3 = DVec3::new(4.5e6, -4.5e6, 120.0);

fn pose(x_m: f64, y_m: f64, yaw_rad: f64) -> Pose {
    let position_m = FAR_M + DVec3::new(x_m, y_m, 0.0);
    Pose { position_m, rotation: DQuat::from_rotation_z(yaw_rad) }
}

fn drive() -> Trajectory {
    let keyframe = |k: i64| Keyframe {
        time_us: 1_000_000 * k,
        world_from_rig: pose(10.0 * k as f64, 0.0, 0.0),
    };
    Trajectory { name: "log".to_owned(), keyframes: (0..=4).map(keyframe).collect() }
}

/// A point at the world's axes, 5 cm across.
fn point(x_m: f64, y_m: f64, z_m: f64) -> SolidPoint {
    let mean_m = FAR_M + DVec3::new(x_m, y_m, z_m);
    SolidPoint { mean_m, sigma_m: DVec3::splat(0.05), opacity: 0.9 }
}

/// A wall along the drive, 4 m to its left, of a point each 10 cm: none at the height from which points count.
fn wall() -> Vec<SolidPoint> {
    (0..4000)
        .map(|i| point(0.1 * f64::from(i % 400), 4.0, 0.05 + 0.1 * f64::from(i / 400)))
        .collect()
}

#[test]
fn a_wall_is_met_beside_the_drive_and_not_on_it() {
    let solids = Solids::new(wall(), &[drive()], &EGO);
    assert_eq!(solids.limit().most_on_drive_m2, 0.0);
    assert_eq!(solids.area_m2(&pose(15.0, 0.0, 0.0), &EGO), 0.0);
    let met_m2 = solids.area_m2(&pose(15.0, 3.5, 0.0), &EGO);
    assert!(solids.limit().is_exceeded_by(met_m2), "{met_m2}");
    // Only the front, if the ego turns towards the wall.
    let met_m2 = solids.area_m2(&pose(15.0, 1.9, 0.6), &EGO);
    assert!(solids.limit().is_exceeded_by(met_m2), "{met_m2}");
}

#[test]
fn the_cells_find_what_a_test_of_every_point_finds() {
    let solids = Solids::new(wall(), &[], &EGO);
    for step in 0..60 {
        let pose = pose(0.7 * f64::from(step), 0.1 * f64::from(step), 0.1 * f64::from(step));
        let to_center_m = DVec3::new(EGO.center_x_m, 0.0, 0.0);
        let center = Pose { position_m: pose.transform_point(to_center_m), ..pose };
        let box_from_world = center.inverse();
        let of_ego = wall().into_iter().map(|point| SolidPoint {
            mean_m: box_from_world.transform_point(point.mean_m),
            ..point
        });
        let wanted_m2 = solid_area_m2(of_ego, DVec3::new(4.0, 2.0, 1.5));
        let met_m2 = solids.area_m2(&pose, &EGO);
        // Areas are f32. A centre within a micrometre of the box's side may count for one and not for the other.
        assert!((met_m2 - wanted_m2).abs() < 1e-5, "step {step}: {met_m2} m², {wanted_m2} m²");
    }
}

#[test]
fn what_the_recorded_drive_meets_is_free() {
    // A bush that hangs over the road at 22 m, between two keyframes.
    let bush: Vec<SolidPoint> =
        (0..100).map(|i| point(22.0 + 0.01 * f64::from(i), 0.5, 1.0)).collect();
    let solids = Solids::new(bush.clone(), &[drive()], &EGO);
    let on_drive_m2 = solids.area_m2(&pose(21.0, 0.0, 0.0), &EGO);
    let bush_m2: f64 = bush.iter().map(SolidPoint::area_m2).sum();
    assert!((on_drive_m2 - bush_m2).abs() < 1e-5, "{on_drive_m2}");
    assert!((solids.limit().most_on_drive_m2 - bush_m2).abs() < 1e-5);
    assert!(!solids.limit().is_exceeded_by(on_drive_m2));
    // Without the drive it is a contact.
    assert!(Solids::new(bush, &[], &EGO).limit().is_exceeded_by(on_drive_m2));
}
