//! Images of the vehicle's cameras: daylight, houses and ground without holes, and the sky above.

use std::sync::Arc;

use glam::{DMat3, DVec2};
use wildcity_generate::SKY;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::geometry::Camera;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{RenderProfile, Rig, Scene, Sky};
use wildcity_twin::ingest;

use super::DEMO;

/// Pictures are this much smaller than the cameras' own.
const SHRINK: u32 = 4;

#[test]
fn every_camera_sees_daylight_without_holes() {
    let model = ingest::sky::read_bytes(SKY, None).expect("the sky is part of the program").model;
    let sky = Some(Arc::new(Sky::new(model, DMat3::IDENTITY)));
    let scene = Scene { sky, ..Scene::from_gaussians(&DEMO.gaussians) };
    let mut seen_sky = 0;
    let rig = Rig::preset("vehicle6").expect("the vehicle is a preset");
    let cpu = Cpu::new(0, Simd::Best).expect("every machine has threads");
    for station_m in [0.0, 60.0, 141.0, 200.0, 280.0] {
        let world_from_rig = DEMO.trajectory.at_station(station_m);
        for RigCamera { name, camera, rig_from_camera, .. } in &rig.cameras {
            let view = View::new(shrunk(camera), world_from_rig * *rig_from_camera);
            let rgba = picture(&cpu, &scene, view);
            let what = format!("{name} at {station_m} m");
            let count = rgba.len() as f32;
            // Where one looks down by more than a degree, there is ground.
            let width = view.camera.width_px as usize;
            let down = |pixel: usize| {
                let at = |k: usize| k as f64 + 0.5;
                let ray = view.ray_world(DVec2::new(at(pixel % width), at(pixel / width)));
                ray.is_some_and(|ray| ray.z < -0.02)
            };
            let ground = rgba.iter().enumerate().filter(|(pixel, _)| down(*pixel));
            let (mut thinnest, mut covered, mut pixels) = (1.0_f32, 0.0, 0.0);
            for (_, pixel) in ground {
                thinnest = thinnest.min(pixel[3]);
                covered += pixel[3];
                pixels += 1.0;
            }
            covered /= pixels;
            assert!(pixels > 0.3 * count, "{what}: {pixels} of the ground");
            assert!(thinnest > 0.6, "{what}: opacity {thinnest} somewhere");
            assert!(covered > 0.985, "{what}: opacity {covered} on average");
            let dark = rgba.iter().filter(|[r, g, b, _]| r + g + b < 0.02).count();
            assert!((dark as f32) < 1e-3 * count, "{what}: {dark} pixels are black");
            seen_sky += rgba.iter().filter(|pixel| pixel[3] < 0.01 && pixel[2] > pixel[0]).count();
            let brightness = rgba.iter().map(|pixel| pixel[1]).sum::<f32>() / count;
            assert!((0.15..0.8).contains(&brightness), "{what}: brightness {brightness}");
        }
    }
    // 47,000 of two million pixels show only rather blue sky.
    assert!(seen_sky > 20_000, "{seen_sky}");
}

/// A camera with larger pixels of its own, and not one whose image is the native image shrunk: that
/// filter makes thin splats fainter, by up to 0.4 % of the opacity of a native image, which is no
/// hole of the street (`tests/render/small_images.rs` bounds its error). Opacity on average is at
/// least 0.986 in native images, 0.983 in shrunk ones and 0.989 in these.
fn shrunk(camera: &Camera) -> Camera {
    let [width, height] = [camera.width_px, camera.height_px].map(|side| (side / SHRINK).into());
    let scaled = camera.scaled(width, height).expect("a quarter of a camera");
    Camera { native_size_px: None, ..scaled }
}

fn picture(cpu: &Cpu, scene: &Scene, view: View) -> Vec<[f32; 4]> {
    let mut rgba = vec![0.0; 4 * view.camera.pixels()];
    let mut targets = [Target { rgba: Some(&mut rgba), ..Target::default() }];
    let frame = Frame { scene, profile: &RenderProfile::default(), views: &[view] };
    cpu.render(&frame, &mut targets, &|_, _| ()).expect("one view renders");
    bytemuck::cast_slice(&rgba).to_vec()
}
