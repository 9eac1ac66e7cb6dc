//! Normals of surfaces with a known normal, through every lens, and at the edges of surfaces.

use glam::{DQuat, DVec3};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, RollingShutter, Target, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{RenderProfile, Scene};

use crate::images::cpu;
use crate::lenses::lenses;

/// Depth, opacity and normals of a view.
struct Drawn {
    depth_m: Vec<f32>,
    opacity: Vec<f32>,
    normals: Vec<f32>,
}

fn draw(backend: &dyn Backend, scene: &Scene, view: View) -> Drawn {
    let pixels = view.camera.pixels();
    let of = |values: usize| vec![f32::NAN; values * pixels];
    let mut drawn = Drawn { depth_m: of(1), opacity: of(1), normals: of(3) };
    let target = Target {
        depth_m: Some(&mut drawn.depth_m),
        opacity: Some(&mut drawn.opacity),
        normals: Some(&mut drawn.normals),
        ..Target::default()
    };
    let frame = Frame { scene, profile: &RenderProfile::DEFAULT, views: &[view] };
    backend.render(&frame, &mut [target], &|_, _| {}).unwrap();
    drawn
}

/// A wall of small flat discs through a point, `facing` the camera.
fn wall(through_m: DVec3, facing: DVec3, side_m: f64) -> Vec<GaussianSpec> {
    let rotation = DQuat::from_rotation_arc(DVec3::Z, facing);
    let count = (side_m / 0.05) as i32 / 2;
    let places = (-count..=count).flat_map(|i| (-count..=count).map(move |k| (i, k)));
    let disc = |(i, k): (i32, i32)| GaussianSpec {
        mean_m: through_m + rotation * DVec3::new(0.05 * f64::from(i), 0.05 * f64::from(k), 0.0),
        rotation,
        sigma_m: DVec3::new(0.04, 0.04, 1e-4),
        opacity: 0.9,
        ..GaussianSpec::default()
    };
    places.map(disc).collect()
}

/// Angles between the normals of well covered pixels and a direction, in degrees, sorted.
fn off_deg(drawn: &Drawn, facing: DVec3) -> Vec<f64> {
    let covered = drawn.normals.chunks(3).zip(&drawn.opacity).filter(|(_, o)| **o > 0.98);
    let angle = |(n, _): (&[f32], _)| {
        let normal = DVec3::new(f64::from(n[0]), f64::from(n[1]), f64::from(n[2]));
        assert!((normal.length() - 1.0).abs() < 1e-6, "{normal}");
        normal.angle_between(facing).to_degrees()
    };
    let mut all: Vec<f64> = covered.map(angle).collect();
    all.sort_by(f64::total_cmp);
    all
}

#[test]
fn normals_of_a_wall_match() {
    let facing = DVec3::new(0.4, -0.3, -1.0).normalize();
    let scene = scene_from_specs(&wall(DVec3::new(0.0, 0.0, 3.0), facing, 5.0));
    let way = Pose { position_m: DVec3::new(-0.6, 0.0, 0.0), ..Pose::IDENTITY };
    let rolling_shutter =
        RollingShutter { direction: ShutterDirection::TopToBottom, world_from_camera_first: way };
    let mut views: Vec<(&str, View)> = lenses()
        .into_iter()
        .map(|(name, camera)| (name, View::new(camera, Pose::IDENTITY)))
        .collect();
    views.push(("pinhole", forward_view([160, 100], 90.0)));
    views.push((
        "rolling",
        View { rolling_shutter: Some(rolling_shutter), ..forward_view([160, 100], 90.0) },
    ));
    for (name, view) in views {
        for backend in [&cpu() as &dyn Backend, &Reference] {
            let off_deg = off_deg(&draw(backend, &scene, view), facing);
            let [half, most] = [0.5, 0.99].map(|q| off_deg[(off_deg.len() as f64 * q) as usize]);
            let count = off_deg.len();
            assert!(half < 1.0, "{name}, {}: half within {half:.2}°", backend.name());
            assert!(most < 5.0, "{name}, {}: 99 % within {most:.2}°", backend.name());
            assert!(count > 5_000, "{name}: {count} px");
        }
    }
}

#[test]
fn an_edge_belongs_to_neither_side() {
    // A board 2 m away in front of a wall 4 m away: the edge between them must not give slanted
    // normals.
    let board = wall(DVec3::new(-1.0, 0.0, 2.0), DVec3::NEG_Z, 2.0);
    let behind = wall(DVec3::new(0.0, 0.0, 4.0), DVec3::NEG_Z, 12.0);
    let scene = scene_from_specs(&[board, behind].concat());
    let drawn = draw(&cpu(), &scene, forward_view([160, 100], 90.0));
    // At the board's edge discs fade out over some pixels, and their blended depth does have a
    // slope.
    let mut on_one = 0;
    let mut slopes = 0;
    for (normal, depth_m) in drawn.normals.chunks(3).zip(&drawn.depth_m) {
        if (depth_m - 2.0).abs() < 0.01 || (depth_m - 4.0).abs() < 0.02 {
            on_one += 1;
            slopes += usize::from(normal[2] > -0.9);
        }
    }
    eprintln!("{slopes} of {on_one} px face elsewhere");
    assert!(on_one > 14_000 && slopes < 70, "{slopes} of {on_one}");
}

/// Every pixel with a depth has a unit normal towards the camera, also one that has no neighbour,
/// or none in its row or its column.
#[test]
fn lone_pixels_face_the_camera() {
    let speck = |x_m: f64, y_m: f64| GaussianSpec {
        mean_m: DVec3::new(x_m, y_m, 4.0),
        sigma_m: DVec3::splat(1e-4),
        // Above the smallest opacity that is drawn in the middle of a splat only.
        opacity: 0.006,
        ..GaussianSpec::default()
    };
    let view = forward_view([40, 30], 30.0);
    let at = |column: f64, row: f64| {
        let camera = view.camera.pinhole;
        speck(
            (column + 0.5 - camera.cx) * 4.0 / camera.fx,
            (row + 0.5 - camera.cy) * 4.0 / camera.fy,
        )
    };
    let alone = at(5.0, 5.0);
    let row = [at(10.0, 20.0), at(11.0, 20.0), at(12.0, 20.0)];
    let column = [at(30.0, 8.0), at(30.0, 9.0), at(30.0, 10.0)];
    let scene = scene_from_specs(&[&[alone], &row[..], &column[..]].concat());
    for backend in [&cpu() as &dyn Backend, &Reference] {
        let drawn = draw(backend, &scene, view);
        let covered: Vec<usize> =
            (0..drawn.depth_m.len()).filter(|&pixel| drawn.depth_m[pixel] > 0.0).collect();
        assert!(covered.len() >= 7, "{covered:?}");
        for pixel in covered {
            let [x, y, z] = [0, 1, 2].map(|k| f64::from(drawn.normals[3 * pixel + k]));
            let normal = DVec3::new(x, y, z);
            assert!((normal.length() - 1.0).abs() < 1e-6, "{pixel}: {normal}");
            assert!(normal.z < -0.8, "{pixel}: {normal}");
        }
    }
}

#[test]
fn pixels_without_depth_have_no_normal() {
    let ball = scene_from_specs(&[GaussianSpec::default()]);
    let drawn = draw(&cpu(), &ball, forward_view([40, 30], 30.0));
    let mut covered = 0;
    for (normal, depth_m) in drawn.normals.chunks(3).zip(&drawn.depth_m) {
        assert_eq!(normal == [0.0; 3], *depth_m == 0.0);
        covered += usize::from(*depth_m > 0.0);
    }
    assert!((10..600).contains(&covered), "{covered}");
    let views = [forward_view([4, 3], 4.0)];
    let mut normals = [0.0; 36];
    let target = Target { normals: Some(&mut normals), ..Target::default() };
    let frame = Frame { scene: &ball, profile: &RenderProfile::DEFAULT, views: &views };
    let refused = cpu().render(&frame, &mut [target], &|_, _| {});
    assert_eq!(refused, Err(RenderError::Normals { view: 0 }));
}
