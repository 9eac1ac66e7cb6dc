//! Runs on inputs that no one should have: each ends with an error that names it, or with a scene
//! that is finite.

use glam::{DQuat, DVec3};
use wildcity_render::View;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::geometry::Pose;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Gaussians, RenderProfile, Scene};
use wildcity_train::held_out::held_out_db;
use wildcity_train::poses::Place;
use wildcity_train::run::{TrainingImage, TrainingImages, run};
use wildcity_train::settings::{PoseMode, Settings};
use wildcity_train::trainer::{Start, TrainError, Trainer};

use crate::training::{image, wall};

/// Images of the wall, changed by a test.
struct Images {
    images: Vec<TrainingImage>,
    held_out: Vec<usize>,
}

impl TrainingImages for Images {
    fn count(&self) -> usize {
        self.images.len()
    }

    fn is_held_out(&self, index: usize) -> bool {
        self.held_out.contains(&index)
    }

    fn place(&self, _: usize) -> Option<Place> {
        None
    }

    fn view(&self, index: usize) -> View {
        self.images[index].view
    }

    fn name(&self, index: usize) -> String {
        format!("image {index}")
    }

    fn load(&self, index: usize) -> Result<TrainingImage, String> {
        Ok(self.images[index].clone())
    }
}

/// The wall, and images of it.
fn recorded(cpu: &Cpu) -> (Gaussians, Images) {
    let (wall, views) = wall();
    let scene = Scene::from_gaussians(&wall);
    let one = |view: &View| TrainingImage {
        view: *view,
        rgb8: image(cpu, &scene, *view).iter().map(|v| (255.0 * v).round() as u8).collect(),
        mask: None,
        sky: None,
        depth_m: None,
        weight: 1.0,
        exposure: 1.0,
    };
    let images = Images { images: views.iter().map(one).collect(), held_out: vec![0] };
    (wall, images)
}

fn settings(steps: usize) -> Settings {
    let mut settings = Settings { steps, ..Settings::default() };
    settings.growth.cap = 600;
    settings.growth.every = 5;
    settings
}

/// Runs to the end. Returns the held-out PSNR before and after, and the number of Gaussians.
fn trained(
    cpu: &Cpu,
    gaussians: Gaussians,
    images: &Images,
    settings: Settings,
) -> Result<(f64, f64, usize), TrainError> {
    let world_from_camera = images.images.iter().map(|i| i.view.world_from_camera).collect();
    let start = Start { gaussians, world_from_camera, ..Start::default() };
    let mut trainer = Trainer::new(start, RenderProfile::default(), settings)?;
    let before = held_out_db(&trainer, images, cpu)?.unwrap_or(f64::NAN);
    run(&mut trainer, images, cpu, usize::MAX, &mut |line, _| {
        assert!([line.l1, line.dssim, line.disparity].iter().all(|loss| loss.is_finite()));
        true
    })?;
    let gaussians = trainer.model().to_gaussians();
    validate::check(&gaussians, &Field::plain_name).expect("a scene that a twin may have");
    let after = held_out_db(&trainer, images, cpu)?.unwrap_or(f64::NAN);
    Ok((before, after, gaussians.len()))
}

/// Gaussians with every second colour changed, to learn something.
fn changed(wall: &Gaussians) -> Gaussians {
    let mut changed = wall.clone();
    changed.sh.iter_mut().step_by(2).for_each(|value| *value += 0.5);
    changed
}

#[test]
fn a_run_whose_images_are_masked_changes_nothing() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, mut images) = recorded(&cpu);
    for image in &mut images.images[1..] {
        image.mask = Some(vec![false; image.view.camera.pixels()]);
    }
    let mut settings = settings(20);
    settings.growth.until = 0;
    settings.growth.from = 0;
    let (before, after, _) = trained(&cpu, changed(&wall), &images, settings).unwrap();
    assert_eq!(before, after);
}

#[test]
fn one_image_and_two_gaussians_learn() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, mut images) = recorded(&cpu);
    images.images.truncate(1);
    // With the one image held out there is nothing to learn from.
    let error = trained(&cpu, wall.clone(), &images, settings(3)).unwrap_err();
    assert!(error.to_string().contains("of 1 images 1 are held out"), "{error}");
    images.held_out.clear();
    let all = trained(&cpu, changed(&wall), &images, settings(60)).unwrap();
    assert_eq!(all.2, 600, "the cap is reached");
    let two = trained(&cpu, wall.select([0, 1]), &images, settings(60)).unwrap();
    assert!((4..=600).contains(&two.2), "{two:?}");
}

#[test]
fn a_run_at_its_cap_stays_there() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, images) = recorded(&cpu);
    let mut settings = settings(60);
    settings.growth.cap = wall.len();
    let (before, after, count) = trained(&cpu, changed(&wall), &images, settings).unwrap();
    assert_eq!(count, wall.len());
    assert!(after > before + 3.0, "{before} {after}");
}

#[test]
fn exposures_of_eight_stops_are_learned_or_undone() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, mut images) = recorded(&cpu);
    // Recorded 8 stops brighter and darker than the others, and known to be: the first is clipped
    // to white, and the other to black.
    for (index, stops) in [(1, 8.0_f32), (2, -8.0)] {
        let image = &mut images.images[index];
        image.exposure = stops.exp2();
        for value in &mut image.rgb8 {
            *value = (f32::from(*value) * stops.exp2()).clamp(0.0, 255.0).round() as u8;
        }
    }
    for trains_exposure in [false, true] {
        let mut settings = settings(120);
        settings.exposure.on = trains_exposure;
        let (before, after, _) = trained(&cpu, changed(&wall), &images, settings).unwrap();
        assert!(after > before, "{before} {after}");
    }
}

#[test]
fn poses_that_are_far_off_end_in_a_finite_scene() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, mut images) = recorded(&cpu);
    // 30 m and 60° off, and one that looks away from everything.
    let off =
        Pose { position_m: DVec3::new(30.0, 0.0, 0.0), rotation: DQuat::from_rotation_y(1.05) };
    let away = Pose { rotation: DQuat::from_rotation_y(3.1), ..Pose::IDENTITY };
    for (index, by) in [(1, off), (2, away)] {
        let view = &mut images.images[index].view;
        view.world_from_camera = view.world_from_camera * by;
    }
    let mut settings = settings(60);
    settings.poses.mode = PoseMode::Image;
    [settings.poses.reach_m, settings.poses.reach_rad] = [50.0, 3.0];
    trained(&cpu, changed(&wall), &images, settings).unwrap();
}

#[test]
fn depths_and_rates_beyond_all_bounds_end_with_a_reason_or_a_finite_scene() {
    let cpu = Cpu::new(0, Simd::Best).unwrap();
    let (wall, mut images) = recorded(&cpu);
    let pixels = images.images[1].view.camera.pixels();
    images.images[1].depth_m = Some(vec![1e-30; pixels]);
    images.images[2].depth_m = Some(vec![1e30; pixels]);
    images.images[3].depth_m = Some(vec![f32::NAN; pixels]);
    let error = trained(&cpu, changed(&wall), &images, settings(40)).unwrap_err();
    assert!(matches!(error, TrainError::Value { image: "depth", .. }), "{error}");
    images.images[3].depth_m = None;
    match trained(&cpu, changed(&wall), &images, settings(40)) {
        Ok(_) | Err(TrainError::NotFinite { .. }) => {}
        Err(error) => panic!("{error}"),
    }
}
