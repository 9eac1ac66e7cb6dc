//! Lenses and rolling shutters on the device: as the cpu backend draws them, and nothing of them for a
//! pinhole.

use glam::{DQuat, DVec2, DVec3};
use wildcity::geometry::camera::{Rolls, Windshield, WindshieldReference};
use wildcity::geometry::{Camera, Pose};
use wildcity::render::gpu::shaders::Shaders;
use wildcity::render::gpu::{AdapterChoice, Gpu};
use wildcity::render::reference::Reference;
use wildcity::render::{RenderError, Rolling, View};
use wildcity::report::stress::blobs::{Blob, scene};
use wildcity::scene::{Gaussians, Rays, RenderProfile, Rig, Scene};

use crate::gpu::{gpu, gpu_with};
use crate::images::{Image, agree, cpu, look, psnr, render, render_one, try_render};
use crate::lenses::lenses;
use crate::streets::{demo_street, street};

/// Along a street, as [`crate::streets::street_views`] are.
fn straight() -> View {
    let at = DVec3::new(0.4, 0.0, 20.0);
    look([150, 90], 110.0, at, DVec3::new(0.15, 0.03, 1.0), DVec3::Y)
}

/// 0.9 m and 0.01 rad during the exposure: 30 m/s for 30 ms, in a curve.
fn driven(camera: Camera, direction: Rolls) -> View {
    let pose = straight().world_from_camera;
    let world_from_camera_first = Pose {
        position_m: pose.position_m - pose.rotation * DVec3::new(0.05, 0.0, 0.9),
        rotation: pose.rotation * DQuat::from_rotation_y(-0.01),
    };
    let rolling = Some(Rolling { direction, world_from_camera_first });
    View { camera, world_from_camera: pose, rolling }
}

/// Every lens at rest, and shutters that roll all four ways; one windshield is given the other way round.
pub(crate) fn bent_views() -> Vec<View> {
    let lenses = lenses();
    let camera = |name: &str| lenses.iter().find(|(known, _)| *known == name).unwrap().1;
    let behind = camera("fisheye behind a windshield");
    let shield = behind.windshield.unwrap();
    let (horizontal, vertical) = (*shield.horizontal(), *shield.vertical());
    let shield = Windshield::new(WindshieldReference::Backward, horizontal, vertical);
    let behind = Camera { windshield: Some(shield), ..behind };
    let pose = straight().world_from_camera;
    let still = lenses.iter().map(|(_, camera)| View::new(*camera, pose));
    let rolling = [
        driven(straight().camera, Rolls::TopToBottom),
        driven(camera("opencv"), Rolls::BottomToTop),
        driven(behind, Rolls::LeftToRight),
        driven(camera("f-theta by pixels"), Rolls::RightToLeft),
    ];
    still.chain(rolling).collect()
}

#[test]
fn lenses_and_shutters_are_drawn_as_by_the_cpu() {
    let gpu = gpu();
    let street = Scene::from_gaussians(&street(20_000, 1, 31));
    let views: Vec<View> = bent_views().into_iter().chain([straight()]).collect();
    for setting in ["near=0.01", "antialiased=true", "near=3", "far=30", "blur=0.1"] {
        let mut profile = RenderProfile::default();
        profile.set(setting).unwrap();
        let truths = render(&cpu(), &street, &profile, &views);
        for (k, (image, truth)) in
            render(&gpu, &street, &profile, &views).iter().zip(&truths).enumerate()
        {
            let db = agree(image, truth).unwrap_or_else(|e| panic!("view {k}, {setting}: {e}"));
            eprintln!("{setting}, view {k}: {db:.1} dB of the cpu backend");
        }
    }
}

/// Thousands of surfels of one plane: seen by z, by distance, and by a camera that moves meanwhile.
#[test]
fn the_demo_street_through_lenses_and_shutters() {
    let (street, views) = demo_street();
    let scene = Scene::from_gaussians(&street);
    let pose = views[0].world_from_camera;
    let lens = |k: usize| View::new(lenses()[k].1, pose);
    let roll = |view: View, direction| {
        let world_from_camera_first = Pose {
            position_m: pose.position_m - pose.rotation * DVec3::new(0.05, 0.0, 0.9),
            ..pose
        };
        View { rolling: Some(Rolling { direction, world_from_camera_first }), ..view }
    };
    let views = [
        lens(0),
        lens(1),
        lens(2),
        roll(views[0], Rolls::TopToBottom),
        roll(lens(2), Rolls::LeftToRight),
    ];
    let profile = RenderProfile::default();
    let truths = render(&cpu(), &scene, &profile, &views);
    for (k, (image, truth)) in
        render(&gpu(), &scene, &profile, &views).iter().zip(&truths).enumerate()
    {
        let db = psnr(&image.rgba, &truth.rgba);
        eprintln!("demo street, view {k}: {db:.1} dB of the cpu backend");
        assert!(db >= 60.0, "view {k}: {db:.1} dB");
    }
}

#[test]
fn every_lens_draws_what_each_pixels_ray_meets() {
    let street = Scene::from_gaussians(&street(20_000, 1, 31));
    let exact = RenderProfile { rays: Rays::Exact, ..RenderProfile::default() };
    let pose = straight().world_from_camera;
    let gpu = gpu();
    for (name, camera) in lenses() {
        let view = View::new(camera, pose);
        let truth = render_one(&Reference, &street, &exact, view);
        let drawn = render_one(&gpu, &street, &RenderProfile::default(), view);
        let db = psnr(&drawn.rgba, &truth.rgba);
        eprintln!("{name}: {db:.1} dB against every pixel's ray");
        assert!(db >= 45.0, "{name}: {db:.1} dB");
    }
}

/// Where what is seen of a ball within 12 px of a place is, weighted by opacity.
fn centroid(image: &Image, camera: &Camera, around_px: DVec2) -> DVec2 {
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for (pixel, &opacity) in image.opacity.iter().enumerate() {
        let (row, column) = (pixel as u32 / camera.width_px, pixel as u32 % camera.width_px);
        let at_px = DVec2::new(f64::from(column), f64::from(row)) + 0.5;
        if (at_px - around_px).abs().max_element() <= 12.0 {
            sum += f64::from(opacity) * at_px;
            weight += f64::from(opacity);
        }
    }
    sum / weight
}

/// A target of small opaque balls, 0.6 m apart on a wall 2 m ahead, one at a time; of every model, at half
/// its size, and in a part of its image.
#[test]
fn known_points_land_where_the_model_says() {
    let gpu = gpu();
    let fine = RenderProfile { alpha_cut: 1e-5, ..RenderProfile::default() };
    for (name, camera) in lenses() {
        let half = camera.scaled(96, 50).unwrap();
        let part = camera.cropped([30, 20], [90, 70]).unwrap();
        for camera in [camera, half, part] {
            let mut seen = 0;
            for (i, k) in (-2..=2).flat_map(|i| (-1..=1).map(move |k| (i, k))) {
                let mean_m = DVec3::new(0.6 * f64::from(i), 0.6 * f64::from(k), 2.0);
                let Some(at_px) = camera.project(mean_m) else { continue };
                let edge_px = at_px.min(camera.size_px() - at_px).min_element();
                if edge_px < 5.0 {
                    continue;
                }
                let ball = Blob { mean_m, sigma_m: DVec3::splat(0.003), ..Blob::default() };
                let view = View::new(camera, Pose::IDENTITY);
                let image = render_one(&gpu, &scene(&[ball]), &fine, view);
                let off_px = centroid(&image, &camera, at_px).distance(at_px);
                assert!(off_px < 0.1, "{name}: {off_px:.3} px from {at_px}");
                seen += 1;
            }
            assert!(seen >= 2, "{name}: {seen} points");
        }
    }
}

/// The f-theta cameras of a real car, at full size and at that which a model reads.
#[test]
fn a_real_cars_points_land_where_its_lenses_say() {
    let gpu = gpu();
    let rig = Rig::preset("alpamayo2").unwrap();
    let full = rig.cameras[..2].iter().map(|mounted| mounted.camera);
    let small = rig.cameras.iter().map(|mounted| mounted.camera.scaled(576, 320).unwrap());
    for camera in full.chain(small) {
        let mut balls = Gaussians::with_capacity(0, 0);
        let mut wanted = Vec::new();
        for (column, row) in (0..7).flat_map(|i| (0..5).map(move |k| (f64::from(i), f64::from(k))))
        {
            let share = (DVec2::new(column, row) + 0.5) / DVec2::new(7.0, 5.0);
            let at_px = (share * camera.size_px()).floor() + 0.37;
            let rays = camera.unproject(at_px).zip(camera.unproject(at_px + DVec2::X));
            let Some((ray, beside)) = rays else { continue };
            balls.means_m.push((10.0 * ray).to_array());
            balls.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            balls.ln_scales.push([(20.0 * ray.angle_between(beside)).ln() as f32; 3]);
            balls.logit_opacities.push(2.0);
            balls.sh.extend([1.0; 3]);
            wanted.push(at_px);
        }
        let scene = Scene::from_gaussians(&balls);
        let view = View::new(camera, Pose::IDENTITY);
        let image = render_one(&gpu, &scene, &RenderProfile::default(), view);
        let off_px = wanted.iter().map(|&at_px| centroid(&image, &camera, at_px).distance(at_px));
        let worst_px = off_px.fold(0.0, f64::max);
        eprintln!("{} x {}: {worst_px:.3} px", camera.width_px, camera.height_px);
        assert!(wanted.len() > 20 && worst_px < 0.1, "{} points, {worst_px} px", wanted.len());
    }
}

/// What is not compiled cannot fail: the projection of lenses does not parse here.
#[test]
fn without_a_lens_nothing_of_it_is_compiled() {
    let broken = || {
        let shaders = Shaders::default();
        shaders.with_slip("project_bent", "struct Exposed {", "struct Nothing {").unwrap()
    };
    let (street, profile) = (Scene::from_gaussians(&street(300, 0, 1)), RenderProfile::default());
    render_one(&gpu_with(broken()), &street, &profile, straight());
    // Nobody listens here: this one is to fail.
    let gpu = Gpu::with_shaders(&AdapterChoice::Best, 0, broken()).unwrap();
    let failed = try_render(&gpu, &street, &profile, &bent_views()[..1]);
    assert!(matches!(failed, Err(RenderError::Device { .. })), "{failed:?}");
}

#[test]
fn a_pinhole_beside_a_lens_is_drawn_to_the_byte() {
    let (street, profile) = (Scene::from_gaussians(&street(5_000, 1, 2)), RenderProfile::default());
    let gpu = gpu();
    let alone = render(&gpu, &street, &profile, &[straight()]);
    let pipelines = gpu.usage().unwrap().made.pipelines;
    let [before, after] = [bent_views()[1], bent_views()[7]];
    let together = render(&gpu, &street, &profile, &[before, straight(), after]);
    assert!(together[1..2] == alone);
    assert_eq!(gpu.usage().unwrap().made.pipelines, pipelines + 2, "cull and project");
    assert!(render(&gpu, &street, &profile, &[straight()]) == alone);
    assert_eq!(gpu.usage().unwrap().made.pipelines, pipelines + 2);
}
