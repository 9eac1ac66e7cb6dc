//! The expansion of a lens around a Gaussian's centre, which stands for six points where both
//! differ by little.

use std::time::Instant;

use glam::{DQuat, DVec2, DVec3};
use wildcity_generate::StreetSettings;
use wildcity_render::compare::gaussians::{GaussianSpec, scene_from_specs};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::reference::Reference;
use wildcity_render::stage::Stage;
use wildcity_render::{Backend, Frame, RollingShutter, Target, View};
use wildcity_scene::geometry::camera::{Pinhole, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{RenderProfile, Rig, Scene};

use crate::images::{cpu, psnr, render_one};
use crate::lenses::{lenses, rolling_view, street_scene};
use crate::scene_files::Random;

/// The profile that projects six points of every Gaussian.
fn six_points() -> RenderProfile {
    RenderProfile { lens_error_px: 0.0, ..RenderProfile::default() }
}

/// The profile that expands lenses within 1/64 px of six points.
fn expanded() -> RenderProfile {
    RenderProfile { lens_error_px: 1.0 / 64.0, ..RenderProfile::default() }
}

/// The cameras of the real rig as a model reads them, and one of each model; at rest, and rolling.
fn views() -> Vec<(String, View)> {
    let real = Rig::preset("alpamayo2").unwrap().cameras;
    let real =
        real.into_iter().map(|mounted| (mounted.name, mounted.camera.scaled(576, 320).unwrap()));
    let models = lenses().into_iter().map(|(name, camera)| (name.to_owned(), camera));
    let pinhole = Pinhole { fx: 500.0, fy: 500.0, cx: 310.0, cy: 250.0 };
    let pinhole = ("pinhole".to_owned(), Camera::from_pinhole(640, 480, pinhole));
    let cameras = real.chain(models).chain([pinhole]);
    let both = cameras.flat_map(|(name, camera)| {
        let rolling = rolling_view(camera, Pose::IDENTITY, ShutterDirection::TopToBottom);
        [(format!("{name}, rolling"), rolling), (name, View::new(camera, Pose::IDENTITY))]
    });
    both.filter(|(name, _)| name != "pinhole").collect()
}

/// Gaussians of every shape and orientation that lie in the image, from 3 to 50 m away, with
/// standard deviations of a thousandth to a twentieth of that.
fn gaussians(view: &View, count: usize) -> Vec<GaussianSpec> {
    let mut random = Random(7);
    let mut specs = Vec::new();
    while specs.len() < count {
        let at_px = DVec2::new(random.unit(), random.unit()) * view.camera.size_px();
        let away_m = 3.0 + 47.0 * random.unit() * random.unit();
        let sigma_m = away_m * 1e-3 * 50.0_f64.powf(random.unit());
        let turn = DQuat::from_euler(
            glam::EulerRot::XYZ,
            6.0 * random.unit(),
            6.0 * random.unit(),
            6.0 * random.unit(),
        );
        let flat = DVec3::new(1.0, random.unit(), 0.01 + random.unit() * random.unit());
        if let Some(ray) = view.camera.unproject(at_px) {
            let mean_m = view.world_from_camera_at(at_px).transform_point(away_m * ray);
            let spec = GaussianSpec {
                mean_m,
                rotation: turn,
                sigma_m: sigma_m * flat,
                ..GaussianSpec::default()
            };
            specs.push(spec);
        }
    }
    specs
}

/// Screen ellipse of a splat: mean, and covariance (xx, xy, yy) in px², from its Cholesky factor.
fn ellipse(splat: &wildcity_render::layout::Splat) -> (DVec2, [f64; 3]) {
    let [l0, l1, l2] = splat.factor.map(|l| f64::from(l) / 0.849_321_8);
    // The inverse is [l0², l0 l1; l0 l1, l1² + l2²], and its determinant (l0 l2)².
    let det = (l0 * l2).powi(2);
    let covariance = [(l1 * l1 + l2 * l2) / det, -l0 * l1 / det, l0 * l0 / det];
    (DVec2::from_array(splat.mean_px.map(f64::from)), covariance)
}

/// How far two splats are apart: distance of the means, and largest difference of the standard
/// deviations in any direction.
fn apart_px(a: &wildcity_render::layout::Splat, b: &wildcity_render::layout::Splat) -> f64 {
    let (mean_a, cov_a) = ellipse(a);
    let (mean_b, cov_b) = ellipse(b);
    let sigma = |[xx, xy, yy]: [f64; 3], angle: f64| {
        let (y, x) = angle.sin_cos();
        (xx * x * x + 2.0 * xy * x * y + yy * y * y).sqrt()
    };
    let spread = (0..16).map(|k| {
        let angle = f64::from(k) * std::f64::consts::PI / 16.0;
        (sigma(cov_a, angle) - sigma(cov_b, angle)).abs()
    });
    mean_a.distance(mean_b) + spread.fold(0.0, f64::max)
}

/// The splats of a view by a profile.
fn splats(
    scene: &Scene,
    profile: &RenderProfile,
    view: View,
) -> Vec<wildcity_render::layout::Splat> {
    let frame = Frame { scene, profile, views: &[view] };
    cpu().run_through(&frame, Stage::Project).unwrap().0.splats
}

#[test]
fn expansions_are_as_close_to_six_points_as_the_bound_says() {
    for (name, view) in views() {
        let scene = scene_from_specs(&gaussians(&view, 4_000));
        let points = splats(&scene, &six_points(), view);
        for bound_px in [1.0 / 256.0, 1.0 / 64.0, 0.25] {
            let profile = RenderProfile { lens_error_px: bound_px, ..RenderProfile::default() };
            let expanded = splats(&scene, &profile, view);
            // All are in the image by far more than the bound.
            assert_eq!(expanded.len(), points.len(), "{name}");
            let apart = expanded.iter().zip(&points).map(|(a, b)| apart_px(a, b));
            let most = apart.fold(0.0, f64::max);
            let used = expanded.iter().zip(&points).filter(|(a, b)| a.factor != b.factor).count();
            let share = used as f64 / points.len() as f64;
            eprintln!("{name}, {bound_px} px: {most:.4} px apart, {:.0} % expanded", 100.0 * share);
            // 1e-3 px is the error of the f32 lens itself.
            assert!(most <= bound_px + 1.5e-3, "{name}: {most} px apart with {bound_px} px");
            assert!(share > 0.1, "{name}: {share} expanded");
        }
    }
}

#[test]
fn images_by_expansion_agree_with_the_definition() {
    let (street, pose) = street_scene();
    for (name, view) in views() {
        let mut view = View { world_from_camera: pose, ..view };
        if let Some(rolling) = &mut view.rolling_shutter {
            rolling.world_from_camera_first = pose * rolling.world_from_camera_first;
        }
        let truth = render_one(&Reference, &street, &RenderProfile::default(), view);
        let image = render_one(&cpu(), &street, &expanded(), view);
        let db = psnr(&image.rgba, &truth.rgba);
        eprintln!("{name}: {db:.1} dB against six points in f64");
        assert!(db >= 60.0, "{name}: {db:.1} dB");
    }
}

/// A rig in the demo street, and pinholes of the same sizes and horizontal fields of view, at most
/// 120°.
fn rig_and_pinholes(name: &str, size_px: Option<[u64; 2]>) -> (Vec<View>, Vec<View>) {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let world_from_rig = street.trajectory.at_station(60.0);
    let cameras = Rig::preset(name).unwrap().cameras;
    let both = cameras.into_iter().map(|mounted| {
        let camera = match size_px {
            Some([width, height]) => mounted.camera.scaled(width, height).unwrap(),
            None => mounted.camera,
        };
        let half_px = 0.5 * f64::from(camera.width_px);
        let left = camera.unproject(DVec2::new(0.5, camera.pinhole.cy)).unwrap();
        let half_rad = left.x.abs().atan2(left.z).min(60.0_f64.to_radians());
        let focal_px = half_px / half_rad.tan();
        let ideal = Pinhole { fx: focal_px, fy: focal_px, ..camera.pinhole };
        let mut pinhole = Camera::from_pinhole(camera.width_px, camera.height_px, ideal);
        pinhole.native_size_px = camera.native_size_px;
        let pose = world_from_rig * mounted.rig_from_camera;
        (View::new(camera, pose), View::new(pinhole, pose))
    });
    both.unzip()
}

/// Views while the car drives at 30 m/s and their rows are exposed in 30 ms.
fn rolling(views: &[View]) -> Vec<View> {
    let rolled = views.iter().map(|view| {
        let mut first = view.world_from_camera;
        first.position_m -= DVec3::new(0.9, 0.0, 0.0);
        let direction = ShutterDirection::TopToBottom;
        let rolling_shutter = RollingShutter { direction, world_from_camera_first: first };
        View { rolling_shutter: Some(rolling_shutter), ..*view }
    });
    rolled.collect()
}

/// Time of a step and of its stage `project`, in milliseconds.
#[derive(Clone, Copy)]
pub(crate) struct StepMs {
    pub(crate) step: f64,
    pub(crate) project: f64,
}

/// Renders a step to 8-bit colours.
pub(crate) fn step_ms(
    backend: &Cpu,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> StepMs {
    let mut images: Vec<Vec<u8>> =
        views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();
    let targets = images.iter_mut().map(|rgb8| Target { rgb8: Some(rgb8), ..Target::default() });
    let mut targets: Vec<Target<'_>> = targets.collect();
    let start = Instant::now();
    let frame = Frame { scene, profile, views };
    let stats = backend.render(&frame, &mut targets, &|_, _| {}).unwrap();
    let step = start.elapsed().as_secs_f64() * 1e3;
    let project = stats.stages_ms.iter().find(|(name, _)| *name == "project");
    StepMs { step, project: project.map_or(0.0, |(_, ms)| *ms) }
}

/// Median.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Times of two steps that ran in turn: the medians, and the median of the ratios of pairs.
pub(crate) fn paired(name: &str, a: &dyn Fn() -> StepMs, b: &dyn Fn() -> StepMs) -> f64 {
    a();
    b();
    let pairs: Vec<[StepMs; 2]> = (0..15).map(|_| [a(), b()]).collect();
    let of =
        |i: usize, part: fn(&StepMs) -> f64| median(pairs.iter().map(|p| part(&p[i])).collect());
    let ratio = median(pairs.iter().map(|[a, b]| a.step / b.step).collect());
    eprintln!(
        "{name}: step {:.1} against {:.1} ms, project {:.1} against {:.1} ms, ratio {ratio:.2}",
        of(0, |ms| ms.step),
        of(1, |ms| ms.step),
        of(0, |ms| ms.project),
        of(1, |ms| ms.project),
    );
    ratio
}

/// `alpamayo2` against six pinholes and with the expansion, and rolling shutters against global
/// ones.
#[test]
#[ignore = "times: cargo test -p wildcity-render --test render lenses_and_shutters_cost -- --ignored --nocapture"]
fn lenses_and_shutters_cost_little_more_than_pinholes() {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let scene = Scene::from_gaussians(&street.gaussians);
    let backend = cpu();
    let default = RenderProfile::default();
    assert_eq!(default.lens_error_px, 0.0, "six points are the default");
    let step = |profile: &RenderProfile, views: &[View]| step_ms(&backend, &scene, profile, views);
    let mut wrong = Vec::new();
    for size_px in [[576, 320], [1920, 1080]] {
        let (bent, pinholes) = rig_and_pinholes("alpamayo2", Some(size_px));
        let name = format!("alpamayo2 at {size_px:?} and pinholes");
        let ratio = paired(&name, &|| step(&default, &bent), &|| step(&default, &pinholes));
        let name = format!("alpamayo2 at {size_px:?}, expanded and by six points");
        paired(&name, &|| step(&expanded(), &bent), &|| step(&default, &bent));
        if ratio > 1.3 {
            wrong.push(format!("{size_px:?}: {ratio:.2}"));
        }
        let rolled = rolling(&bent);
        let name = format!("alpamayo2 at {size_px:?}, rolling and global");
        paired(&name, &|| step(&default, &rolled), &|| step(&default, &bent));
    }
    let (_, global) = rig_and_pinholes("vehicle6", None);
    let rolled = rolling(&global);
    let ratio = paired("vehicle6, rolling and global", &|| step(&default, &rolled), &|| {
        step(&default, &global)
    });
    paired(
        "vehicle6, rolling, expanded and by six points",
        &|| step(&expanded(), &rolled),
        &|| step(&default, &rolled),
    );
    if ratio > 1.5 {
        wrong.push(format!("rolling: {ratio:.2}"));
    }
    assert!(wrong.is_empty(), "{wrong:?}");
}

/// Instruction sets differ only in rounding, and so do the splats that expand.
#[test]
fn every_instruction_set_expands_the_same_splats() {
    let (street, pose) = street_scene();
    let view = View::new(lenses()[2].1, pose);
    let frame = Frame { scene: &street, profile: &expanded(), views: &[view] };
    let of =
        |simd: Simd| Some(Cpu::new(1, simd).ok()?.run_through(&frame, Stage::Project).unwrap().0);
    let best = of(Simd::Best).unwrap();
    let others = [of(Simd::Avx512), of(Simd::Avx2), of(Simd::Sse42)];
    for other in others.into_iter().flatten() {
        let pairs = best.splats.iter().zip(&other.splats);
        let most = pairs.map(|(a, b)| apart_px(a, b)).fold(0.0, f64::max);
        assert_eq!(best.splats.len(), other.splats.len());
        assert!(most < 1.0 / 64.0, "{most}");
    }
}
