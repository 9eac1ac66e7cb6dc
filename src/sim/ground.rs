//! The ground under cars and pedestrians: recorded drives, and the lanes of a map where no drive is
//! near.
//!
//! A rig's origin is on the ground under its rear axle, and its z axis is normal to the ground. So
//! every keyframe of a recorded drive defines a ground plane: through its origin, perpendicular to
//! its z axis. This needs only the manifest and works for every twin with a drive. The Gaussians
//! represent surfaces, most of which are not ground, and classifying them would be a guess.
//!
//! A scenario may have a map. Its lanes for vehicles define the ground where no drive is near: a
//! drive was on the road, a map may be off by its survey. Where neither is near there is no ground,
//! and a car stays in its own plane.

use glam::{DQuat, DVec3};

use crate::limits;
use crate::map::LaneSurface;
use crate::plane::Plane;
use wildcity_scene::Trajectory;
use wildcity_scene::boxes::{BoxTree, Extent};
use wildcity_scene::geometry::Pose;

/// The ground defined by recorded drives and lanes.
#[derive(Clone, Copy, Debug)]
pub struct Ground<'a> {
    drives: &'a [Trajectory],
    /// The boxes of the drives; without them, every keyframe is tested.
    boxes: Option<&'a DriveBoxes>,
    lanes: Option<&'a LaneSurface>,
}

/// Where the parts of recorded drives are: with it, placing a pose does not test every keyframe.
#[derive(Clone, Debug, Default)]
pub struct DriveBoxes(Vec<BoxTree>);

impl DriveBoxes {
    /// The boxes of the parts between the keyframes of drives.
    pub fn new(drives: &[Trajectory]) -> Self {
        Self(drives.iter().map(|drive| BoxTree::new(parts(drive).map(extent))).collect())
    }

    /// Bytes that they take.
    pub fn bytes(&self) -> usize {
        self.0.iter().map(BoxTree::bytes).sum()
    }
}

/// Each keyframe with the one before it. The first is paired with itself, so that a drive of one
/// keyframe counts as a point.
fn parts(drive: &Trajectory) -> impl Iterator<Item = (&Pose, &Pose)> {
    let poses = drive.keyframes.iter().map(|keyframe| &keyframe.world_from_rig);
    let before = poses.clone().take(1).chain(poses.clone());
    before.zip(poses)
}

fn extent((from, to): (&Pose, &Pose)) -> Extent {
    Extent::from_line(from.position_m, to.position_m)
}

impl<'a> Ground<'a> {
    /// The ground of some recorded drives.
    pub fn from_drives(drives: &'a [Trajectory]) -> Self {
        Self { drives, boxes: None, lanes: None }
    }

    /// This ground, found by the boxes of its drives.
    pub fn with_boxes(self, boxes: &'a DriveBoxes) -> Self {
        Self { boxes: Some(boxes), ..self }
    }

    /// This ground, and that of lanes where no drive is near.
    pub fn and_lanes(self, lanes: Option<&'a LaneSurface>) -> Self {
        Self { lanes, ..self }
    }

    /// Places a pose (`world_from_rig`) on the ground: moves it vertically onto the ground plane
    /// and tilts it to the plane's normal, keeping its heading. A pose farther than
    /// [`limits::GROUND_NEAR_M`] from every drive and lane is returned unchanged.
    ///
    /// The plane is that of the nearest drive in 3D, so a bridge and the street below it are
    /// distinguished; of the nearest lane if no drive is that near. Between keyframes, and between
    /// points of a lane, it is interpolated. Without boxes, every keyframe is tested: 170,000 take
    /// a millisecond.
    pub fn place(&self, world_from_rig: Pose) -> Pose {
        self.find(world_from_rig).unwrap_or(world_from_rig)
    }

    /// As [`Ground::place`]; `None` for a pose that it leaves unchanged because there is no ground,
    /// or no heading.
    pub fn find(&self, world_from_rig: Pose) -> Option<Pose> {
        let point_m = world_from_rig.position_m;
        // A drive wins even if a lane is nearer: it was on the road, and a map may be off.
        if let Some(plane) = self.drives_plane(point_m) {
            // No fall-back to the lanes here: a drive that is near but not usable leaves the pose
            // as it is.
            return plane.place(world_from_rig);
        }
        let plane = self.lanes?.plane_near(point_m, limits::GROUND_NEAR_M)?;
        if plane.up == DVec3::Z && is_upright(world_from_rig.rotation) {
            // A flat map changes no orientation, not even by rounding.
            let position_m = DVec3::new(point_m.x, point_m.y, plane.point_m.z);
            return Some(Pose { position_m, ..world_from_rig });
        }
        plane.place(world_from_rig)
    }

    fn drives_plane(&self, point_m: DVec3) -> Option<Plane> {
        let mut nearest_m = limits::GROUND_NEAR_M;
        let mut under = None;
        let mut test = |(from, to): (&'a Pose, &'a Pose)| {
            let way_m = to.position_m - from.position_m;
            let along = (point_m - from.position_m).dot(way_m) / way_m.length_squared().max(1e-12);
            let t = along.clamp(0.0, 1.0);
            let distance_m = (from.position_m + t * way_m).distance(point_m);
            if distance_m < nearest_m {
                nearest_m = distance_m;
                under = Some((from, to, t));
            }
            nearest_m
        };
        let away_m = |extent: &Extent| extent.away_m(point_m).length();
        let mut bound_m = limits::GROUND_NEAR_M;
        for (index, drive) in self.drives.iter().enumerate() {
            let Some(boxes) = self.boxes.and_then(|boxes| boxes.0.get(index)) else {
                parts(drive).for_each(|part| bound_m = test(part));
                continue;
            };
            let pose = |at: usize| &drive.keyframes[at].world_from_rig;
            boxes.visit(0..drive.keyframes.len(), bound_m, &away_m, &mut |at| {
                bound_m = test((pose(at.saturating_sub(1)), pose(at)));
                bound_m
            });
        }
        // Only the winner is interpolated, because a rotation costs more than a distance.
        let (from, to, t) = under?;
        let pose = from.interpolate(to, t);
        Some(Plane { point_m: pose.position_m, up: pose.rotation * DVec3::Z })
    }
}

/// Whether the z axis is exactly vertical.
fn is_upright(rotation: DQuat) -> bool {
    let up = rotation * DVec3::Z;
    up.x == 0.0 && up.y == 0.0 && up.z > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::SurfacePoint;
    use wildcity_scene::trajectory::Keyframe;

    /// A bridge uphill along x with a slope of 0.1, above a level street along y.
    fn drives() -> Vec<Trajectory> {
        let drive = |name: &str, pose: &dyn Fn(i64) -> Pose| {
            let keyframe = |i| Keyframe { time_us: i, world_from_rig: pose(i) };
            Trajectory { name: name.into(), keyframes: (0..=10).map(keyframe).collect() }
        };
        let slope_rad = 0.1f64.atan();
        let bridge = |i: i64| {
            let x_m = 5.0 * i as f64;
            let rotation = DQuat::from_rotation_y(-slope_rad);
            Pose { position_m: DVec3::new(x_m, 0.0, 8.0 + 0.1 * x_m), rotation }
        };
        let street = |i: i64| Pose {
            position_m: DVec3::new(25.0, 5.0 * i as f64 - 25.0, 0.0),
            rotation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
        };
        vec![drive("bridge", &bridge), drive("street", &street)]
    }

    #[test]
    fn the_rig_stands_level_on_the_slope_beside_the_drive() {
        let drives = drives();
        let at = |position_m| Pose { position_m, rotation: DQuat::from_rotation_z(0.3) };
        // 0.1 · 12 m + 8 m = 9.2 m, for every y: the bridge is level across.
        let settled = Ground::from_drives(&drives).place(at(DVec3::new(12.0, 3.0, 9.0)));
        assert!((settled.position_m - DVec3::new(12.0, 3.0, 9.2)).length() < 1e-12, "{settled:?}");
        let up = settled.rotation * DVec3::Z;
        let wanted = DVec3::new(-0.1, 0.0, 1.0).normalize();
        assert!((up - wanted).length() < 1e-12, "{up}");
        let forward = settled.rotation * DVec3::X;
        assert!((forward.y.atan2(forward.x) - 0.3).abs() < 0.01, "{forward}");
        // Placing is idempotent: each step starts from the result of the previous one.
        let again = Ground::from_drives(&drives).place(settled);
        assert!((again.position_m - settled.position_m).length() < 1e-12);
    }

    #[test]
    fn a_bridge_is_not_the_street_below_it() {
        let drives = drives();
        let height_m = |z_m| {
            let position_m = DVec3::new(25.0, 0.0, z_m);
            Ground::from_drives(&drives).place(Pose { position_m, ..Pose::IDENTITY }).position_m.z
        };
        // At x = 25 m the bridge is at 10.5 m. From z = 1 m the street is nearer than it.
        assert!((height_m(9.0) - 10.5).abs() < 1e-12 && height_m(1.0).abs() < 1e-12);
    }

    #[test]
    fn a_pose_far_from_every_drive_is_unchanged() {
        let drives = drives();
        let far = Pose { position_m: DVec3::new(0.0, 500.0, 3.0), ..Pose::IDENTITY };
        assert_eq!(Ground::from_drives(&drives).place(far), far);
        assert_eq!(Ground::from_drives(&[]).place(far), far);
        assert_eq!(Ground::from_drives(&drives).find(far), None);
        // A rig that looks straight up has no heading on the street.
        let upwards = Pose {
            position_m: DVec3::new(25.0, 0.0, 0.5),
            rotation: DQuat::from_rotation_y(-std::f64::consts::FRAC_PI_2),
        };
        assert_eq!(Ground::from_drives(&drives).find(upwards), None);
        assert_eq!(Ground::from_drives(&drives).place(upwards), upwards);
    }

    #[test]
    fn lanes_are_the_ground_where_no_drive_is_near() {
        let drives = drives();
        let up = DVec3::new(0.0, -0.06, 1.0).normalize();
        let point =
            |y_m: f64| SurfacePoint { position_m: DVec3::new(0.0, y_m, 1.0 + 0.06 * y_m), up };
        let lanes = LaneSurface::from_lines([vec![point(-100.0), point(100.0)]]);
        let ground = Ground::from_drives(&drives).and_lanes(Some(&lanes));
        let at = |y_m: f64| {
            let rotation = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
            ground.place(Pose { position_m: DVec3::new(0.0, y_m, 5.0), rotation })
        };
        // The bridge begins 3 m above the lane's origin.
        assert!((at(0.0).position_m.z - 8.0).abs() < 1e-12);
        let placed = at(60.0);
        // 1 m + 0.06 · 60 m = 4.6 m. The bridge is farther than 25 m away.
        assert!((placed.position_m.z - 4.6).abs() < 1e-12, "{placed:?}");
        let ahead = placed.rotation * DVec3::X;
        assert!((ahead.z / ahead.y - 0.06).abs() < 1e-12 && ahead.x.abs() < 1e-12, "{ahead}");
        // At y = 200 m the end of the lane is 100 m away.
        assert_eq!(at(200.0).position_m.z, 5.0);
    }

    /// Frame hashes of episodes on flat maps depend on it.
    #[test]
    fn a_flat_lane_changes_no_bit_of_an_upright_pose() {
        let point = |x_m: f64| SurfacePoint { position_m: DVec3::X * x_m, up: DVec3::Z };
        let lanes = LaneSurface::from_lines([vec![point(0.0), point(50.0)]]);
        let ground = Ground::from_drives(&[]).and_lanes(Some(&lanes));
        for heading_rad in [0.0, 0.3, 1.9, -2.7] {
            let rotation = DQuat::from_rotation_z(heading_rad);
            let pose = Pose { position_m: DVec3::new(7.3, 2.1, 0.0), rotation };
            assert_eq!(ground.find(pose), Some(pose));
            let tilted = Pose { rotation: rotation * DQuat::from_rotation_y(0.1), ..pose };
            let up = ground.place(tilted).rotation * DVec3::Z;
            assert!((up - DVec3::Z).length() < 1e-12, "{up}");
        }
    }

    /// The distance includes the difference in height.
    #[test]
    fn a_pose_high_above_a_drive_is_far_from_it() {
        let drives = drives();
        // Next to the start of the street.
        let height_m = |above_m: f64| {
            let position_m = DVec3::new(45.0, -25.0, above_m);
            Ground::from_drives(&drives).place(Pose { position_m, ..Pose::IDENTITY }).position_m.z
        };
        // 20 m aside: within 25 m up to a height of 15 m.
        for above_m in [-14.9, 0.0, 14.9] {
            assert!(height_m(above_m).abs() < 1e-12, "{above_m}");
        }
        for above_m in [-15.1, 15.1, 24.0] {
            assert_eq!(height_m(above_m), above_m);
        }
    }
}
