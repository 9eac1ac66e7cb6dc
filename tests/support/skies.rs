//! Skies for tests.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::path::PathBuf;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::sky::{Layer, Network, SkyModel};
use wildcity_scene::{RenderProfile, Scene, Sky};
use wildcity_twin::ingest;

use crate::images::Image;
use crate::scene_files::Random;

/// Takes the world's axes to those of [`sky`]: a rotation with a reflection, so that an error in
/// the axes shows.
pub(crate) const SKY_FROM_WORLD: DMat3 = DMat3::from_cols(
    DVec3::new(0.0, 0.6, 0.8),
    DVec3::new(1.0, 0.0, 0.0),
    DVec3::new(0.0, 0.8, -0.6),
);

/// The demo twin's sky.
pub(crate) fn demo_sky() -> PathBuf {
    crate::root::root().join("scenes/sky.safetensors")
}

/// The demo twin's sky with the appearance of one image, or the mean appearance.
pub(crate) fn demo_model(image: Option<u32>) -> SkyModel {
    ingest::sky::read(&demo_sky(), image).unwrap().model
}

/// A small network with random weights, smooth enough for a coarse map.
pub(crate) fn network(identity: bool, octaves: usize, appearance: usize, skip: bool) -> Network {
    let mut random = Random(octaves as u64 + 10 * appearance as u64 + 100 * u64::from(skip));
    let width = 20;
    let encoded = 6 * octaves + if identity { 3 } else { 0 };
    let inputs = encoded + appearance;
    let mut layer = |outputs: usize, inputs: usize| {
        let size = 2.0 / (inputs as f64).sqrt();
        let mut numbers = |count: usize| -> Vec<f32> {
            (0..count).map(|_| random.between(-size, size)).collect()
        };
        Layer { outputs, inputs, weight: numbers(outputs * inputs), bias: numbers(outputs) }
    };
    let second = if skip { width + inputs } else { width };
    let layers = [layer(width, inputs), layer(width, second), layer(3, width)];
    let appearance = (0..appearance).map(|k| 0.3 - 0.1 * k as f32).collect();
    Network::new(layers, appearance).unwrap()
}

/// A sky of such a network, with the axes of [`SKY_FROM_WORLD`].
pub(crate) fn sky() -> Arc<Sky> {
    Arc::new(Sky::new(SkyModel::network(network(true, 3, 4, true)), SKY_FROM_WORLD))
}

/// A scene with a sky and no Gaussians.
pub(crate) fn empty(sky: Arc<Sky>) -> Scene {
    Scene { sky: Some(sky), ..Scene::default() }
}

/// An exposure that mixes channels, and an overlay like a car's hood over the lower half, opaque at
/// the bottom.
pub(crate) fn appearance(view: View) -> Appearance {
    let (width, height) = (view.camera.width_px, view.camera.height_px);
    let pixel = |k: u32| {
        let (x, y) = (k % width, k / width);
        let alpha = (2 * y).saturating_sub(height) * 255 / height;
        [(x % 200) as u8, 40, (y % 200) as u8, alpha.min(255) as u8]
    };
    let rgba8: Vec<u8> = (0..width * height).flat_map(pixel).collect();
    Appearance {
        exposure: Some(Exposure {
            matrix: [[0.8, 0.1, 0.0], [0.05, 1.1, -0.1], [0.0, 0.2, 0.7]],
            offset: [0.02, -0.03, 0.05],
        }),
        overlay: Some(Arc::new(Overlay::new(width, rgba8).unwrap())),
    }
}

/// The image of one view with a camera's exposure and overlay.
pub(crate) fn draw_seen(
    backend: &dyn Backend,
    scene: &Scene,
    view: View,
    seen: &Appearance,
) -> Image {
    let pixels = view.camera.pixels();
    let mut image = Image {
        rgba: vec![f32::NAN; 4 * pixels],
        rgb8: vec![77; 3 * pixels],
        depth_m: vec![f32::NAN; pixels],
        opacity: vec![f32::NAN; pixels],
    };
    let Image { rgba, rgb8, depth_m, opacity } = &mut image;
    let target = Target {
        rgba: Some(rgba),
        rgb8: Some(rgb8),
        depth_m: Some(depth_m),
        opacity: Some(opacity),
        appearance: Some(seen),
        ..Target::default()
    };
    let frame = Frame { scene, profile: &RenderProfile::DEFAULT, views: &[view] };
    backend.render(&frame, &mut [target], &|_, _| {}).unwrap();
    image
}
