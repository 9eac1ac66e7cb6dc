//! Lenses and rolling shutters on the device: as the cpu backend draws them, and nothing of them for a
//! pinhole.

use glam::{DQuat, DVec3};
use wildcity::geometry::Pose;
use wildcity::geometry::camera::Rolls;
use wildcity::render::{Rolling, View};
use wildcity::scene::{RenderProfile, Scene};

use crate::images::{agree, cpu, look, render};
use crate::lenses::lenses;
use crate::streets::street;

#[test]
fn lenses_and_shutters_are_drawn_as_by_the_cpu() {
    let gpu = crate::gpu::gpu();
    let street = Scene::from_gaussians(&street(20_000, 1, 31));
    let at = DVec3::new(0.4, 0.0, 20.0);
    let straight = look([150, 90], 110.0, at, DVec3::new(0.15, 0.03, 1.0), DVec3::Y);
    let pose = straight.world_from_camera;
    let before = Pose {
        position_m: pose.position_m - pose.rotation * DVec3::new(0.05, 0.0, 0.9),
        rotation: pose.rotation * DQuat::from_rotation_y(-0.01),
    };
    let rolling = Some(Rolling { direction: Rolls::BottomToTop, world_from_camera_first: before });
    let mut views: Vec<View> =
        lenses().into_iter().map(|(_, camera)| View::new(camera, pose)).collect();
    views.push(View { rolling, ..views[0] });
    views.push(View { rolling, ..straight });
    views.push(straight);
    let profile = RenderProfile::default();
    let truths = render(&cpu(), &street, &profile, &views);
    for (k, (image, truth)) in
        render(&gpu, &street, &profile, &views).iter().zip(&truths).enumerate()
    {
        agree(image, truth).unwrap_or_else(|e| panic!("view {k}: {e}"));
    }
}
