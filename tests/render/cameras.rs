//! Images by lenses and rolling shutters, compared with the analytic projection, with exact rays,
//! and with the same scene rendered row by row.

use glam::{DMat3, DQuat, DVec2, DVec3};
use wildcity_render::compare::gaussians::{GaussianSpec, scene_from_specs};
use wildcity_render::compare::reprojection::centroid;
use wildcity_render::reference::Reference;
use wildcity_render::unscented::UnscentedView;
use wildcity_render::{Backend, RenderError, RollingShutter, Target, View};
use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, Pinhole, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Rays, RenderProfile, Scene};

use crate::images::{agree, cpu, max_difference, psnr, render, render_one, try_render};
use crate::lenses::{
    check_against_exact_rays, check_projections, lenses, rolling_view, scaled_and_cropped,
    sideways_rolling_view, street_scene,
};

#[test]
fn known_points_land_where_the_model_says() {
    for (name, camera) in lenses() {
        for (camera, least) in scaled_and_cropped(&camera).into_iter().zip([20, 20, 5]) {
            let points = check_projections(&cpu(), name, camera, 0.3);
            assert!(points >= least, "{name}: {points} points");
        }
        check_projections(&Reference, name, camera.scaled(64, 40).unwrap(), 0.3);
    }
}

/// The profile with exact rays.
fn exact() -> RenderProfile {
    RenderProfile { rays: Rays::Exact, ..RenderProfile::default() }
}

#[test]
fn every_lens_draws_what_each_pixels_ray_meets() {
    check_against_exact_rays(&Reference);
}

#[test]
fn the_cpu_backend_draws_lenses_as_they_are_defined() {
    let (street, pose) = street_scene();
    for (name, camera) in lenses() {
        let view = View::new(camera, pose);
        let profile = RenderProfile::default();
        let truth = render_one(&Reference, &street, &profile, view);
        assert!(truth.opacity.iter().any(|&o| o > 0.5), "{name}: the view is empty");
        let image = render_one(&cpu(), &street, &profile, view);
        agree(&image, &truth).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
    // With other settings of the profile.
    for setting in ["antialiased=true", "near=3", "far=30", "blur=0.1"] {
        let mut profile = RenderProfile::default();
        profile.set(setting).unwrap();
        let view = View::new(lenses()[1].1, pose);
        let truth = render_one(&Reference, &street, &profile, view);
        agree(&render_one(&cpu(), &street, &profile, view), &truth).unwrap();
    }
}

#[test]
fn zero_distortion_draws_the_bytes_of_a_pinhole() {
    let (street, pose) = street_scene();
    let ideal = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let none = Lens::opencv(OpenCv::new([0.0; 6], [0.0; 2], [0.0; 4]));
    let still =
        RollingShutter { direction: ShutterDirection::TopToBottom, world_from_camera_first: pose };
    let same = View::new(Camera { lens: none, ..ideal }, pose);
    let profile = RenderProfile::default();
    let image = render_one(&cpu(), &street, &profile, View::new(ideal, pose));
    assert!(render_one(&cpu(), &street, &profile, same) == image);
    // With a rolling shutter at rest the image differs only by the unscented transform, which
    // replaces linearisation.
    let unmoved = View { rolling_shutter: Some(still), ..same };
    let db = psnr(&render_one(&cpu(), &street, &profile, unmoved).rgba, &image.rgba);
    eprintln!("a pinhole by six points: {db:.1} dB of a pinhole");
    assert!(db > 40.0, "{db:.1} dB");
    // A tiny distortion hardly changes the image.
    let hardly = Lens::opencv(OpenCv::new([1e-9, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2], [0.0; 4]));
    let hardly = View::new(Camera { lens: hardly, ..ideal }, pose);
    let off = max_difference(
        &render_one(&cpu(), &street, &profile, hardly).rgba,
        &render_one(&cpu(), &street, &profile, unmoved).rgba,
    );
    assert!(off < 2.0 / 255.0, "off by {off}");
}

/// A fisheye of 220° with its image circle within the image.
fn fisheye_220() -> Camera {
    let lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(110_f64.to_radians())));
    let pinhole = Pinhole { fx: 24.0, fy: 24.0, cx: 60.0, cy: 50.0 };
    Camera { lens, ..Camera::from_pinhole(120, 100, pinhole) }
}

#[test]
fn t23_beyond_180_degrees_and_never_around() {
    let camera = fisheye_220();
    assert_eq!(camera.check(), Ok(()));
    // A ball exactly behind, and one at 100° to the right, where no pinhole sees.
    let behind = GaussianSpec { mean_m: DVec3::new(0.0, 0.0, -3.0), ..GaussianSpec::default() };
    let (sin, cos) = 100_f64.to_radians().sin_cos();
    let right = GaussianSpec { mean_m: 3.0 * DVec3::new(sin, 0.0, cos), ..GaussianSpec::default() };
    let view = View::new(camera, Pose::IDENTITY);
    let profile = RenderProfile::default();
    for backend in [&Reference as &dyn Backend, &cpu()] {
        let image =
            render_one(backend, &scene_from_specs(&[point_behind(&behind)]), &profile, view);
        assert!(image.opacity.iter().all(|&o| o == 0.0), "{}: from behind", backend.name());
        let image = render_one(backend, &scene_from_specs(&[point_behind(&right)]), &profile, view);
        let at_px = camera.project(right.mean_m).unwrap();
        let found_px = centroid(&image.opacity, [120, 100], at_px, f64::INFINITY).unwrap();
        assert!(found_px.distance(at_px) < 0.3);
        // A wall all around: exactly the pixels within the lens' field are covered.
        let wall = GaussianSpec {
            sigma_m: DVec3::splat(50.0),
            mean_m: DVec3::Z,
            ..GaussianSpec::default()
        };
        let image = render_one(backend, &scene_from_specs(&[wall]), &profile, view);
        for (pixel, &opacity) in image.opacity.iter().enumerate() {
            let at_px = DVec2::new((pixel % 120) as f64 + 0.5, (pixel / 120) as f64 + 0.5);
            let seen = camera.unproject(at_px).is_some();
            assert_eq!(opacity > 0.0, seen, "{} at {at_px}: {opacity}", backend.name());
            if !seen {
                assert_eq!(image.rgb8[3 * pixel..3 * pixel + 3], [0; 3]);
                assert_eq!(image.depth_m[pixel], 0.0);
            }
        }
    }
    // A street all around, against exact rays.
    let (street, pose) = street_scene();
    let view = View { world_from_camera: pose, ..view };
    let truth = render_one(&Reference, &street, &exact(), view);
    let drawn = render_one(&cpu(), &street, &RenderProfile::default(), view);
    let db = psnr(&drawn.rgba, &truth.rgba);
    eprintln!("a fisheye of 220°: {db:.1} dB against every pixel's ray");
    assert!(db >= 40.0, "{db:.1} dB");
}

fn point_behind(blob: &GaussianSpec) -> GaussianSpec {
    GaussianSpec { mean_m: blob.mean_m, ..GaussianSpec::default() }
}

#[test]
fn t5_a_camera_within_a_gaussian_and_one_before_it() {
    let inside = GaussianSpec {
        mean_m: DVec3::new(0.1, 0.0, 0.3),
        sigma_m: DVec3::splat(2.0),
        ..GaussianSpec::default()
    };
    let behind = GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, -2.0),
        sigma_m: DVec3::splat(0.3),
        ..GaussianSpec::default()
    };
    for (name, camera) in lenses() {
        let view = View::new(camera, Pose::IDENTITY);
        let profile = RenderProfile::default();
        let truth =
            render_one(&Reference, &scene_from_specs(&[behind_of_size(&inside)]), &profile, view);
        let image =
            render_one(&cpu(), &scene_from_specs(&[behind_of_size(&inside)]), &profile, view);
        agree(&image, &truth).unwrap_or_else(|e| panic!("{name}: {e}"));
        let image =
            render_one(&cpu(), &scene_from_specs(&[behind_of_size(&behind)]), &profile, view);
        assert!(image.opacity.iter().all(|&o| o == 0.0), "{name}: a mirrored contribution");
    }
}

fn behind_of_size(blob: &GaussianSpec) -> GaussianSpec {
    GaussianSpec { mean_m: blob.mean_m, sigma_m: blob.sigma_m, ..GaussianSpec::default() }
}

#[test]
fn t2_long_things_on_the_ground_beside_the_view() {
    for (name, camera) in lenses() {
        let view = View::new(camera, Pose::IDENTITY);
        for [x, y] in [[6.0, 1.6], [-6.0, 1.6], [0.5, 5.0]] {
            for angle in [0.0, 0.5, 1.2, 2.5] {
                let long = scene_from_specs(&[GaussianSpec {
                    mean_m: DVec3::new(x, y, 4.0),
                    rotation: DQuat::from_rotation_y(angle),
                    sigma_m: DVec3::new(2.0, 0.05, 0.3),
                    ..GaussianSpec::default()
                }]);
                let profile = RenderProfile::default();
                let truth = render_one(&Reference, &long, &profile, view);
                let image = render_one(&cpu(), &long, &profile, view);
                agree(&image, &truth)
                    .unwrap_or_else(|e| panic!("{name}: ({x}, {y}) at {angle}: {e}"));
            }
        }
    }
}

#[test]
fn t18_a_part_of_a_lens_image_is_the_image_of_the_part() {
    let (street, pose) = street_scene();
    for (name, camera) in lenses() {
        let whole = render_one(&cpu(), &street, &RenderProfile::default(), View::new(camera, pose));
        for [left, top] in [[0, 0], [90, 48], [61, 17]] {
            let part = camera.cropped([left, top], [70, 52]).unwrap();
            let image =
                render_one(&cpu(), &street, &RenderProfile::default(), View::new(part, pose));
            for row in 0..52 {
                let from = 4 * ((row + top as usize) * 160 + left as usize);
                let off = max_difference(
                    &image.rgba[4 * row * 70..4 * (row + 1) * 70],
                    &whole.rgba[from..from + 4 * 70],
                );
                assert!(off <= 2e-3, "{name} at {left}, {top}, row {row}: off by {off}");
            }
        }
    }
}

#[test]
fn t24_a_rolling_shutter_is_a_render_of_each_row_in_its_turn() {
    let (street, pose) = street_scene();
    let ideal = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let profile = RenderProfile::default();
    let fisheye = lenses()[1].1;
    for (name, camera) in [("pinhole", ideal), ("fisheye", fisheye)] {
        for direction in [
            ShutterDirection::TopToBottom,
            ShutterDirection::BottomToTop,
            ShutterDirection::LeftToRight,
            ShutterDirection::RightToLeft,
        ] {
            let view = rolling_view(camera, pose, direction);
            let image = render_one(&cpu(), &street, &profile, view);
            let across =
                matches!(direction, ShutterDirection::LeftToRight | ShutterDirection::RightToLeft);
            // Each row by itself, with exact rays, from the camera's pose when the row is exposed.
            let rows: u32 = if across { 160 } else { 100 };
            let mut truth = vec![0.0_f32; 4 * 160 * 100];
            for row in (0..rows).step_by(11) {
                let at_px = DVec2::splat(f64::from(row) + 0.5);
                let world_from_camera = view.world_from_camera_at(at_px);
                let (corner, size) = if across {
                    ([u64::from(row), 0], [1, 100])
                } else {
                    ([0, u64::from(row)], [160, 1])
                };
                let strip = View::new(camera.cropped(corner, size).unwrap(), world_from_camera);
                let strip = render_one(&Reference, &street, &exact(), strip).rgba;
                for (k, value) in strip.chunks_exact(4).enumerate() {
                    let pixel =
                        if across { k * 160 + row as usize } else { row as usize * 160 + k };
                    truth[4 * pixel..4 * pixel + 4].copy_from_slice(value);
                }
            }
            let of_rows: (Vec<f32>, Vec<f32>) = image
                .rgba
                .chunks_exact(4)
                .zip(truth.chunks_exact(4))
                .enumerate()
                .filter(|(pixel, _)| (if across { pixel % 160 } else { pixel / 160 }) % 11 == 0)
                .flat_map(|(_, (a, b))| a.iter().copied().zip(b.iter().copied()))
                .unzip();
            let db = psnr(&of_rows.0, &of_rows.1);
            let still = View { rolling_shutter: None, ..view };
            let still = render_one(&cpu(), &street, &profile, still);
            let without = psnr(&still.rgba, &image.rgba);
            eprintln!(
                "{name}, {direction:?}: {db:.1} dB of row by row; {without:.1} dB of no rolling"
            );
            assert!(db >= 45.0, "{name}, {direction:?}: {db:.1} dB");
            assert!(without < 30.0, "{name}: the shutter changed nothing");
        }
    }
}

#[test]
fn the_cpu_backend_rolls_as_it_is_defined() {
    let (street, pose) = street_scene();
    for camera in [lenses()[0].1, lenses()[2].1] {
        let view = rolling_view(camera, pose, ShutterDirection::TopToBottom);
        let truth = render_one(&Reference, &street, &RenderProfile::default(), view);
        let image = render_one(&cpu(), &street, &RenderProfile::default(), view);
        agree(&image, &truth).unwrap();
    }
    // The ray of a point's image leads from the camera's pose at that moment to the point.
    let view = rolling_view(lenses()[0].1, Pose::IDENTITY, ShutterDirection::BottomToTop);
    let point_m = DVec3::new(0.4, -0.3, 2.0);
    let at_px = view.project_world(point_m).unwrap();
    let pose = view.world_from_camera_at(at_px);
    let ray = view.ray_world(at_px).unwrap();
    let off_rad = ray.angle_between(point_m - pose.position_m);
    assert!(off_rad < 1e-6, "{off_rad:e}");
}

#[test]
fn what_passes_close_is_seen_by_the_column_that_it_lands_on() {
    let view = sideways_rolling_view();
    for step in 0..200 {
        let point_m = DVec3::new(0.02 * f64::from(step) - 2.0, 0.1, 1.5);
        let landed = view.project_extrapolated(point_m, 1.0);
        let exposed = ShutterDirection::LeftToRight.fraction(landed.at_px, &view.camera);
        assert!((exposed - landed.fraction).abs() < 1e-6, "{point_m}: {landed:?}");
    }
    let balls: Vec<GaussianSpec> = (0..5)
        .map(|k| GaussianSpec {
            mean_m: DVec3::new(0.5 * f64::from(k) - 1.5, 0.1, 1.5),
            sigma_m: DVec3::splat(0.05),
            ..GaussianSpec::default()
        })
        .collect();
    let profile = RenderProfile::default();
    let truth = render_one(&Reference, &scene_from_specs(&balls), &profile, view);
    assert!(truth.opacity.iter().filter(|&&o| o > 0.5).count() > 50, "little is seen");
    agree(&render_one(&cpu(), &scene_from_specs(&balls), &profile, view), &truth).unwrap();
}

#[test]
fn t22_six_points_scatter_as_a_million() {
    // An inclined wide disc through the fisheye: mean and covariance on the image, by sampling
    // points.
    let camera = lenses()[1].1;
    let view = View::new(camera, Pose::IDENTITY);
    let unscented = UnscentedView::new(&view, &RenderProfile::default()).unwrap();
    let mean_m = DVec3::new(0.6, 0.3, 1.5);
    let axes_m = DMat3::from_quat(DQuat::from_rotation_y(0.7))
        * DMat3::from_diagonal(DVec3::new(0.2, 0.3, 0.01));
    let footprint = unscented.project(mean_m, axes_m).unwrap();
    let covariance = |columns: &[DVec2]| {
        let sum = |f: fn(&DVec2) -> f64| columns.iter().map(f).sum::<f64>();
        [sum(|c| c.x * c.x), sum(|c| c.x * c.y), sum(|c| c.y * c.y)]
    };
    let six = covariance(&footprint.root_px);

    let mut random = crate::scene_files::Random(77);
    let mut normal = || {
        let u = random.unit().max(1e-300);
        let v = random.unit();
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    };
    let samples: Vec<DVec2> = (0..200_000)
        .map(|_| {
            let unit = DVec3::new(normal(), normal(), normal());
            camera.project_extrapolated(mean_m + axes_m * unit)
        })
        .collect();
    let count = samples.len() as f64;
    let mean_px = samples.iter().sum::<DVec2>() / count;
    let off: Vec<DVec2> = samples.iter().map(|s| (s - mean_px) / count.sqrt()).collect();
    let many = covariance(&off);
    let off_px = footprint.mean_px.distance(mean_px);
    eprintln!("six points: mean off by {off_px:.3} px, covariance {six:.1?} for {many:.1?}");
    assert!(off_px < 0.2, "{off_px} px");
    let size = many[0] + many[2];
    for (six, many) in six.into_iter().zip(many) {
        assert!((six - many).abs() < 0.02 * size, "{six} for {many}");
    }
}

#[test]
fn exact_rays_are_for_the_reference_alone() {
    let (_, pose) = street_scene();
    let view = View::new(lenses()[0].1, pose);
    let refused = try_render(&cpu(), &Scene::default(), &exact(), &[view]).unwrap_err();
    assert_eq!(refused, RenderError::ExactRays { backend: "cpu" });
    assert!(refused.to_string().contains("rays=splats"), "{refused}");
    let mut rgb8 = vec![7; 3 * view.camera.pixels()];
    let target = Target { rgb8: Some(&mut rgb8), ..Target::default() };
    let frame =
        wildcity_render::Frame { scene: &Scene::default(), profile: &exact(), views: &[view] };
    assert!(cpu().render(&frame, &mut [target], &|_, _| {}).is_err());
    assert!(rgb8.iter().all(|&b| b == 7), "nothing was written");
}

#[test]
fn exact_rays_of_a_pinhole_are_its_splats_but_for_the_linearisation() {
    let (street, pose) = street_scene();
    let ideal = Camera::from_pinhole(160, 100, Pinhole { fx: 90.0, fy: 92.0, cx: 79.0, cy: 51.0 });
    let view = View::new(ideal, pose);
    let truth = render_one(&Reference, &street, &exact(), view);
    let drawn = render_one(&Reference, &street, &RenderProfile::default(), view);
    let db = psnr(&drawn.rgba, &truth.rgba);
    eprintln!("pinhole: {db:.1} dB against every pixel's ray");
    assert!(db >= 40.0, "{db:.1} dB");
}

#[test]
fn lenses_and_pinholes_share_a_frame() {
    let (street, pose) = street_scene();
    let ideal = Camera::from_pinhole(90, 70, Pinhole { fx: 60.0, fy: 60.0, cx: 45.0, cy: 35.0 });
    let views: Vec<View> =
        [lenses()[2].1, ideal, fisheye_220()].map(|c| View::new(c, pose)).to_vec();
    let backend = cpu();
    let profile = RenderProfile::default();
    let together = render(&backend, &street, &profile, &views);
    for (view, image) in views.iter().zip(&together) {
        assert!(render_one(&backend, &street, &profile, *view) == *image);
    }
}
