//! Small scenes for tests: Gaussians written with standard deviations, opacities and colours, which
//! [`Gaussians`] stores as logarithms, logits and SH coefficients.

use glam::{DQuat, DVec3};

use crate::View;
use crate::compare::images::view_along;
use wildcity_scene::{Gaussians, Scene, sh};

/// One Gaussian; by default an orange ball with a standard deviation of 10 cm, 5 m ahead of
/// [`forward_view`].
#[derive(Clone, Copy, Debug)]
pub struct GaussianSpec {
    pub mean_m: DVec3,
    /// Rotation from its own axes to the world's.
    pub rotation: DQuat,
    /// Standard deviation along each own axis, in metres.
    pub sigma_m: DVec3,
    /// Peak opacity, between 0 and 1.
    pub opacity: f64,
    pub rgb: [f64; 3],
}

impl Default for GaussianSpec {
    fn default() -> Self {
        Self {
            mean_m: DVec3::new(0.0, 0.0, 5.0),
            rotation: DQuat::IDENTITY,
            sigma_m: DVec3::splat(0.1),
            opacity: 0.9,
            rgb: [1.0, 0.6, 0.2],
        }
    }
}

/// A scene of some Gaussians.
pub fn scene_from_specs(specs: &[GaussianSpec]) -> Scene {
    Scene::from_gaussians(&gaussians_from_specs(specs))
}

/// The columns of some Gaussians, with SH degree 0.
pub fn gaussians_from_specs(specs: &[GaussianSpec]) -> Gaussians {
    let mut g = Gaussians::with_capacity(0, specs.len());
    for GaussianSpec { mean_m, rotation: q, sigma_m, opacity, rgb } in specs {
        g.means_m.push(mean_m.to_array());
        g.quats_wxyz.push([q.w, q.x, q.y, q.z].map(|q| q as f32));
        g.ln_scales.push(sigma_m.to_array().map(|s| s.ln() as f32));
        // The inverse of the sigmoid, and that of 0.5 + C0 c.
        g.logit_opacities.push((opacity / (1.0 - opacity)).ln() as f32);
        g.sh.extend(rgb.map(|c| ((c - 0.5) / sh::C0) as f32));
    }
    g
}

/// A pinhole camera at the origin that looks along +z, with +y down.
pub fn forward_view(size_px: [u32; 2], focal_px: f64) -> View {
    view_along(size_px, focal_px, DVec3::ZERO, DVec3::Z, DVec3::Y)
}
