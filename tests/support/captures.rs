//! A generated scene in the likeness of a dense capture: millions of thin, faint to opaque
//! Gaussians of degree 0, most of them smaller than a native pixel.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use glam::{DQuat, DVec3};
use wildcity_render::View;
use wildcity_render::compare::gaussians::{GaussianSpec, gaussians_from_specs};
use wildcity_render::compare::images::view_along;
use wildcity_scene::Gaussians;

use crate::scene_files::Random;

/// The native view of [`dense_capture`]: 1920 x 1080 px, along +z with +y down.
pub(crate) fn dense_view() -> View {
    view_along([1920, 1080], 1600.0, DVec3::ZERO, DVec3::Z, DVec3::Y)
}

/// A yard seen by [`dense_view`]: its ground, three walls, and bushes, with 5,000 Gaussians for
/// each square metre of a surface at `count` = 3 million. Standard deviations are 2 to 15 mm along
/// a surface, 0.4 to 3 native px, and a twentieth of that across it.
pub(crate) fn dense_capture(count: usize) -> Gaussians {
    let mut random = Random(36);
    // Fewer Gaussians on the same surfaces are larger, so that they cover them as well.
    let size = (3e6 / count as f64).sqrt();
    let specs: Vec<GaussianSpec> = (0..count).map(|_| splat(&mut random, size)).collect();
    gaussians_from_specs(&specs)
}

fn splat(random: &mut Random, size: f64) -> GaussianSpec {
    let mut between = |low: f64, high: f64| low + (high - low) * random.unit();
    let surface = between(0.0, 1.0);
    let (mean_m, normal) = match surface {
        // The ground, denser near the camera, as it is seen.
        s if s < 0.3 => {
            let z = 2.0 + 22.0 * between(0.0, 1.0).powf(1.5);
            (DVec3::new(between(-9.0, 9.0), 1.6, z), DVec3::Y)
        }
        s if s < 0.5 => {
            let side = if s < 0.4 { -1.0 } else { 1.0 };
            let z = 5.0 + 19.0 * between(0.0, 1.0).powf(1.5);
            (DVec3::new(9.0 * side, between(-6.0, 1.6), z), DVec3::X)
        }
        s if s < 0.65 => (DVec3::new(between(-9.0, 9.0), between(-6.0, 1.6), 24.0), DVec3::Z),
        // Six bushes of 1.2 m: leaves of every orientation.
        s => {
            let bush = ((s - 0.65) / 0.35 * 6.0).floor();
            let center = DVec3::new(2.4 * bush - 6.0, 0.6, 7.0 + 2.0 * (bush % 3.0));
            let at = DVec3::new(between(-1.0, 1.0), between(-1.0, 1.0), between(-1.0, 1.0));
            let leaf = DVec3::new(between(-1.0, 1.0), between(-1.0, 1.0), between(-1.0, 1.0));
            (center + 1.2 * at / at.length().max(0.6), leaf.normalize_or(DVec3::Z))
        }
    };
    // The logarithm is uniform, so that small ones are as frequent as large ones.
    let along_m = size * 2e-3 * 7.5_f64.powf(between(0.0, 1.0));
    let across = between(0.3, 1.0);
    let turn = DQuat::from_rotation_z(between(0.0, 3.2));
    let texture = (31.0 * mean_m.x).sin() * (23.0 * mean_m.y + 29.0 * mean_m.z).sin();
    let base = 0.45 + 0.15 * texture;
    let mut channel = |shift: f64| (base + shift + between(-0.2, 0.2)).clamp(0.0, 1.0);
    let rgb = [channel(0.0), channel(0.03), channel(-0.05)];
    GaussianSpec {
        mean_m,
        rotation: DQuat::from_rotation_arc(DVec3::Z, normal) * turn,
        sigma_m: along_m * DVec3::new(1.0, across, 0.05),
        opacity: between(0.05, 0.98),
        rgb,
    }
}
