//! A sweep of a LiDAR in motion, put into the world as `eval` does it with the points of a log.

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_eval::LidarPoints;
use wildcity_options::{LidarBeams, LidarColumns};
use wildcity_render::Backend;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::lidar::LidarView;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

/// A road with walls on both sides and across both ends, of flat Gaussians that overlap.
fn yard() -> Scene {
    let mut gaussians = Gaussians::with_capacity(0, 0);
    let step_m = 0.25;
    let mut patch = |corner: DVec3, along: DVec3, across: DVec3, thin: usize| {
        let [columns, rows] = [along, across].map(|edge| (edge.length() / step_m) as usize);
        for column in 0..columns {
            for row in 0..rows {
                let [u, v] =
                    [(column, columns), (row, rows)].map(|(at, of)| at as f64 / (of - 1) as f64);
                gaussians.means_m.push((corner + u * along + v * across).to_array());
                let mut scale_m = [0.7 * step_m as f32; 3];
                scale_m[thin] = 1e-3;
                gaussians.ln_scales.push(scale_m.map(f32::ln));
                gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
                gaussians.logit_opacities.push(4.0);
                gaussians.sh.extend([0.5; 3]);
            }
        }
    };
    let long = 50.0 * DVec3::X;
    let wide = 16.0 * DVec3::Y;
    let high = 6.0 * DVec3::Z;
    let corner = DVec3::new(-22.0, -8.0, 0.0);
    patch(corner, long, wide, 2);
    patch(corner, long, high, 1);
    patch(corner + wide, long, high, 1);
    patch(corner, wide, high, 0);
    patch(corner + long, wide, high, 0);
    Scene::from_gaussians(&gaussians)
}

fn lidar(elevations_rad: Vec<f64>, columns: LidarColumns) -> Arc<Lidar> {
    let beams = LidarBeams {
        row_elevations_rad: elevations_rad,
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(columns),
        duration_us: 100_000,
        min_range_m: None,
        max_range_m: None,
    };
    Arc::new(Lidar::from_options(&beams).unwrap())
}

/// How far a LiDAR at rest is from what it sees towards a point, and from the point.
fn ranges_m(cpu: &Cpu, scene: &Scene, at: Pose, point_m: DVec3) -> [f64; 2] {
    let seen_m = at.rotation.inverse() * (point_m - at.position_m);
    let elevation = f64::atan2(seen_m.z, seen_m.truncate().length());
    let azimuth = f64::atan2(seen_m.y, seen_m.x);
    let columns = LidarColumns { count: 1, first_rad: azimuth, last_rad: azimuth };
    let view = LidarView::at_rest(lidar(vec![elevation], columns), at);
    let sweep = cpu.sweep(scene, &RenderProfile::default(), &view).unwrap();
    [f64::from(sweep.range_m[0]), seen_m.length()]
}

#[test]
fn a_sweep_at_30_m_s_deskews_to_what_a_lidar_at_rest_sees() {
    let scene = yard();
    let elevations = (0..32).map(|row| (6.0 - 0.8 * f64::from(row)).to_radians()).collect();
    let columns = LidarColumns { count: 360, first_rad: 3.0, last_rad: 3.0 - TAU * 359.0 / 360.0 };
    let lidar = lidar(elevations, columns);
    let first = Pose { position_m: DVec3::new(0.0, 0.0, 1.9), rotation: DQuat::IDENTITY };
    let last =
        Pose { position_m: DVec3::new(3.0, 0.1, 1.9), rotation: DQuat::from_rotation_z(0.05) };
    let view =
        LidarView { lidar: lidar.clone(), world_from_lidar: last, world_from_lidar_first: first };
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let sweep = cpu.sweep(&scene, &RenderProfile::default(), &view).unwrap();
    let beams = (0..lidar.beams()).step_by(23).filter(|at| sweep.range_m[*at] > 0.0);
    let measured = |at: usize| {
        let column = at % lidar.columns();
        let time_us = (1e5 * lidar.fraction(column)).round() as i64;
        let range_m = f64::from(sweep.range_m[at]);
        (time_us, range_m * lidar.direction(at / lidar.columns(), column))
    };
    let mut points: Vec<(i64, DVec3)> = beams.map(measured).collect();
    points.sort_by_key(|(time_us, _)| *time_us);
    assert!(points.len() > 400, "{} points", points.len());
    let poses = [(0, first), (100_000, last)]
        .map(|(time_us, world_from_rig)| Keyframe { time_us, world_from_rig });
    let raw = points.clone();
    let world = LidarPoints::from_rig(points, poses.to_vec());
    let world = world.in_world(&Alignment::IDENTITY, None).unwrap();
    assert_eq!(world.skipped, 0);

    let errors = |points_m: &[DVec3]| -> Vec<f64> {
        let miss_m = |point_m: &DVec3| {
            let [seen_m, range_m] = ranges_m(&cpu, &scene, last, *point_m);
            (seen_m - range_m).abs()
        };
        let mut errors: Vec<f64> = points_m.iter().map(miss_m).collect();
        errors.sort_by(f64::total_cmp);
        errors
    };
    let quantile = |errors: &[f64], q: f64| errors[(q * (errors.len() - 1) as f64) as usize];
    let deskewed = errors(&world.points_m);
    // As if all beams were fired at the end.
    let at_end: Vec<DVec3> =
        raw.iter().map(|(_, point)| last.position_m + last.rotation * *point).collect();
    let skewed = errors(&at_end);
    let deskewed_m = quantile(&deskewed, 0.99);
    let skewed_m = quantile(&skewed, 0.9);
    assert!(deskewed_m < 0.02, "{deskewed_m}");
    assert!(skewed_m > 0.5, "{skewed_m}");
}
