//! Ground truth: images of the same Gaussians by other renderers.

use std::path::Path;

use glam::DVec3;
use safetensors::SafeTensors;
use wildcity_render::View;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::{RenderProfile, Scene};
use wildcity_twin::ingest;

use crate::data::real;
use crate::images::view_along;

/// An image by another renderer, with its scene, profile and view.
pub(crate) struct Truth {
    pub(crate) scene: Scene,
    pub(crate) profile: RenderProfile,
    pub(crate) view: View,
    pub(crate) rgba: Vec<f32>,
}

/// gsplat's small test case, rendered by its CUDA kernels.
pub(crate) fn gsplat() -> Option<Truth> {
    let path = real("reference/gsplat_tiny_case.safetensors")?;
    let file = std::fs::read(&path).unwrap();
    let tensors = SafeTensors::deserialize(&file).unwrap();
    let out = tensors.tensor("out_img").unwrap();
    let [height_px, width_px] = [out.shape()[0] as u32, out.shape()[1] as u32];
    let (w, h) = (f64::from(width_px), f64::from(height_px));
    let pinhole = Pinhole { fx: 0.5 * w, fy: 0.5 * w, cx: 0.5 * w, cy: 0.5 * h };
    let at = DVec3::new(0.123, 0.456, -8.0);
    let view = View {
        camera: Camera::from_pinhole(width_px, height_px, pinhole),
        ..view_along([width_px, height_px], 0.5 * w, at, DVec3::Z, DVec3::Y)
    };
    let rgba = out.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
    let rgba = rgba.collect();
    Some(Truth { scene: read(&path), profile: GSPLAT_OF_THEN, view, rgba })
}

/// A real capture, rendered by an independent renderer in f64.
pub(crate) fn skull_front() -> Option<Truth> {
    let (scene, camera, image) = (
        real("scenes/skull/skull.ply")?,
        real("reference/skull_front.camera.json")?,
        real("reference/skull_front.oracle_f32.npy")?,
    );
    let listed = ingest::cameras::read(&camera).unwrap().remove(0);
    let profile = RenderProfile { near: listed.near.unwrap(), ..GSPLAT_OF_THEN };
    let view = View::new(listed.camera, listed.world_from_camera);
    Some(Truth { scene: read(&scene), profile, view, rgba: npy(&image) })
}

/// A scene file in its own axes.
pub(crate) fn read(path: &Path) -> Scene {
    Scene::from_gaussians(&ingest::read(path, &mut |_, _| {}).unwrap())
}

/// gsplat's settings when the images were rendered.
const GSPLAT_OF_THEN: RenderProfile = RenderProfile { alpha_cap: 0.999, ..RenderProfile::DEFAULT };

/// The values of a little-endian float32 `.npy` file.
fn npy(path: &Path) -> Vec<f32> {
    let file = std::fs::read(path).unwrap();
    assert_eq!(&file[..8], b"\x93NUMPY\x01\x00");
    let header = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
    assert!(std::str::from_utf8(&file[10..header]).unwrap().contains("'<f4'"));
    file[header..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}
