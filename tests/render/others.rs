//! Against images that other renderers made of the same Gaussians.

use std::path::Path;

use safetensors::SafeTensors;
use wildcity::geometry::Camera;
use wildcity::geometry::camera::Pinhole;
use wildcity::ingest;
use wildcity::render::reference::Reference;
use wildcity::render::{Backend, View};
use wildcity::scene::{RenderProfile, Scene};

use crate::data::real;
use crate::images::{cpu, look, max_difference, psnr, render_one};

fn read(path: &Path) -> Scene {
    Scene::from_gaussians(&ingest::read(path, &mut |_, _| {}).unwrap())
}

/// The image that gsplat's CUDA kernels made, and what they were given.
struct Gsplat {
    scene: Scene,
    view: View,
    rgba: Vec<f32>,
}

fn gsplat() -> Option<Gsplat> {
    let path = real("reference/gsplat_tiny_case.safetensors")?;
    let file = std::fs::read(&path).unwrap();
    let tensors = SafeTensors::deserialize(&file).unwrap();
    let out = tensors.tensor("out_img").unwrap();
    let [height, width] = [out.shape()[0] as u32, out.shape()[1] as u32];
    let (w, h) = (f64::from(width), f64::from(height));
    let mut view = look(
        [width, height],
        0.5 * w,
        glam::DVec3::new(0.123, 0.456, -8.0),
        glam::DVec3::Z,
        glam::DVec3::Y,
    );
    view.camera = Camera {
        pinhole: Pinhole { fx: 0.5 * w, fy: 0.5 * w, cx: 0.5 * w, cy: 0.5 * h },
        ..view.camera
    };
    let rgba = out.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
    Some(Gsplat { scene: read(&path), view, rgba: rgba.collect() })
}

const GSPLAT_OF_THEN: RenderProfile = RenderProfile {
    near: 0.01,
    far: 1e10,
    blur: 0.3,
    antialiased: false,
    alpha_cap: 0.999,
    alpha_cut: 1.0 / 255.0,
    stop: 1e-4,
};

#[test]
fn gsplat_is_met() {
    let Some(truth) = gsplat() else { return };
    let off = |backend: &dyn Backend, profile: &RenderProfile| {
        let image = render_one(backend, &truth.scene, profile, truth.view);
        max_difference(&image.rgba, &truth.rgba)
    };
    assert!(off(&Reference, &GSPLAT_OF_THEN) <= 1e-5);
    assert!(off(&cpu(), &GSPLAT_OF_THEN) <= 1e-4);
    // Another profile is another image: the comparison can fail.
    for setting in ["blur=0.2", "antialiased=true", "alpha_cut=0.02", "alpha_cap=0.5"] {
        let mut other = GSPLAT_OF_THEN;
        other.set(setting).unwrap();
        assert!(off(&Reference, &other) > 1e-4, "{setting} made no difference");
    }
}

#[test]
fn an_independent_renderer_of_a_real_capture_is_met() {
    let (Some(scene), Some(camera), Some(truth)) = (
        real("scenes/skull/skull.ply"),
        real("reference/skull_front.camera.json"),
        real("reference/skull_front.oracle_f32.npy"),
    ) else {
        return;
    };
    let listed = ingest::cameras::read(&camera).unwrap().remove(0);
    let profile = RenderProfile { near: listed.near.unwrap(), ..GSPLAT_OF_THEN };
    let view = View { camera: listed.camera, world_from_camera: listed.world_from_camera };
    let truth = npy(&truth);
    let image = render_one(&cpu(), &read(&scene), &profile, view);
    let db = psnr(&image.rgba, &truth);
    assert!(db >= 60.0, "{db:.1} dB");
}

/// The values of a little-endian float32 `.npy` file.
fn npy(path: &Path) -> Vec<f32> {
    let file = std::fs::read(path).unwrap();
    assert_eq!(&file[..8], b"\x93NUMPY\x01\x00");
    let header = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
    assert!(std::str::from_utf8(&file[10..header]).unwrap().contains("'<f4'"));
    file[header..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}
