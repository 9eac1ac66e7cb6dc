//! Lenses and rolling shutters on the device against the cpu backend. For static pinhole cameras,
//! nothing for lenses is compiled.

use glam::DVec3;
use wildcity_render::compare::gaussians::{GaussianSpec, scene_from_specs};
use wildcity_render::compare::reprojection::ReprojectionErrors;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::{RenderError, RollingShutter, View};
use wildcity_scene::geometry::camera::{ShutterDirection, Windshield, WindshieldReference};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{RenderProfile, Rig, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{agree, cpu, psnr, render, render_one, try_render, view_along};
use crate::lenses::{
    check_against_exact_rays, check_projections, lenses, rolling_view, scaled_and_cropped,
    sideways_rolling_view,
};
use crate::shared_gpu;
use crate::streets::{demo_street, street};

/// Along a street, as [`crate::streets::street_views`] are.
fn straight() -> View {
    let at = DVec3::new(0.4, 0.0, 20.0);
    view_along([150, 90], 110.0, at, DVec3::new(0.15, 0.03, 1.0), DVec3::Y)
}

/// Every lens at rest, and rolling shutters in all four directions. One windshield is given by its
/// inverse polynomials.
pub(crate) fn lens_views() -> Vec<View> {
    let lenses = lenses();
    let camera = |name: &str| lenses.iter().find(|(known, _)| *known == name).unwrap().1;
    let behind = camera("fisheye behind a windshield");
    let shield = behind.windshield.unwrap();
    let (horizontal, vertical) = (*shield.horizontal(), *shield.vertical());
    let shield = Windshield::new(WindshieldReference::Backward, horizontal, vertical);
    let behind = Camera { windshield: Some(shield), ..behind };
    let pose = straight().world_from_camera;
    let still = lenses.iter().map(|(_, camera)| View::new(*camera, pose));
    let rolling_shutter = [
        rolling_view(straight().camera, pose, ShutterDirection::TopToBottom),
        rolling_view(camera("opencv"), pose, ShutterDirection::BottomToTop),
        rolling_view(behind, pose, ShutterDirection::LeftToRight),
        rolling_view(camera("f-theta by pixels"), pose, ShutterDirection::RightToLeft),
    ];
    still.chain(rolling_shutter).collect()
}

#[test]
fn lenses_and_shutters_are_drawn_as_by_the_cpu() {
    let gpu = shared_gpu();
    let street = Scene::from_gaussians(&street(8_000, 1, 31));
    let views: Vec<View> = lens_views().into_iter().chain([straight()]).collect();
    for setting in ["near=0.01", "antialiased=true", "near=3", "far=30", "blur=0.1"] {
        let mut profile = RenderProfile::default();
        profile.set(setting).unwrap();
        let truths = render(&cpu(), &street, &profile, &views);
        for (k, (image, truth)) in
            render(&*gpu, &street, &profile, &views).iter().zip(&truths).enumerate()
        {
            let db = agree(image, truth).unwrap_or_else(|e| panic!("view {k}, {setting}: {e}"));
            eprintln!("{setting}, view {k}: {db:.1} dB of the cpu backend");
        }
    }
}

/// Images below the native size, by every lens and shutter, and by pinholes with another share
/// along each axis.
#[test]
fn small_images_are_drawn_as_by_the_cpu() {
    let street = Scene::from_gaussians(&street(20_000, 1, 31));
    let mut views: Vec<View> = lens_views().into_iter().step_by(2).chain([straight()]).collect();
    for view in &mut views {
        view.camera = view.camera.scaled(75, 30).unwrap();
    }
    let gpu = shared_gpu();
    for setting in ["near=0.01", "antialiased=true"] {
        let mut profile = RenderProfile { lens_error_px: 0.0, ..RenderProfile::default() };
        profile.set(setting).unwrap();
        let truths = render(&cpu(), &street, &profile, &views);
        let images = render(&*gpu, &street, &profile, &views);
        for (k, (image, truth)) in images.iter().zip(&truths).enumerate() {
            agree(image, truth).unwrap_or_else(|e| panic!("view {k}, {setting}: {e}"));
        }
    }
}

/// Gaussians beyond this distance are left out, in metres: the planes of the road and of the
/// facades start around the camera.
const NEAR_M: f64 = 30.0;

/// Thousands of surfels of one plane, ordered by z, by distance, and by the depth of a moving
/// camera.
#[test]
fn the_demo_street_through_lenses_and_shutters() {
    let (street, views) = demo_street();
    let pose = views[0].world_from_camera;
    let is_near =
        |index: &usize| pose.position_m.distance(DVec3::from(street.means_m[*index])) < NEAR_M;
    let near = street.select((0..street.len()).filter(is_near));
    let scene = Scene::from_gaussians(&near);
    let lens = |k: usize| View::new(lenses()[k].1, pose);
    let roll = |view: View, direction| {
        let world_from_camera_first = Pose {
            position_m: pose.position_m - pose.rotation * DVec3::new(0.05, 0.0, 0.9),
            ..pose
        };
        View {
            rolling_shutter: Some(RollingShutter { direction, world_from_camera_first }),
            ..view
        }
    };
    let views = [
        lens(0),
        lens(1),
        lens(2),
        roll(views[0], ShutterDirection::TopToBottom),
        roll(lens(2), ShutterDirection::LeftToRight),
    ];
    let profile = RenderProfile::default();
    let truths = render(&cpu(), &scene, &profile, &views);
    for (k, (image, truth)) in
        render(&*shared_gpu(), &scene, &profile, &views).iter().zip(&truths).enumerate()
    {
        let db = psnr(&image.rgba, &truth.rgba);
        eprintln!("demo street, view {k}: {db:.1} dB of the cpu backend");
        assert!(db >= 60.0, "view {k}: {db:.1} dB");
    }
}

/// At half the size of the cpu backend's test: the reference takes seconds for each view.
#[test]
fn every_lens_draws_what_each_pixels_ray_meets() {
    check_against_exact_rays(&*shared_gpu());
}

#[test]
fn known_points_land_where_the_model_says() {
    let gpu = shared_gpu();
    for (name, camera) in lenses() {
        for camera in scaled_and_cropped(&camera) {
            let points = check_projections(&*gpu, name, camera, 0.6);
            assert!(points >= 2, "{name}: {points} points");
        }
    }
}

#[test]
fn gaussians_that_pass_close_are_drawn_as_by_the_cpu() {
    let ball = |k: i32| GaussianSpec {
        mean_m: DVec3::new(0.5 * f64::from(k) - 1.5, 0.1, 1.5),
        sigma_m: DVec3::splat(0.05),
        ..GaussianSpec::default()
    };
    let balls = scene_from_specs(&[0, 1, 2, 3, 4].map(ball));
    let profile = RenderProfile::default();
    let truth = render_one(&cpu(), &balls, &profile, sideways_rolling_view());
    agree(&render_one(&*shared_gpu(), &balls, &profile, sideways_rolling_view()), &truth).unwrap();
}

/// The f-theta cameras of a real car, at full size and at the input size of a driving model.
#[test]
fn a_real_cars_points_land_where_its_lenses_say() {
    let gpu = shared_gpu();
    let rig = Rig::preset("alpamayo2").unwrap();
    let full = rig.cameras[..2].iter().map(|mounted| mounted.camera);
    let small = rig.cameras.iter().map(|mounted| mounted.camera.scaled(576, 320).unwrap());
    for camera in full.chain(small) {
        let ReprojectionErrors { count, worst_px } =
            ReprojectionErrors::measure(&*gpu, &View::new(camera, Pose::IDENTITY)).unwrap();
        eprintln!("{} x {}: {worst_px:.3} px", camera.width_px, camera.height_px);
        assert!(count > 20 && worst_px < 0.1, "{count} points, {worst_px} px");
    }
}

/// A shader that is not compiled cannot fail. Here the projection of lenses does not parse.
#[test]
fn without_a_lens_nothing_of_it_is_compiled() {
    let broken = || {
        let shaders = Shaders::default();
        shaders
            .with_mutation("project_unscented", "struct ProjectedPoint {", "struct Nothing {")
            .unwrap()
    };
    let (street, profile) = (Scene::from_gaussians(&street(300, 0, 1)), RenderProfile::default());
    render_one(&gpu_with(broken()), &street, &profile, straight());
    // Without the log watch of `gpu_with`, since this one must fail.
    let gpu = Gpu::with_shaders(&AdapterChoice::Best, 0, broken()).unwrap();
    let failed = try_render(&gpu, &street, &profile, &lens_views()[..1]);
    assert!(matches!(failed, Err(RenderError::Device { .. })), "{failed:?}");
}

#[test]
fn a_pinhole_next_to_a_lens_is_drawn_to_the_same_bytes() {
    let (street, profile) = (Scene::from_gaussians(&street(5_000, 1, 2)), RenderProfile::default());
    let gpu = gpu();
    let alone = render(&gpu, &street, &profile, &[straight()]);
    let pipelines = gpu.usage().unwrap().totals.pipelines;
    let [before, after] = [lens_views()[1], lens_views()[7]];
    let together = render(&gpu, &street, &profile, &[before, straight(), after]);
    assert!(together[1..2] == alone);
    assert_eq!(gpu.usage().unwrap().totals.pipelines, pipelines + 2, "cull and project");
    assert!(render(&gpu, &street, &profile, &[straight()]) == alone);
    assert_eq!(gpu.usage().unwrap().totals.pipelines, pipelines + 2);
}
