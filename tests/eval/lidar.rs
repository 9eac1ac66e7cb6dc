//! Points of a LiDAR in the world, and rendered depth against them: numpy and SciPy.

use glam::DVec3;
use safetensors::SafeTensors;
use serde::Deserialize;

use wildcity_eval::{DepthMap, LidarDepth, LidarError, LidarPoints};
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::trajectory::Keyframe;

const FILE: &[u8] = include_bytes!("lidar.safetensors");

#[derive(Deserialize)]
struct Golden {
    world: Vec<[f64; 3]>,
    time_us: Vec<i64>,
    skipped: usize,
    camera: [[f64; 4]; 4],
    size_px: [u32; 2],
    pinhole: [f64; 4],
    depth: Depth,
}

#[derive(Deserialize)]
struct Depth {
    points: usize,
    mean_m: f64,
    median_m: f64,
    bins: [(usize, f64); 3],
}

fn golden() -> Golden {
    serde_json::from_str(include_str!("lidar.json")).unwrap()
}

#[test]
fn points_are_in_the_world_where_scipy_has_them() {
    let golden = golden();
    let points = LidarPoints::parse(FILE).unwrap();
    let world = points.in_world(&Alignment::IDENTITY, None).unwrap();
    assert_eq!((points.len(), world.skipped), (1500, golden.skipped));
    assert_eq!(world.time_us, golden.time_us);
    let mut farthest_m: f64 = 0.0;
    for (found, wanted) in world.points_m.iter().zip(&golden.world) {
        farthest_m = farthest_m.max(found.distance(DVec3::from_array(*wanted)));
    }
    assert!(farthest_m < 1e-9, "{farthest_m} m");
    assert_eq!(world.points_m.len(), golden.world.len());
    // Both ends count.
    let [first, last] = [world.time_us[10], world.time_us[20]];
    let between = world.between_us(first, last);
    assert!(between.len() >= 11 && between.contains(&world.points_m[20]));
    assert!(world.between_us(-9, -1).is_empty());
}

#[test]
fn depth_is_compared_as_numpy_does() {
    let golden = golden();
    let points = LidarPoints::parse(FILE).unwrap();
    let world = points.in_world(&Alignment::IDENTITY, None).unwrap();
    let [fx, fy, cx, cy] = golden.pinhole;
    let [width, height] = golden.size_px;
    let camera = Camera::from_pinhole(width, height, Pinhole { fx, fy, cx, cy });
    let column = |at: usize| golden.camera.map(|row| row[at]);
    let axis = |at: usize| DVec3::new(column(at)[0], column(at)[1], column(at)[2]);
    let rotation = glam::DQuat::from_mat3(&glam::DMat3::from_cols(axis(0), axis(1), axis(2)));
    let world_from_camera = Pose { position_m: axis(3), rotation: rotation.normalize() };
    let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (row, column)));
    let depth_m: Vec<f32> = pixels
        .clone()
        .map(|(row, column)| (20.0 + 0.2 * f64::from(column) + 0.1 * f64::from(row)) as f32)
        .collect();
    let opacity: Vec<f32> =
        pixels.clone().map(|(_, column)| if column < 130 { 0.5 } else { 0.49 }).collect();
    let counts: Vec<bool> = pixels.map(|(row, _)| row > 10).collect();
    let map = DepthMap {
        camera: &camera,
        world_from_camera: &world_from_camera,
        depth_m: &depth_m,
        opacity: &opacity,
        counts: Some(&counts),
    };
    let found = LidarDepth::compare(&world.points_m, &map);
    let wanted = golden.depth;
    assert_eq!(found.points, wanted.points);
    assert!((found.mean_m - wanted.mean_m).abs() < 1e-9, "{found:?}");
    assert!((found.median_m - wanted.median_m).abs() < 1e-9, "{found:?}");
    for (bin, (points, mean_m)) in found.bins.iter().zip(wanted.bins) {
        assert_eq!(bin.points, points);
        assert!((bin.mean_m - mean_m).abs() < 1e-9, "{bin:?}");
    }
    // A map that is 0.25 m off everywhere.
    let exact = LidarDepth::compare(&[], &map);
    assert!(exact.points == 0 && exact.mean_m.is_nan() && exact.bins[0].mean_m.is_nan());
}

#[test]
fn points_that_did_not_come_back_are_left_out() {
    let all = LidarPoints::parse(FILE).unwrap();
    let file = SafeTensors::deserialize(FILE).unwrap();
    let points = file.tensor("points_m").unwrap().data();
    let from = points.as_ptr().addr() - FILE.as_ptr().addr();
    let mut bytes = FILE.to_vec();
    // Bits of NaN, for one point.
    bytes[from..from + points.len() / all.len()].fill(0xff);
    assert_eq!(LidarPoints::parse(&bytes).unwrap().len(), all.len() - 1);
}

#[test]
fn what_has_no_depth_does_not_count_and_the_median_lies_between_the_middle_two() {
    let camera = Camera::from_pinhole(30, 10, Pinhole { fx: 10.0, fy: 10.0, cx: 15.0, cy: 5.0 });
    let places = [(3, 10.5), (9, 11.0), (15, 13.0), (21, 17.0), (27, 0.0)];
    let mut depth_m = vec![0.0; 300];
    let mut points_m = Vec::new();
    for (column, rendered_m) in places {
        depth_m[5 * 30 + column] = rendered_m;
        points_m.push(DVec3::new(column as f64 + 0.5 - 15.0, 0.5, 10.0));
    }
    let map = DepthMap {
        camera: &camera,
        world_from_camera: &Pose::IDENTITY,
        depth_m: &depth_m,
        opacity: &vec![1.0; 300],
        counts: None,
    };
    let found = LidarDepth::compare(&points_m, &map);
    assert_eq!((found.points, found.mean_m, found.median_m), (4, 2.875, 2.0));
}

#[test]
fn poses_of_a_drive_are_used_if_the_file_has_none_and_the_axes_change() {
    let mut points = LidarPoints::parse(FILE).unwrap();
    let turn = Alignment {
        new_from_old: Pose {
            position_m: DVec3::new(1.0, 2.0, 3.0),
            rotation: glam::DQuat::from_rotation_z(0.5),
        },
        metres_per_unit: 1.0,
    };
    let plain = points.in_world(&Alignment::IDENTITY, None).unwrap();
    let turned = points.in_world(&turn, None).unwrap();
    for (plain, turned) in plain.points_m.iter().zip(&turned.points_m) {
        assert!(turn.point_m(*plain).distance(*turned) < 1e-9);
    }
    let drive = points.poses.take().unwrap();
    // The poses of a drive are in the world's axes already.
    assert_eq!(points.in_world(&turn, Some(&drive)).unwrap(), plain);
    assert_eq!(points.in_world(&turn, None), Err(LidarError::NoPoses));
    let one = [Keyframe { time_us: 0, world_from_rig: Pose::IDENTITY }];
    assert!(points.in_world(&turn, Some(&one)).unwrap().points_m.len() < 3);
}

#[test]
fn damaged_files_are_named() {
    let said = |bytes: &[u8]| LidarPoints::parse(bytes).unwrap_err().to_string();
    assert!(said(b"points").starts_with("not a safetensors file"));
    // Names of tensors in the header, of the same length.
    let renamed = |from: &[u8], to: &[u8]| {
        let at = FILE.windows(from.len()).position(|window| window == from).unwrap();
        let mut bytes = FILE.to_vec();
        bytes[at..at + to.len()].copy_from_slice(to);
        bytes
    };
    let text = said(&renamed(b"points_m", b"paints_m"));
    assert!(text.contains("no tensor \"points_m\""), "{text}");
    let text = said(&renamed(b"[1500]", b"[1499]"));
    assert!(text.contains("safetensors") || text.contains("time_us"), "{text}");
    let text = said(&renamed(b"world_from_rig", b"world_from_rag"));
    assert!(text.contains("no tensor \"world_from_rig\""), "{text}");
}
