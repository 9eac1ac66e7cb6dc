//! Runs: Gaussians that learn the images of others.

use glam::DVec3;
use wildcity_render::compare::gaussians::forward_view;
use wildcity_render::compare::psnr::psnr_db;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gradient::{Differentiate, GaussianImages, Gradients};
use wildcity_render::{Frame, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, RenderProfile, Scene};
use wildcity_train::sample::Sample;
use wildcity_train::settings::{Growth, Settings};
use wildcity_train::trainer::{Start, Trainer};

use crate::scene_files::Random;

/// An image without a mask, a depth or a rig.
pub(crate) fn sample(view: View, rgb: &[f32]) -> Sample<'_> {
    Sample {
        view,
        image: 0,
        place: None,
        rgb,
        weights: None,
        sky: None,
        depth_m: None,
        background: [0.0; 3],
        weight: 1.0,
        exposure: 1.0,
    }
}

/// A run of some Gaussians.
fn trainer(gaussians: Gaussians, settings: Settings) -> Trainer {
    let start = Start { gaussians, ..Start::default() };
    Trainer::new(start, RenderProfile::default(), settings).expect("a run")
}

/// A wall of coloured patches 5 m ahead, seen from places before it.
pub(crate) fn wall() -> (Gaussians, Vec<View>) {
    let mut random = Random(3);
    let mut gaussians = Gaussians::with_capacity(0, 400);
    for _ in 0..400 {
        gaussians.means_m.push([6.0 * random.unit() - 3.0, 4.0 * random.unit() - 2.0, 5.0]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.ln_scales.push([random.between(-2.5, -1.0), random.between(-2.5, -1.0), -4.0]);
        gaussians.logit_opacities.push(random.between(0.0, 4.0));
        gaussians.sh.extend((0..3).map(|_| random.between(-1.5, 1.5)));
    }
    let view = forward_view([80, 60], 70.0);
    let views = (0..9).map(|k| {
        let position_m =
            DVec3::new(0.3 * f64::from(k % 3) - 0.3, 0.3 * f64::from(k / 3) - 0.3, 0.0);
        View { world_from_camera: Pose { position_m, ..view.world_from_camera }, ..view }
    });
    (gaussians, views.collect())
}

/// The image of a view on black.
pub(crate) fn image(cpu: &Cpu, scene: &Scene, view: View) -> Vec<f32> {
    let mut rgb = Vec::new();
    let frame = Frame { scene, profile: &RenderProfile::default(), views: &[view] };
    let mut keep = |images: &[GaussianImages]| {
        rgb = images[0].rgb.clone();
        images.to_vec()
    };
    cpu.differentiate(&frame, false, &mut keep, &mut Gradients::default()).expect("an image");
    rgb
}

/// A run from points near the wall; the PSNR of the view that was held out, and the Gaussians.
fn run(threads: usize, steps: usize) -> (f64, Gaussians) {
    let cpu = Cpu::new(threads, Simd::Best).unwrap();
    let (truth, views) = wall();
    let scene = Scene::from_gaussians(&truth);
    let images: Vec<Vec<f32>> = views.iter().map(|view| image(&cpu, &scene, *view)).collect();
    let mut random = Random(8);
    let mut start = Gaussians::with_capacity(0, 300);
    for _ in 0..300 {
        let mut near = |m: f64| m + 0.2 * (random.unit() - 0.5);
        start.means_m.push([near(0.0) * 30.0, near(0.0) * 20.0, near(5.0)]);
        start.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        start.ln_scales.push([-2.0; 3]);
        start.logit_opacities.push(-1.0);
        start.sh.extend([0.0; 3]);
    }
    let growth = Growth { cap: 600, from: 1_500, noise: 50.0, ..Growth::default() };
    let settings = Settings { steps, sh_degree: 1, growth, ..Settings::default() };
    let mut trainer = trainer(start, settings);
    for step in 0..steps {
        // One after the other, but the middle one, which is held out.
        let mut place = 5 * step % 8;
        place += usize::from(place >= 4);
        trainer.step(&cpu, &sample(views[place], &images[place])).expect("a step");
    }
    let seen = image(&cpu, trainer.model().scene(), views[4]);
    let differences = seen.iter().zip(&images[4]).map(|(a, b)| f64::from(a - b));
    (psnr_db(differences), trainer.model().to_gaussians())
}

#[test]
fn gaussians_learn_the_images_of_others() {
    let [(before_db, _), (after_db, gaussians)] = [run(0, 1), run(0, 600)];
    eprintln!("held out: {before_db:.1} dB, then {after_db:.1} dB, {} Gaussians", gaussians.len());
    assert!(before_db < 15.0 && after_db > 24.0, "{before_db} {after_db}");
    assert!((350..=600).contains(&gaussians.len()), "{}", gaussians.len());
}

#[test]
fn a_run_is_the_same_at_any_number_of_threads() {
    let (_, one) = run(1, 150);
    for threads in [2, 4] {
        let (_, other) = run(threads, 150);
        assert!(one == other, "{threads} threads");
    }
}

#[test]
fn what_a_run_cannot_use_is_named() {
    let (gaussians, views) = wall();
    let faults = [
        ("steps", Settings { steps: 0, ..Settings::default() }),
        ("sh_degree", Settings { sh_degree: 4, ..Settings::default() }),
        ("growth.least_opacity", with_growth(|growth| growth.least_opacity = f32::NAN)),
        ("growth.from", with_growth(|growth| growth.from = 26_000)),
        ("growth.until", with_growth(|growth| growth.until = 30_001)),
        ("growth.noise", with_growth(|growth| growth.noise = -1.0)),
        ("growth.rate", with_growth(|growth| growth.rate = 1.5)),
        ("coarse.halvings", changed(|settings| settings.coarse.halvings = 9)),
        ("coarse.until", changed(|settings| settings.coarse.until = 30_001)),
        ("poses.reach_m", changed(|settings| settings.poses.reach_m = 101.0)),
        ("poses.reach_rad", changed(|settings| settings.poses.reach_rad = -0.1)),
        ("poses.camera_reach_m", changed(|settings| settings.poses.camera_reach_m = f64::NAN)),
        ("poses.camera_reach_rad", changed(|settings| settings.poses.camera_reach_rad = 3.2)),
        ("sky.width", changed(|settings| settings.sky.width = 0)),
        ("sky.embedding", changed(|settings| settings.sky.embedding = 257)),
        ("exposure.weight", changed(|settings| settings.exposure.weight = f64::NAN)),
        ("ground.slice_m", changed(|settings| settings.ground.slice_m = 0.0)),
        ("ground.whole_until", changed(|settings| settings.ground.whole_until = 25_000)),
    ];
    for (field, settings) in faults {
        let error = settings.check().expect_err(field).to_string();
        assert!(error.starts_with(field), "{error}");
    }
    let run = |gaussians| {
        let start = Start { gaussians, ..Start::default() };
        Trainer::new(start, RenderProfile::default(), Settings::default())
    };
    let empty = run(Gaussians::default()).expect_err("nothing").to_string();
    assert!(empty.contains("no points"), "{empty}");
    let mut invalid = gaussians.clone();
    invalid.means_m[7][1] = f64::NAN;
    let invalid = run(invalid).expect_err("a NaN").to_string();
    assert!(invalid.contains("position[1]"), "{invalid}");

    let cpu = Cpu::new(1, Simd::Best).unwrap();
    let mut trainer = run(gaussians).unwrap();
    let mut rgb = vec![0.5; 3 * 80 * 60];
    rgb[33] = f32::NAN;
    let mut weights = vec![1.0; 80 * 60];
    let step = |trainer: &mut Trainer, rgb: &[f32], weights: &[f32]| {
        trainer.step(&cpu, &Sample { weights: Some(weights), ..sample(views[0], rgb) })
    };
    let error = step(&mut trainer, &rgb, &weights).expect_err("a NaN").to_string();
    assert!(error.contains("value 33 of the image"), "{error}");
    // Where nothing counts it may be anything.
    weights[11] = 0.0;
    step(&mut trainer, &rgb, &weights).expect("a step");
    weights[5] = -1.0;
    let error = step(&mut trainer, &rgb, &weights).expect_err("a weight").to_string();
    assert!(error.contains("value 5 of the mask"), "{error}");
    let error = step(&mut trainer, &rgb[3..], &weights).expect_err("a size").to_string();
    assert!(error.contains("asks for 14400"), "{error}");
}

fn with_growth(change: impl Fn(&mut Growth)) -> Settings {
    changed(|settings| change(&mut settings.growth))
}

fn changed(change: impl Fn(&mut Settings)) -> Settings {
    let mut settings = Settings::default();
    change(&mut settings);
    settings
}

/// A scene of a higher degree than the settings keeps its own.
#[test]
fn a_scene_of_degree_3_is_trained_on() {
    let (mut gaussians, views) = wall();
    gaussians.raise_sh_degree(3);
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let rgb = vec![0.5; 3 * 80 * 60];
    let mut trainer = trainer(gaussians, Settings::default());
    for _ in 0..3 {
        trainer.step(&cpu, &sample(views[0], &rgb)).expect("a step");
    }
    assert_eq!(trainer.model().sh_degree(), 3);
}

#[test]
fn gaussians_become_transparent_where_the_sky_is() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, views) = wall();
    let rgb = image(&cpu, &Scene::from_gaussians(&wall), views[4]);
    let pixels = views[4].camera.pixels();
    let is_sky: Vec<bool> = (0..pixels).map(|pixel| pixel % 80 < 40).collect();
    let opacity = |weight: f64| {
        let mut settings = Settings { steps: 100, ..Settings::default() };
        settings.growth.until = 0;
        settings.growth.from = 0;
        settings.loss.sky = weight;
        let mut run = trainer(wall.clone(), settings);
        for _ in 0..100 {
            let sky = Some(&is_sky[..]);
            run.step(&cpu, &Sample { sky, ..sample(views[4], &rgb) }).expect("a step");
        }
        let mut sums = [0.0_f64; 2];
        let frame = Frame {
            scene: run.model().scene(),
            profile: &RenderProfile::default(),
            views: &views[4..5],
        };
        let mut keep = |images: &[GaussianImages]| {
            for (opacity, is_sky) in images[0].opacity.iter().zip(&is_sky) {
                sums[usize::from(*is_sky)] += f64::from(*opacity);
            }
            images.to_vec()
        };
        cpu.differentiate(&frame, false, &mut keep, &mut Gradients::default()).expect("an image");
        sums.map(|sum| sum / (0.5 * pixels as f64))
    };
    let [without, with] = [0.0, 1.0].map(opacity);
    eprintln!("opacity of the wall and the sky: {without:?} without the term, {with:?} with it");
    assert!(with[1] < 0.5 * without[1] && with[0] > 0.8 * without[0]);
    let mut run = trainer(wall.clone(), Settings::default());
    let sky = Some(&is_sky[1..]);
    let error = run.step(&cpu, &Sample { sky, ..sample(views[4], &rgb) }).unwrap_err();
    assert!(error.to_string().contains("the sky has 4799 values"), "{error}");
}
