//! What the vehicle's cameras see: daylight without holes.

use wildcity::geometry::Camera;
use wildcity::render::cpu::{Cpu, Simd};
use wildcity::render::{Backend, Frame, Target, View};
use wildcity::scene::rig::RigCamera;
use wildcity::scene::{RenderProfile, Rig, Scene};

use super::DEMO;

/// Pictures are this much smaller than the cameras' own.
const SHRINK: u32 = 4;

#[test]
fn every_camera_sees_daylight_without_holes() {
    let scene = Scene::from_gaussians(&DEMO.gaussians);
    let rig = Rig::preset("vehicle6").expect("the vehicle is a preset");
    let cpu = Cpu::new(0, Simd::Best).expect("every machine has threads");
    for station_m in [0.0, 60.0, 141.0, 200.0, 280.0] {
        let world_from_rig = DEMO.trajectory.at_station(station_m);
        for RigCamera { name, camera, rig_from_camera, .. } in &rig.cameras {
            let view = View::new(shrunk(camera), world_from_rig * *rig_from_camera);
            let rgba = picture(&cpu, &scene, view);
            let what = format!("{name} at {station_m} m");
            let count = rgba.len() as f32;
            let thinnest = rgba.iter().map(|pixel| pixel[3]).fold(1.0, f32::min);
            let covered = rgba.iter().map(|pixel| pixel[3]).sum::<f32>() / count;
            assert!(thinnest > 0.6, "{what}: opacity {thinnest} somewhere");
            assert!(covered > 0.985, "{what}: opacity {covered} on average");
            let brightness = rgba.iter().map(|pixel| pixel[1]).sum::<f32>() / count;
            assert!((0.15..0.8).contains(&brightness), "{what}: brightness {brightness}");
        }
    }
}

fn shrunk(camera: &Camera) -> Camera {
    let [width, height] = [camera.width_px, camera.height_px].map(|side| (side / SHRINK).into());
    camera.scaled(width, height).expect("a quarter of a camera")
}

fn picture(cpu: &Cpu, scene: &Scene, view: View) -> Vec<[f32; 4]> {
    let mut rgba = vec![0.0; 4 * view.camera.pixels()];
    let mut targets = [Target { rgba: Some(&mut rgba), ..Target::default() }];
    let frame = Frame { scene, profile: &RenderProfile::default(), views: &[view] };
    cpu.render(&frame, &mut targets, &|_, _| ()).expect("one view renders");
    bytemuck::cast_slice(&rgba).to_vec()
}
