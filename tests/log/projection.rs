//! Where LiDAR points are in images: known points, a moving vehicle and a rolling shutter.

use glam::{DQuat, DVec2, DVec3};
use wildcity_log::check::Projection;
use wildcity_log::{Header, Log, LogWriter, Poses, Source};
use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::{Shutter, ShutterDirection};
use wildcity_scene::trajectory::Keyframe;

/// A drive that turns while it moves at 20 m/s, a pose every 10 ms.
fn pose(time_us: i64) -> Pose {
    let time_s = time_us as f64 / 1e6;
    Pose {
        position_m: DVec3::new(20.0 * time_s, 3.0 * time_s * time_s, 0.0),
        rotation: DQuat::from_rotation_z(0.3 * time_s),
    }
}

fn poses(dir: &std::path::Path) -> Poses {
    let source = Source {
        kind: "test".into(),
        id: "1".into(),
        licence: "none".into(),
        converter: "test".into(),
    };
    let out = dir.join("log");
    let rig = Rig::preset("vehicle6").unwrap();
    let mut log = LogWriter::create(&out, &Header::new("turn", source), &rig).unwrap();
    for time_us in (0..=1_000_000).step_by(10_000) {
        log.add(&Keyframe { time_us, world_from_rig: pose(time_us) }).unwrap();
    }
    log.finish().unwrap();
    Log::open(&out).unwrap().poses().unwrap()
}

#[test]
fn known_points_are_within_a_twentieth_of_a_pixel() {
    let dir = tempfile::tempdir().unwrap();
    let poses = poses(dir.path());
    let rig = Rig::preset("vehicle6").unwrap();
    // Between two poses, where the drive is curved: a chord is 0.08 mm beside it.
    let time_us = 505_000;
    let mut shown = 0;
    for mounted in &rig.cameras {
        let projection = Projection { poses: &poses, mounted, time_us };
        for step in 0..100 {
            let at_px = DVec2::new(f64::from(step % 10) + 0.5, f64::from(step / 10) + 0.5) / 10.0
                * mounted.camera.size_px();
            let Some(direction) = mounted.camera.unproject(at_px) else { continue };
            let range_m = 5.0 + f64::from(step);
            let world_from_camera = pose(time_us) * mounted.rig_from_camera;
            let world_m = world_from_camera.transform_point(range_m * direction);
            let (found_px, found_m) = projection.project(world_m).unwrap();
            assert!(found_px.distance(at_px) < 0.05, "{}: {found_px} {at_px}", mounted.name);
            assert!((found_m - range_m).abs() < 1e-3, "{found_m} {range_m}");
            shown += 1;
        }
    }
    assert!(shown > 500, "{shown}");
}

#[test]
fn a_rolling_shutter_sees_each_row_at_its_time() {
    let dir = tempfile::tempdir().unwrap();
    let poses = poses(dir.path());
    let mut mounted = Rig::preset("vehicle6").unwrap().cameras.remove(0);
    let shutter = Shutter { direction: ShutterDirection::TopToBottom, duration_us: 30_000 };
    let time_us = 500_000;
    let size_px = mounted.camera.size_px();
    for row in [0.1, 0.5, 0.9] {
        let at_px = DVec2::new(0.7, row) * size_px;
        let direction = mounted.camera.unproject(at_px).unwrap();
        let before_us = (1.0 - shutter.direction.fraction(at_px, &mounted.camera)) * 30_000.0;
        let seen_us = time_us - before_us.round() as i64;
        let world_m = (pose(seen_us) * mounted.rig_from_camera).transform_point(8.0 * direction);
        mounted.shutter = Some(shutter);
        let projection = Projection { poses: &poses, mounted: &mounted, time_us };
        let (found_px, _) = projection.project(world_m).unwrap();
        assert!(found_px.distance(at_px) < 0.05, "row {row}: {found_px} {at_px}");
        mounted.shutter = None;
        let global = Projection { poses: &poses, mounted: &mounted, time_us };
        let moved_px = global.project(world_m).map_or(99.0, |(px, _)| px.distance(at_px));
        assert!(row > 0.8 || moved_px > 3.0, "row {row}: {moved_px}");
    }
}
