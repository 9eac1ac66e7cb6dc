//! A camera of every model, and checks of its images.

use glam::{DQuat, DVec2, DVec3};
use wildcity_render::compare::gaussians::{GaussianSpec, scene_from_specs};
use wildcity_render::compare::reprojection::centroid;
use wildcity_render::layout::PixelFilter;
use wildcity_render::reference;
use wildcity_render::{Backend, RollingShutter, View};
use wildcity_scene::geometry::camera::{
    Bivariate, FTheta, FThetaReference, Fisheye, Lens, OpenCv, Pinhole, ShutterDirection,
    Windshield, WindshieldReference,
};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Rays, RenderProfile, Scene, Shrink};

use crate::images::{psnr, render_one, view_along};
use crate::streets::street;

/// Cameras of 160 x 100 px: one of each model with moderate distortion, and two behind a
/// windshield.
pub(crate) fn lenses() -> Vec<(&'static str, Camera)> {
    let ideal = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let with = |lens| Camera { lens, ..ideal };
    let opencv = OpenCv::new(
        [-0.12, 0.03, -0.002, 0.01, 0.002, 0.0005],
        [0.0015, -0.001],
        [0.001, -0.0005, -0.0008, 0.0004],
    );
    let ftheta = |reference, polynomial| {
        let lens = FTheta::new(reference, polynomial, [1.01, 0.002, -0.003], 1.35);
        let DVec2 { x: fx, y: fy } = lens.focal_px();
        Camera { pinhole: Pinhole { fx, fy, ..ideal.pinhole }, ..with(Lens::FTheta(lens)) }
    };
    let windshield = Windshield::new(
        WindshieldReference::Forward,
        Bivariate::new("horizontal", &[-0.0035, 1.0016, 0.00005, -0.0028, 0.0015, 0.002]).unwrap(),
        Bivariate::new("vertical", &[0.005, 0.002, 0.0018, 1.0137, -0.0001, 0.02]).unwrap(),
    );
    vec![
        ("opencv", with(Lens::opencv(opencv))),
        ("fisheye", with(Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None)))),
        ("f-theta", ftheta(FThetaReference::AngleToPixel, [0.0, 85.0, -1.8, 4.8, -7.7, 2.7])),
        (
            "f-theta by pixels",
            ftheta(FThetaReference::PixelToAngle, [0.0, 1.0 / 85.0, 3e-6, -9e-8, 2e-9, -8e-12]),
        ),
        ("pinhole behind a windshield", Camera { windshield: Some(windshield), ..ideal }),
        (
            "fisheye behind a windshield",
            Camera {
                windshield: Some(windshield),
                ..with(Lens::Fisheye(Fisheye::new([0.02, 0.01, 0.005, 0.002], Some(1.3))))
            },
        ),
    ]
}

/// A street, and a camera's pose in it.
pub(crate) fn street_scene() -> (Scene, Pose) {
    let at = DVec3::new(0.4, 0.0, 20.0);
    let pose = view_along([1, 1], 1.0, at, DVec3::new(0.15, 0.03, 1.0), DVec3::Y).world_from_camera;
    (Scene::from_gaussians(&street(20_000, 1, 31)), pose)
}

/// A view with a rolling shutter: the camera moves by 0.9 m and rotates by 0.01 rad during the
/// exposure, as at 30 m/s for 30 ms in a curve.
pub(crate) fn rolling_view(camera: Camera, pose: Pose, direction: ShutterDirection) -> View {
    let world_from_camera_first = Pose {
        position_m: pose.position_m - pose.rotation * DVec3::new(0.05, 0.0, 0.9),
        rotation: pose.rotation * DQuat::from_rotation_y(-0.01),
    };
    let rolling_shutter = Some(RollingShutter { direction, world_from_camera_first });
    View { rolling_shutter, ..View::new(camera, pose) }
}

/// A camera that looks to the side at 30 m/s. Its columns are exposed in 100 ms, in the direction
/// against the motion of the image; an object 1.5 m away moves by more than the width of the image
/// meanwhile.
pub(crate) fn sideways_rolling_view() -> View {
    let camera = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let first = Pose { position_m: DVec3::new(-3.0, 0.0, 0.0), ..Pose::IDENTITY };
    let rolling_shutter =
        RollingShutter { direction: ShutterDirection::LeftToRight, world_from_camera_first: first };
    View { rolling_shutter: Some(rolling_shutter), ..View::new(camera, Pose::IDENTITY) }
}

/// Asserts that small balls, `apart_m` apart in a plane 2 m ahead, each rendered separately, appear
/// at the pixels that the camera model gives. Returns the number of visible balls.
pub(crate) fn check_projections(
    backend: &dyn Backend,
    name: &str,
    camera: Camera,
    apart_m: f64,
) -> usize {
    // A ball is so small that its image is as wide as the blur, and its centroid is that of its
    // centre.
    let fine =
        RenderProfile { alpha_cut: 1e-5, shrink: Shrink::Filter, ..RenderProfile::default() };
    let size_px = [camera.width_px, camera.height_px];
    let steps = |most_m: f64| (-(most_m / apart_m) as i32)..=(most_m / apart_m) as i32;
    let points = steps(1.2).flat_map(|i| steps(0.6).map(move |k| (f64::from(i), f64::from(k))));
    let mut seen = 0;
    for mean_m in points.map(|(x, y)| DVec3::new(apart_m * x, apart_m * y, 2.0)) {
        let Some(at_px) = camera.project(mean_m) else { continue };
        if at_px.min(camera.size_px() - at_px).min_element() <= 5.0 {
            continue;
        }
        let ball = GaussianSpec { mean_m, sigma_m: DVec3::splat(0.003), ..GaussianSpec::default() };
        let view = View::new(camera, Pose::IDENTITY);
        let image = render_one(backend, &scene_from_specs(&[ball]), &fine, view);
        let found_px = centroid(&image.opacity, size_px, at_px, f64::INFINITY);
        let off_px = found_px.unwrap_or(DVec2::INFINITY).distance(at_px);
        // Samples at pixel centres move the centroid of a thin splat by up to 4π σ² exp(-2π² σ²)
        // along each axis: by 0.08 and 0.11 px in an image of 96 x 50 px, and by 0.14 px in one of
        // 64 x 40. (The mean of two samples of each axis moves it by up to exp(-2π² σ²)/2.)
        let pi = std::f64::consts::PI;
        let moved_px =
            |variance_px2: f64| 4.0 * pi * variance_px2 * (-2.0 * pi * pi * variance_px2).exp();
        let filter = PixelFilter::new(&fine, &camera);
        let sampling_px = moved_px(filter.total_px2.x).hypot(moved_px(filter.total_px2.y));
        let most_px = 0.1_f64.max(sampling_px + 0.02);
        assert!(off_px < most_px, "{name}, {}: {off_px:.3} px from {at_px}", backend.name());
        seen += 1;
    }
    seen
}

/// A camera, a smaller size of it, and a part of its image.
pub(crate) fn scaled_and_cropped(camera: &Camera) -> [Camera; 3] {
    [*camera, camera.scaled(96, 50).unwrap(), camera.cropped([30, 20], [90, 70]).unwrap()]
}

/// Asserts that a backend's images through every lens have at least 45 dB against exact rays. The
/// images are small, because the reference backend takes seconds for exact rays.
pub(crate) fn check_against_exact_rays(backend: &dyn Backend) {
    let (street, pose) = street_scene();
    let exact = RenderProfile { rays: Rays::Exact, ..RenderProfile::default() };
    for (name, camera) in lenses() {
        let view = View::new(camera.scaled(80, 50).unwrap(), pose);
        let truth = render_one(&reference::Reference, &street, &exact, view);
        let drawn = render_one(backend, &street, &RenderProfile::default(), view);
        let db = psnr(&drawn.rgba, &truth.rgba);
        eprintln!("{name}, {}: {db:.1} dB against every pixel's ray", backend.name());
        assert!(db >= 45.0, "{name}, {}: {db:.1} dB", backend.name());
    }
}
