//! Streets with synthetic errors: deterministic, nearly right on the drive, and wrong off the
//! trajectory.

use glam::DVec3;
use wildcity_generate::{GenerateError, Spoil};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, RenderProfile, Rig, Scene, chunk};

use super::{DEMO, digest};

fn spoiled(amount: f64, seed: u64) -> Gaussians {
    Spoil::new(amount, seed, &DEMO.trajectory).unwrap().apply(&DEMO.gaussians)
}

#[test]
fn the_same_seed_spoils_in_the_same_way_whole_or_in_parts() {
    let once = spoiled(0.5, 4);
    assert_eq!(digest(&once), digest(&spoiled(0.5, 4)));
    assert_ne!(digest(&once), digest(&spoiled(0.5, 5)));
    let spoil = Spoil::new(0.5, 4, &DEMO.trajectory).unwrap();
    let mut parts = Gaussians::with_capacity(1, once.len());
    let count = DEMO.gaussians.len();
    for part in 0..7 {
        let indices = part * count / 7..(part + 1) * count / 7;
        parts.append(&spoil.apply(&DEMO.gaussians.select(indices)));
    }
    assert_eq!(digest(&parts), digest(&once));
}

#[test]
fn a_spoiled_twin_can_be_stored() {
    let once = spoiled(1.0, 4);
    let count = DEMO.gaussians.len() as f64;
    // 2 % are lost, and 6 % are added, less those in other cells.
    assert!((1.02..1.05).contains(&(once.len() as f64 / count)), "{} of {count}", once.len());
    let cells = |gaussians: &Gaussians| {
        let mut cells: Vec<_> = gaussians.means_m.iter().map(chunk::cell_at).collect();
        cells.sort_unstable();
        cells.dedup();
        cells
    };
    // None in a cell that has none without damage.
    let before = cells(&DEMO.gaussians);
    assert!(cells(&once).iter().all(|cell| before.binary_search(cell).is_ok()));
    for index in 0..once.len() {
        let length = once.quats_wxyz[index].iter().map(|q| q * q).sum::<f32>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "quaternion {index} of length {length}");
        assert!(
            once.ln_scales[index].iter().all(|ln| (-30.0..=10.0).contains(ln)),
            "scale {index}"
        );
    }
    // The formats of records hold coefficients up to 16.
    assert!(once.sh.iter().all(|c| c.abs() < 16.0));
}

#[test]
fn an_amount_of_zero_changes_nothing_and_others_are_refused() {
    assert_eq!(digest(&spoiled(0.0, 4)), digest(&DEMO.gaussians));
    for amount in [-0.1, 1.1, f64::NAN] {
        let refused = Spoil::new(amount, 4, &DEMO.trajectory);
        assert!(
            matches!(refused, Err(GenerateError::Setting { field: "spoil", .. })),
            "{refused:?}"
        );
    }
}

#[test]
fn images_are_nearly_right_on_the_drive_and_worse_the_farther_beside_it() {
    let [true_, half, whole] =
        [0.0, 0.5, 1.0].map(|amount| Scene::from_gaussians(&spoiled(amount, 4)));
    let psnr_db = |scene: &Scene, offset_m: f64| psnr_db(&true_, scene, offset_m);
    let by_offset = [0.0, 1.0, 3.0, 5.0].map(|offset_m| psnr_db(&half, offset_m));
    let [on_db, near_db, beside_db, far_db] = by_offset;
    assert!(on_db > 27.0, "{by_offset:?}");
    assert!(near_db < on_db - 1.5, "{by_offset:?}");
    assert!(beside_db < on_db - 5.0, "{by_offset:?}");
    assert!(far_db < beside_db, "{by_offset:?}");
    assert!(psnr_db(&whole, 0.0) < on_db - 2.0);
    assert!(psnr_db(&whole, 3.0) < beside_db - 2.0);
}

/// Mean PSNR of the three front cameras at a quarter of their sides, at stations along the drive
/// and at an offset to its left.
fn psnr_db(true_: &Scene, scene: &Scene, offset_m: f64) -> f64 {
    let rig = Rig::preset("vehicle6").expect("the vehicle is a preset");
    let cpu = Cpu::new(0, Simd::Best).expect("every machine has threads");
    let beside = Pose { position_m: offset_m * DVec3::Y, ..Pose::IDENTITY };
    let mut values_db = Vec::new();
    for station_m in [30.0, 90.0, 150.0, 210.0] {
        let world_from_rig = DEMO.trajectory.at_station(station_m) * beside;
        for camera in &rig.cameras[..3] {
            let [width, height] =
                [camera.camera.width_px, camera.camera.height_px].map(|px| px / 4);
            let small = camera.camera.scaled(width.into(), height.into()).expect("a quarter");
            let view = View::new(small, world_from_rig * camera.rig_from_camera);
            let [a, b] = [true_, scene].map(|scene| picture(&cpu, scene, view));
            let squares = a.iter().zip(&b).map(|(a, b)| f64::from(a - b).powi(2));
            values_db.push(-10.0 * (squares.sum::<f64>() / a.len() as f64).log10());
        }
    }
    values_db.iter().sum::<f64>() / values_db.len() as f64
}

/// Red, green and blue of each pixel on black, as in a display.
fn picture(cpu: &Cpu, scene: &Scene, view: View) -> Vec<f32> {
    let mut rgba = vec![0.0; 4 * view.camera.pixels()];
    let mut targets = [Target { rgba: Some(&mut rgba), ..Target::default() }];
    let frame = Frame { scene, profile: &RenderProfile::default(), views: &[view] };
    cpu.render(&frame, &mut targets, &|_, _| ()).expect("one view renders");
    rgba.chunks_exact(4).flat_map(|rgba| rgba[..3].iter().map(|c| c.clamp(0.0, 1.0))).collect()
}
