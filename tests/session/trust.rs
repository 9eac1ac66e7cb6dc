//! The trust of images, compared with the errors of a twin that was recorded on one drive.
//!
//! The demo street stands for the real world. Its twin has only the Gaussians that a camera of the
//! drive saw. A pixel is correct if it differs from the world's by at most 16 of 255. Training has
//! errors in the recorded parts as well, so a real twin has fewer correct pixels than this one: the
//! test gives an upper bound.

use glam::{DQuat, DVec3};
use wildcity_generate::{Street, StreetSettings};
use wildcity_render::View;
use wildcity_render::cpu::Cpu;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Gaussians, RecordFormat, RenderProfile, Rig, Scene};
use wildcity_session::{TrainingCoverage, Trust};
use wildcity_twin::store::{Catalog, NewVersion, StorageOptions};

use crate::images::{Image, cpu, render};

/// Images are this much smaller than the vehicle's own.
const SHRINK: u32 = 6;

/// A world, its twin, and the backend that renders both.
struct Pair {
    street: Street,
    world: Scene,
    twin: Scene,
    coverage: TrainingCoverage,
    cpu: Cpu,
}

/// Means over all cameras at some places: the share of correct pixels, and the trust with its
/// parts.
#[derive(Clone, Copy, Debug)]
struct Measured {
    right: f64,
    trust: f64,
    low_coverage: f64,
    distance_m: f64,
}

#[test]
fn trust_falls_beside_the_drive_and_is_at_most_the_share_of_right_pixels() {
    let pair = pair();
    let close = |trust: f64, wanted: f64| (trust - wanted).abs() < 0.02;
    for (offset_m, wanted) in [(0.0, 1.0), (1.0, 0.82), (3.0, 0.55), (5.0, 0.37)] {
        let measured = pair.measure(offset_m, 0.0);
        eprintln!("{offset_m} m to the left: {measured:?}");
        let Measured { right, trust, low_coverage, distance_m } = measured;
        assert!((distance_m - offset_m).abs() < 1e-3 && low_coverage < 0.01, "{measured:?}");
        assert!(close(trust, wanted) && trust < right + 0.01, "{offset_m} m: {measured:?}");
    }
    for yaw_rad in [0.4, 0.8] {
        let measured = pair.measure(0.0, yaw_rad);
        eprintln!("{yaw_rad} rad to the left: {measured:?}");
        assert!(measured.trust > 0.9 && measured.trust < measured.right + 0.01, "{measured:?}");
    }
}

#[test]
fn far_from_the_recorded_drive_the_trust_is_zero() {
    let pair = pair();
    let away = Pose { position_m: DVec3::new(5_000.0, 0.0, 0.0), ..Pose::IDENTITY };
    let view = View::from_rig(&small_rig().cameras, away)[0];
    let clear = vec![1.0; view.camera.pixels()];
    let Trust { value, outside, low_coverage, .. } = pair.coverage.trust(&away, &view, &clear);
    assert!(value < 1e-6 && outside == 1.0 && low_coverage == 0.0, "{value} {outside}");
    let on_it = pair.street.trajectory.at_station(30.0);
    let view = View::from_rig(&small_rig().cameras, on_it)[0];
    let Trust { value, outside, angle_rad, .. } = pair.coverage.trust(&on_it, &view, &clear);
    assert!(value > 0.95 && outside == 0.0 && angle_rad < 0.05, "{value} {outside} {angle_rad}");
    let empty = vec![0.2; view.camera.pixels()];
    assert_eq!(pair.coverage.trust(&on_it, &view, &empty).value, 0.0);
}

/// A level camera with a small image, whose few followed samples are all above the horizon; and one
/// that looks up.
#[test]
fn a_level_camera_far_from_the_twin_is_outside() {
    let pair = pair();
    let on_it = pair.street.trajectory.at_station(30.0);
    let off_it = Pose { position_m: on_it.position_m + DVec3::new(1_000.0, 0.0, 0.0), ..on_it };
    let mut rig = small_rig();
    for mounted in &mut rig.cameras {
        mounted.camera = mounted.camera.scaled(96, 60).unwrap();
    }
    let tilt_up = Pose { rotation: DQuat::from_rotation_y(-1.2), ..Pose::IDENTITY };
    for (world_from_rig, expected) in [(on_it, 0.0), (off_it, 1.0)] {
        for pose in [world_from_rig, world_from_rig * tilt_up] {
            let view = View::from_rig(&rig.cameras, pose)[0];
            let clear = vec![1.0; view.camera.pixels()];
            let Trust { outside, .. } = pair.coverage.trust(&pose, &view, &clear);
            assert_eq!(outside, expected, "{pose:?}");
        }
    }
}

impl Pair {
    fn measure(&self, offset_m: f64, yaw_rad: f64) -> Measured {
        let mut all = Vec::new();
        for station_m in [30.0, 45.0, 65.0] {
            let on_it = self.street.trajectory.at_station(station_m);
            let world_from_rig = Pose {
                position_m: on_it.position_m + on_it.rotation * DVec3::Y * offset_m,
                rotation: on_it.rotation * DQuat::from_rotation_z(yaw_rad),
            };
            let views = View::from_rig(&small_rig().cameras, world_from_rig);
            let draw = |scene| render(&self.cpu, scene, &RenderProfile::default(), &views);
            for ((world, twin), view) in draw(&self.world).iter().zip(&draw(&self.twin)).zip(&views)
            {
                let trust = self.coverage.trust(&world_from_rig, view, &twin.opacity);
                all.push((share_right(world, twin), trust));
            }
        }
        let mean =
            |of: &dyn Fn(&(f64, Trust)) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
        Measured {
            right: mean(&|(right, _)| *right),
            trust: mean(&|(_, trust)| trust.value),
            low_coverage: mean(&|(_, trust)| trust.low_coverage),
            distance_m: mean(&|(_, trust)| trust.distance_m),
        }
    }
}

/// Share of pixels in which each channel is off by at most 16 of 255.
fn share_right(world: &Image, twin: &Image) -> f64 {
    let pairs = world.rgb8.chunks_exact(3).zip(twin.rgb8.chunks_exact(3));
    let is_right = |(a, b): &(&[u8], &[u8])| a.iter().zip(*b).all(|(a, b)| a.abs_diff(*b) <= 16);
    pairs.clone().filter(is_right).count() as f64 / pairs.len() as f64
}

fn pair() -> Pair {
    let settings = StreetSettings {
        length_m: 100.0,
        crossing_m: 50.0,
        density: 0.3,
        ..StreetSettings::default()
    };
    let street = wildcity_generate::street(&settings).unwrap();
    let world = Scene::from_gaussians(&street.gaussians);
    let cpu = cpu();
    let seen = seen(&street, &world, &cpu);
    let twin = recorded(&street.gaussians, &seen);
    let dir = tempfile::tempdir().unwrap();
    let new = NewVersion {
        trajectories: vec![street.trajectory.clone()],
        storage: StorageOptions { record: RecordFormat::F32, levels: false },
        ..NewVersion::from_gaussians("twin", &twin, Provenance::new("test".into()))
    };
    let version = Catalog::open(dir.path()).unwrap().commit(new, &mut |_, _| {}).unwrap();
    let coverage = TrainingCoverage::new(&version.manifest).unwrap();
    Pair { twin: Scene::from_gaussians(&twin), street, world, coverage, cpu }
}

/// For each Gaussian, whether a camera of the drive saw it: its centre is in the image or at most
/// its own extent outside, and nothing is in front of it.
fn seen(street: &Street, world: &Scene, cpu: &Cpu) -> Vec<bool> {
    let gaussians = &street.gaussians;
    let mut seen = vec![false; gaussians.len()];
    // Every second metre: the keyframes between see the same.
    for keyframe in street.trajectory.keyframes.iter().step_by(4) {
        let views = View::from_rig(&small_rig().cameras, keyframe.world_from_rig);
        for (image, view) in
            render(cpu, world, &RenderProfile::default(), &views).iter().zip(&views)
        {
            let camera_from_world = view.world_from_camera.inverse();
            let side = |px: u32| f64::from(px);
            let [width, height] = [side(view.camera.width_px), side(view.camera.height_px)];
            for (index, seen) in seen.iter_mut().enumerate().filter(|(_, seen)| !**seen) {
                let mean_m = DVec3::from_array(gaussians.means_m[index]);
                let at_m = camera_from_world.transform_point(mean_m);
                let wide_m =
                    gaussians.ln_scales[index].map(f32::exp).into_iter().fold(0.0, f32::max);
                let wide_m = 3.0 * f64::from(wide_m);
                if at_m.z <= 0.1 {
                    continue;
                }
                let at_px = view.camera.pinhole.project(at_m);
                let wide_px = 1.0 + view.camera.pinhole.fx * wide_m / at_m.z;
                let inside = (-wide_px..width + wide_px).contains(&at_px.x)
                    && (-wide_px..height + wide_px).contains(&at_px.y);
                let pixel = |px: f64, side: f64| px.clamp(0.0, side - 1.0) as usize;
                // The farthest surface within its extent; it is seen if it is not far behind that.
                let mut behind_m = 0.0_f64;
                for dy in [-wide_px, 0.0, wide_px] {
                    for dx in [-wide_px, 0.0, wide_px] {
                        let row = pixel(at_px.y + dy, height);
                        let place = row * width as usize + pixel(at_px.x + dx, width);
                        behind_m = behind_m.max(image.depth_m[place].into());
                    }
                }
                *seen = inside && at_m.z <= 1.02 * behind_m + 0.2 + wide_m;
            }
        }
    }
    seen
}

/// The Gaussians that were seen.
fn recorded(world: &Gaussians, seen: &[bool]) -> Gaussians {
    let mut twin = Gaussians::with_capacity(world.sh_degree, world.len());
    for (index, _) in seen.iter().enumerate().filter(|(_, seen)| **seen) {
        twin.push_from(world, index);
    }
    twin
}

/// The vehicle's cameras, smaller.
fn small_rig() -> Rig {
    let mut rig = Rig::preset("vehicle6").unwrap();
    for mounted in &mut rig.cameras {
        let Camera { width_px, height_px, .. } = mounted.camera;
        let [width, height] = [width_px, height_px].map(|side| u64::from(side / SHRINK));
        mounted.camera = mounted.camera.scaled(width, height).unwrap();
    }
    rig
}
