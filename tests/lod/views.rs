//! With levels of detail, the image of a view is a function of that view alone: it has the same bytes
//! as the only one of a frame and among others.

use glam::{DQuat, DVec3};
use wildcity_generate::StreetSettings;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, RollingShutter, View};
use wildcity_scene::RecordFormat;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::ShutterDirection;

use crate::images::{Image, try_render, view_along};
use crate::scene_files::Random;
use crate::{Stored, eyes, stored, tau};

/// Six small cameras of one car, from a wide one to a long one, one of them with a rolling shutter.
fn rig(world_from_rig: Pose) -> Vec<View> {
    let at = |m: [f64; 3]| world_from_rig.transform_point(DVec3::from_array(m));
    let toward = |yaw: f64| world_from_rig.rotation * DVec3::new(yaw.cos(), yaw.sin(), 0.0);
    let view =
        |size, focal_px, place, yaw| view_along(size, focal_px, at(place), toward(yaw), -DVec3::Z);
    let mut views = vec![
        view([96, 64], 30.0, [1.5, 0.0, 1.6], 0.0),
        view([64, 48], 400.0, [1.5, 0.1, 1.6], 0.02),
        view([64, 64], 60.0, [0.8, 0.9, 1.4], 1.6),
        view([64, 64], 45.0, [0.8, -0.9, 1.4], -1.5),
        view([80, 48], 110.0, [-2.0, 0.0, 1.5], 3.1),
        view([48, 48], 20.0, [0.0, 0.0, 1.8], 0.5),
    ];
    let mut first = views[2].world_from_camera;
    first.position_m -= world_from_rig.rotation * DVec3::new(0.4, 0.0, 0.0);
    let direction = ShutterDirection::TopToBottom;
    views[2].rolling_shutter = Some(RollingShutter { direction, world_from_camera_first: first });
    views
}

/// The images of some views in one frame, of the sections that this frame needs.
fn together(backend: &dyn Backend, street: &Stored, views: &[View]) -> (Vec<Image>, bool) {
    let scene = street.scene(&eyes(views), &tau(1.0));
    let images = try_render(backend, &scene, &tau(1.0), views).unwrap();
    (images, scene.selection.is_some())
}

/// Compares views alone and together at random poses along a street, on some backends.
fn check(backends: &[&dyn Backend], poses: usize) {
    let settings = StreetSettings { length_m: 300.0, density: 0.2, ..StreetSettings::default() };
    let street = wildcity_generate::street(&settings).unwrap();
    let trajectory = street.trajectory;
    let street = stored(&street.gaussians, RecordFormat::F32, true);
    let mut random = Random(36);
    let mut of_their_own = 0;
    for number in 0..poses {
        let mut pose = trajectory.at_station(300.0 * random.unit());
        pose.position_m += 6.0 * DVec3::new(random.unit() - 0.5, random.unit() - 0.5, 0.0);
        pose.rotation *= DQuat::from_rotation_z(std::f64::consts::TAU * random.unit());
        let views = rig(pose);
        for backend in backends {
            let (images, has_own) = together(*backend, &street, &views);
            of_their_own += usize::from(has_own);
            for (view, image) in images.iter().enumerate() {
                let (alone, _) = together(*backend, &street, &views[view..=view]);
                let name = backend.name();
                assert!(alone[0] == *image, "{name}: view {view} of pose {number} at {pose:?}");
            }
            // Among others than all.
            let (pair, _) = together(*backend, &street, &[views[4], views[1]]);
            assert!(pair[0] == images[4] && pair[1] == images[1], "{}: {number}", backend.name());
        }
    }
    assert!(2 * of_their_own > poses * backends.len(), "levels differ in {of_their_own} frames");
}

/// Number of poses; 200 were compared when this was written.
fn poses() -> usize {
    std::env::var("WILDCITY_POSES").map_or(8, |text| text.parse().unwrap())
}

/// On all cores, and with so little memory that views are drawn one after the other.
#[test]
fn a_view_alone_has_the_bytes_that_it_has_among_others() {
    let all = Cpu::new(0, Simd::Best).unwrap();
    let small = Cpu::new(1, Simd::Best).unwrap();
    small.limit_frame_bytes(0);
    check(&[&all, &small], poses());
}
