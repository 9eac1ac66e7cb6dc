//! What is trained beside the Gaussians: poses, exposures, the sky; the ground; and checkpoints.

use glam::{DQuat, DVec3};
use wildcity_render::View;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, RenderProfile, Scene};
use wildcity_train::checkpoint::CheckpointError;
use wildcity_train::ground::is_ground;
use wildcity_train::poses::{Place, RigPoses};
use wildcity_train::sample::Sample;
use wildcity_train::settings::{Growth, PoseMode, Rates, Settings, SkyMode};
use wildcity_train::trainer::{Fixed, Start, TrainError, Trainer};

use crate::scene_files::Random;
use crate::training::{image, sample, wall};

/// The wall as two cameras of a rig see it at five times.
struct Rigged {
    truth: Gaussians,
    rig: RigPoses,
    views: Vec<(View, Place)>,
    images: Vec<Vec<f32>>,
}

impl Rigged {
    fn new(cpu: &Cpu) -> Self {
        let (mut truth, views) = wall();
        // Patches at 3 to 8 m: before a flat wall, a turn is as good as a step to the side.
        let mut random = Random(2);
        for mean_m in &mut truth.means_m {
            let factor = 0.6 + random.unit();
            *mean_m = mean_m.map(|m| factor * m);
        }
        let scene = Scene::from_gaussians(&truth);
        let yaw = |angle: f64| DQuat::from_rotation_y(angle);
        let ego = |k: i32| Pose {
            position_m: DVec3::new(0.3 * f64::from(k) - 0.6, 0.05 * f64::from(k % 2), 0.0),
            rotation: yaw(0.02 * f64::from(k)),
        };
        let camera = |x: f64| Pose { position_m: DVec3::new(x, 0.1, -0.2), rotation: yaw(0.3 * x) };
        let world_from_ego: Vec<Pose> = (0..5).map(ego).collect();
        let ego_from_camera = vec![camera(-0.4), camera(0.4)];
        let mut rigged = Self {
            truth,
            rig: RigPoses { world_from_ego, ego_from_camera },
            views: Vec::new(),
            images: Vec::new(),
        };
        for ego in 0..5 {
            for camera in 0..2 {
                let pose = rigged.rig.world_from_ego[ego] * rigged.rig.ego_from_camera[camera];
                let view = View { world_from_camera: pose, ..views[0] };
                rigged.images.push(image(cpu, &scene, view));
                rigged.views.push((view, Place::new(ego, camera)));
            }
        }
        rigged
    }

    /// The rig as a recording that is wrong by some centimetres and degrees has it. The first pose
    /// and the first camera are right.
    fn shaken(&self) -> RigPoses {
        let mut random = Random(9);
        let mut shake = |pose: &Pose| {
            let mut vector =
                |size: f64| size * DVec3::from_array([0; 3].map(|_| 2.0 * random.unit() - 1.0));
            let moved =
                Pose { position_m: vector(0.04), rotation: DQuat::from_scaled_axis(vector(0.01)) };
            *pose * moved
        };
        let mut rig = self.rig.clone();
        rig.world_from_ego[1..].iter_mut().for_each(|pose| *pose = shake(pose));
        rig.ego_from_camera[1..].iter_mut().for_each(|pose| *pose = shake(pose));
        rig
    }

    fn start(&self, rig: RigPoses) -> Start {
        let poses = self.views.iter();
        Start {
            gaussians: self.truth.clone(),
            world_from_camera: poses.map(|(_, place)| rig.world_from_camera(*place)).collect(),
            rig: Some(rig),
            ..Start::default()
        }
    }

    fn sample<'a>(&'a self, image: usize, rig: &RigPoses) -> Sample<'a> {
        let (view, place) = self.views[image];
        let world_from_camera = rig.world_from_ego[place.ego] * rig.ego_from_camera[place.camera];
        let view = View { world_from_camera, ..view };
        Sample { image, place: Some(place), ..sample(view, &self.images[image]) }
    }

    /// The largest distances of a rig's relative poses from the true ones, in metres and radians:
    /// of cameras to the first one, over all times.
    fn errors(&self, rig: &RigPoses) -> [f64; 2] {
        let mut most = [0.0_f64; 2];
        let pose = |rig: &RigPoses, place: Place| {
            rig.world_from_ego[place.ego] * rig.ego_from_camera[place.camera]
        };
        for (_, place) in &self.views {
            let first = Place::new(0, 0);
            let [ours, theirs] =
                [rig, &self.rig].map(|rig| pose(rig, first).inverse() * pose(rig, *place));
            let off = theirs.inverse() * ours;
            most[0] = most[0].max(off.position_m.length());
            most[1] = most[1].max(off.rotation.to_scaled_axis().length());
        }
        most
    }
}

fn settings(steps: usize) -> Settings {
    let mut settings = Settings { steps, sh_degree: 0, ..Settings::default() };
    // The Gaussians are right: only what is trained beside them moves far.
    settings.growth = Growth { until: 0, from: 0, noise: 0.0, ..Growth::default() };
    settings.rates.mean = 1e-5;
    settings.loss.opacity = 0.0;
    settings.loss.scale = 0.0;
    settings.sky.mode = SkyMode::Off;
    settings
}

#[test]
fn a_shaken_rig_is_found_again() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let rigged = Rigged::new(&cpu);
    let shaken = rigged.shaken();
    let [before_m, before_rad] = rigged.errors(&shaken);
    assert!(before_m > 0.03 && before_rad > 0.008, "{before_m} {before_rad}");
    let run = |mode: PoseMode| {
        let mut settings = settings(800);
        settings.poses.mode = mode;
        [settings.poses.camera_reach_m, settings.poses.camera_reach_rad] = [0.3, 0.3];
        // The wall would learn the wrong poses meanwhile.
        let none = 0.0;
        settings.rates =
            Rates { mean: none, ln_scale: none, quat: none, logit: none, sh: none, sh_rest: none };
        let start = rigged.start(shaken.clone());
        let mut trainer = Trainer::new(start, RenderProfile::default(), settings).unwrap();
        for step in 0..800 {
            trainer.step(&cpu, &rigged.sample(7 * step % 10, &shaken)).expect("a step");
        }
        trainer.poses().cloned()
    };
    let found = run(PoseMode::Auto).expect("poses");
    let [after_m, after_rad] = rigged.errors(&found);
    eprintln!("{before_m:.4} m, {before_rad:.4} rad; then {after_m:.4} m, {after_rad:.4} rad");
    assert!(after_m < 0.25 * before_m && after_rad < 0.25 * before_rad, "{after_m} {after_rad}");
    // One for each image: as many poses as images, and one camera at the origin.
    let of_images = run(PoseMode::Image).expect("poses");
    assert_eq!(of_images.world_from_ego.len(), 10);
    assert_eq!(of_images.ego_from_camera.len(), 1);
    assert!(run(PoseMode::Off).is_none());
}

#[test]
fn an_exposure_explains_a_brighter_image() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let rigged = Rigged::new(&cpu);
    let brighter: Vec<f32> = rigged.images[1].iter().map(|value| 1.25 * value + 0.05).collect();
    let run = |on: bool, recorded: f32| {
        let mut settings = settings(500);
        settings.exposure.on = on;
        settings.exposure.rate = 5e-3;
        settings.poses.mode = PoseMode::Off;
        let start = rigged.start(rigged.rig.clone());
        let mut trainer = Trainer::new(start, RenderProfile::default(), settings).unwrap();
        let mut last = [0.0; 2];
        for step in 0..500 {
            let image = step % 2;
            let mut sample = rigged.sample(image, &rigged.rig);
            if image == 1 {
                sample.rgb = &brighter;
                sample.exposure = recorded;
            }
            last[image] = trainer.step(&cpu, &sample).expect("a step").l1;
        }
        last
    };
    let [with, without] = [run(true, 1.0), run(false, 1.0)];
    eprintln!("l1 of both images: {with:?} with exposures, {without:?} without");
    assert!(with[0] < 0.5 * without[0] && with[1] < 0.5 * without[1], "{with:?} {without:?}");
    // A recorded exposure needs no training but for the offset.
    let recorded = run(false, 1.25);
    assert!(recorded[1] < 0.7 * without[1], "{recorded:?} {without:?}");
}

/// A view that sees one ball, before a sky that is red to the left and blue to the right.
#[test]
fn a_sky_is_learned_behind_the_gaussians() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let mut ball = Gaussians::with_capacity(0, 1);
    ball.means_m.push([0.0, 0.0, 5.0]);
    ball.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
    ball.ln_scales.push([-1.0; 3]);
    ball.logit_opacities.push(6.0);
    ball.sh.extend([0.5; 3]);
    let (_, views) = wall();
    let view = views[4];
    let [width, height] = [view.camera.width_px, view.camera.height_px].map(|px| px as usize);
    let mut target = image(&cpu, &Scene::from_gaussians(&ball), view);
    let opacity = |pixel: usize| target[3 * pixel] / 0.641;
    let shows: Vec<f32> = (0..width * height).map(|pixel| 1.0 - opacity(pixel).min(1.0)).collect();
    for (pixel, shows) in shows.iter().enumerate() {
        let share = (pixel % width) as f32 / width as f32;
        target[3 * pixel] += shows * (0.9 - 0.6 * share);
        target[3 * pixel + 2] += shows * (0.2 + 0.6 * share);
        target[3 * pixel + 1] += shows * 0.3;
    }
    let mut settings = settings(400);
    settings.sky.mode = SkyMode::Network;
    settings.sky.rate = 1e-2;
    let start = Start {
        gaussians: ball,
        world_from_camera: vec![view.world_from_camera],
        ..Start::default()
    };
    let mut trainer = Trainer::new(start, RenderProfile::default(), settings).unwrap();
    let first = trainer.step(&cpu, &sample(view, &target)).expect("a step").l1;
    let mut last = 0.0;
    for _ in 1..400 {
        last = trainer.step(&cpu, &sample(view, &target)).expect("a step").l1;
    }
    eprintln!("l1 {first:.3}, then {last:.4}");
    assert!(last < 0.1 * first, "{first} {last}");
    let network = trainer.sky().expect("a sky").expect("a network");
    let left = network.rgb(view.ray_world(glam::DVec2::new(2.0, 30.0)).unwrap());
    let right = network.rgb(view.ray_world(glam::DVec2::new(77.0, 30.0)).unwrap());
    assert!(left.x > 0.75 && left.z < 0.35 && right.x < 0.45 && right.z > 0.65, "{left} {right}");
}

#[test]
fn gaussians_of_the_ground_become_flat() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (_, views) = wall();
    // A road 1 m below the camera (whose y is down), 2 to 8 m ahead, that is rough and tilted.
    let mut random = Random(4);
    let mut road = Gaussians::with_capacity(0, 200);
    for _ in 0..200 {
        let mut between = |low: f64, high: f64| low + (high - low) * random.unit();
        road.means_m.push([between(-2.0, 2.0), between(0.9, 1.1), between(2.0, 8.0)]);
        let tilt =
            DQuat::from_rotation_x(between(-0.6, 0.6)) * DQuat::from_rotation_z(between(-0.6, 0.6));
        road.quats_wxyz.push([tilt.w, tilt.x, tilt.y, tilt.z].map(|q| q as f32));
        road.ln_scales.push([-1.5, -4.0, -1.5]);
        road.logit_opacities.push(0.0);
        road.sh.extend([0.1; 3]);
    }
    let target = image(&cpu, &Scene::from_gaussians(&road), views[4]);
    // The rig's z is up: the camera's -y.
    let ego = Pose {
        position_m: DVec3::new(0.0, 1.0, 0.0),
        rotation: DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2),
    };
    assert!((ego.rotation * DVec3::Z + DVec3::Y).length() < 1e-12);
    let points_m: Vec<DVec3> = road.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
    let labels = is_ground(&points_m, &[ego]);
    assert!(labels.iter().all(|is_ground| *is_ground));
    let above = [DVec3::new(0.0, 0.0, 4.0), DVec3::new(0.0, 1.0, 40.0)];
    assert_eq!(is_ground(&above, &[ego]), [false; 2]);

    let run = |labels: Vec<bool>| {
        let mut settings = settings(300);
        settings.rates.mean = 2e-3;
        settings.rates.logit = 5e-2;
        settings.ground.height = 1.0;
        settings.ground.upright = 1.0;
        settings.ground.opaque = 1.0;
        settings.ground.whole_until = 30_000;
        settings.ground.until = 30_000;
        settings.poses.mode = PoseMode::Off;
        let rig = RigPoses {
            world_from_ego: vec![ego],
            ego_from_camera: vec![ego.inverse() * views[4].world_from_camera],
        };
        let start = Start {
            gaussians: road.clone(),
            is_ground: labels,
            world_from_camera: vec![views[4].world_from_camera],
            rig: Some(rig),
            fixed: Fixed::default(),
        };
        let mut trainer = Trainer::new(start, RenderProfile::default(), settings).unwrap();
        for _ in 0..300 {
            let place = Some(Place::new(0, 0));
            let sample = Sample { place, ..sample(views[4], &target) };
            trainer.step(&cpu, &sample).expect("a step");
        }
        let gaussians = trainer.model().to_gaussians();
        let tilt = |quat: &[f32; 4]| {
            let [w, x, y, z] = quat.map(f64::from);
            (DQuat::from_xyzw(x, y, z, w).normalize() * DVec3::Y).y.abs()
        };
        let off: f64 = gaussians.means_m.iter().map(|m| (m[1] - 1.0).abs()).sum::<f64>() / 200.0;
        let upright: f64 = gaussians.quats_wxyz.iter().map(tilt).sum::<f64>() / 200.0;
        let logits: f32 = gaussians.logit_opacities.iter().sum::<f32>() / 200.0;
        (off, upright, logits)
    };
    let [with, without] = [run(labels), run(Vec::new())];
    eprintln!("height, upright, logit: {with:?} with the terms, {without:?} without");
    assert!(with.0 < 0.5 * without.0 && with.1 > without.1 + 0.03 && with.2 > without.2 + 0.5);
}

#[test]
fn a_run_that_stops_goes_on_to_the_same_bytes() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let rigged = Rigged::new(&cpu);
    let mut settings = Settings { steps: 80, ..Settings::default() };
    settings.growth = Growth { cap: 600, every: 10, ..Growth::default() };
    settings.exposure.on = true;
    settings.sky.mode = SkyMode::Network;
    let start = || Start {
        is_ground: vec![true; rigged.truth.means_m.len()],
        ..rigged.start(rigged.rig.clone())
    };
    let profile = RenderProfile::default();
    let steps = |trainer: &mut Trainer| {
        for step in trainer.steps_done()..trainer.steps_done() + 40 {
            trainer.step(&cpu, &rigged.sample(step % 10, &rigged.rig)).expect("a step");
        }
    };
    let mut whole = Trainer::new(start(), profile, settings.clone()).unwrap();
    steps(&mut whole);
    let bytes = |run: &Trainer| {
        let mut bytes = Vec::new();
        run.write_checkpoint("street", &mut bytes).expect("a checkpoint");
        bytes
    };
    let checkpoint = bytes(&whole);
    steps(&mut whole);
    let read = |bytes: &[u8], inputs: &str, settings: &Settings| {
        Trainer::from_checkpoint(bytes, inputs, profile, settings, Fixed::default())
    };
    let mut again = read(&checkpoint, "street", &settings).expect("a run");
    assert_eq!(again.steps_done(), 40);
    steps(&mut again);
    assert!(again.model().to_gaussians() == whole.model().to_gaussians());
    let ends = [&whole, &again].map(bytes);
    assert!(ends[0] == ends[1]);
    assert!(whole.model().len() > 400, "{}", whole.model().len());

    let refused = |bytes: &[u8], inputs: &str, settings: &Settings| {
        read(bytes, inputs, settings).expect_err("a refusal")
    };
    assert!(matches!(refused(&checkpoint, "lane", &settings), CheckpointError::OtherInputs));
    let other = Settings { seed: 5, ..settings.clone() };
    assert!(matches!(refused(&checkpoint, "street", &other), CheckpointError::OtherSettings));
    assert!(matches!(refused(b"ply\n", "street", &settings), CheckpointError::Format));
    for length in [30, checkpoint.len() / 2, checkpoint.len() - 1] {
        let cut = refused(&checkpoint[..length], "street", &settings);
        assert!(matches!(cut, CheckpointError::Damaged(_)), "{length}");
    }
    let mut changed = checkpoint.clone();
    changed[checkpoint.len() / 2] ^= 1;
    assert!(matches!(refused(&changed, "street", &settings), CheckpointError::Damaged(_)));
}

#[test]
fn a_place_that_the_rig_does_not_have_is_named() {
    let cpu = Cpu::new(1, Simd::Best).unwrap();
    let rigged = Rigged::new(&cpu);
    let start = rigged.start(rigged.rig.clone());
    let mut trainer = Trainer::new(start, RenderProfile::default(), settings(10)).unwrap();
    let place = Some(Place::new(5, 0));
    let error = trainer.step(&cpu, &Sample { place, ..rigged.sample(0, &rigged.rig) });
    let error = error.expect_err("no such time");
    assert!(matches!(error, TrainError::Place { image: 0, .. }), "{error}");
    let labels = Start { is_ground: vec![true; 3], ..rigged.start(rigged.rig.clone()) };
    let error = Trainer::new(labels, RenderProfile::default(), settings(10)).expect_err("labels");
    assert!(error.to_string().contains("3 labels of the ground for 400"), "{error}");
}
