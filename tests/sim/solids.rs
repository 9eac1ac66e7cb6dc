//! Contact with the twin's Gaussians, where a drive meets them.

use glam::{DQuat, DVec3};
use wildcity_scene::ActorBox;
use wildcity_scene::geometry::Pose;
use wildcity_sim::contact::{SolidPoint, Solids, TestedBox, solid_area_m2};
use wildcity_sim::traffic::EgoBox;

const EGO: EgoBox =
    EgoBox { box_: ActorBox { length_m: 4.0, width_m: 2.0, height_m: 1.5 }, center_x_m: 1.3 };

/// A place as far from the origin as the coordinates of a twin may be.
const FAR_M: DVec3 = DVec3::new(4.5e6, -4.5e6, 120.0);

fn pose(x_m: f64, y_m: f64, yaw_rad: f64) -> Pose {
    let position_m = FAR_M + DVec3::new(x_m, y_m, 0.0);
    Pose { position_m, rotation: DQuat::from_rotation_z(yaw_rad) }
}

/// A point at the world's axes, 5 cm across.
fn point(x_m: f64, y_m: f64, z_m: f64) -> SolidPoint {
    let mean_m = FAR_M + DVec3::new(x_m, y_m, z_m);
    SolidPoint { mean_m, sigma_m: DVec3::splat(0.05), opacity: 0.9 }
}

/// A wall along x, 4 m to the left, of a point in the middle of each cube of 10 cm.
fn wall() -> Vec<SolidPoint> {
    (0..4000)
        .map(|i| point(0.05 + 0.1 * f64::from(i % 400), 4.05, 0.05 + 0.1 * f64::from(i / 400)))
        .collect()
}

fn area_m2(solids: &Solids, pose: &Pose) -> f64 {
    solids.area_m2(&TestedBox::new(pose, &EGO))
}

#[test]
fn a_wall_is_met_beside_the_drive_and_not_on_it() {
    let solids = Solids::new(wall());
    assert_eq!(area_m2(&solids, &pose(15.0, 0.0, 0.0)), 0.0);
    assert!(area_m2(&solids, &pose(15.0, 3.5, 0.0)) > 0.05);
    // Only the front, if the ego turns towards the wall.
    assert!(area_m2(&solids, &pose(15.0, 1.9, 0.6)) > 0.05);
}

/// Whether a point is so near to a side of the tested box that rounding may decide.
fn is_at_side(from_center_m: DVec3) -> bool {
    let sides_m =
        [(from_center_m.x.abs(), 1.9), (from_center_m.y.abs(), 0.9), (from_center_m.z, 0.3)];
    sides_m
        .iter()
        .chain(&[(from_center_m.z, 1.5)])
        .any(|(at_m, side_m)| (at_m - side_m).abs() < 1e-4)
}

#[test]
fn the_cells_find_what_a_test_of_every_point_finds() {
    let solids = Solids::new(wall());
    let mut met = 0;
    for step in 0..60 {
        let level = pose(0.7 * f64::from(step), 0.1 * f64::from(step), 0.1 * f64::from(step));
        // On a slope as well: the box is tilted as the ego is.
        let tilt = DQuat::from_rotation_y(0.02 * f64::from(step - 30));
        let pose = Pose { rotation: level.rotation * tilt, ..level };
        let to_center_m = DVec3::new(EGO.center_x_m, 0.0, 0.0);
        let center = Pose { position_m: pose.transform_point(to_center_m), ..pose };
        let box_from_world = center.inverse();
        let of_ego: Vec<SolidPoint> = wall()
            .into_iter()
            .map(|point| SolidPoint {
                mean_m: box_from_world.transform_point(point.mean_m),
                ..point
            })
            .collect();
        if of_ego.iter().any(|point| is_at_side(point.mean_m)) {
            continue;
        }
        let wanted_m2 = solid_area_m2(of_ego, DVec3::new(4.0, 2.0, 1.5));
        let met_m2 = area_m2(&solids, &pose);
        // Areas are f32.
        assert!((met_m2 - wanted_m2).abs() < 1e-5, "step {step}: {met_m2} m², {wanted_m2} m²");
        met += usize::from(wanted_m2 > 0.0);
    }
    assert!(met > 10, "{met} of the poses meet the wall");
}

#[test]
fn gaussians_of_a_cube_count_together_and_take_the_memory_of_one() {
    // 100 points within 1 cm: as much area as each of them has, in one place.
    let many: Vec<SolidPoint> =
        (0..100).map(|i| point(2.05, 0.05, 1.05 + 1e-4 * f64::from(i))).collect();
    let sum_m2: f64 = many.iter().map(SolidPoint::area_m2).sum();
    let solids = Solids::new(many.clone());
    assert!((area_m2(&solids, &pose(0.0, 0.0, 0.0)) - sum_m2).abs() < 1e-6);
    assert_eq!(solids.bytes(), Solids::new([many[0]]).bytes());
    // What is not solid, and what has no extent, is no obstacle.
    let faint = SolidPoint { opacity: 0.4, ..many[0] };
    let flat = SolidPoint { sigma_m: DVec3::ZERO, ..many[0] };
    assert_eq!(Solids::new([faint, flat]), Solids::default());
}

#[test]
fn an_ego_on_a_slope_does_not_meet_its_own_road() {
    // A road that rises by 15 %, of a point each 10 cm.
    let road: Vec<SolidPoint> = (0..4000)
        .map(|i| {
            let [x_m, y_m] =
                [0.05 + 0.1 * f64::from(i % 200), 0.05 + 0.1 * f64::from(i / 200 - 10)];
            point(x_m, y_m, 0.15 * x_m)
        })
        .collect();
    let solids = Solids::new(road);
    let slope_rad = f64::atan(0.15);
    let position_m = FAR_M + DVec3::new(8.0, 0.0, 0.15 * 8.0);
    let tilted = Pose { position_m, rotation: DQuat::from_rotation_y(-slope_rad) };
    assert_eq!(area_m2(&solids, &tilted), 0.0);
    let upright = Pose { position_m, ..Pose::IDENTITY };
    assert!(area_m2(&solids, &upright) > 0.05, "an upright box has the road in its front");
}
