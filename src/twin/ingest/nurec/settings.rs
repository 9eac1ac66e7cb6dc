//! The settings of a layer: how its numbers are activated, and the kernel of its particles.
//!
//! Source: the templates that 3dgrut's exporter fills (export/nurec_templates.py), and its kernels
//! (threedgrut/model/geometry, particleResponse): of degree 2, exp(-d²/2), which is a Gaussian; of
//! degree n, another function of the same distance d, which is wider or narrower.

use super::msgpack::Value;
use super::{IngestError, bad};
use crate::ingest::notes::Reading;

/// Keys of the settings of particles that are checked, or that bound errors far below those that
/// are visible.
const KNOWN: [&str; 5] = [
    "density_kernel_degree",
    "density_kernel_planar",
    "density_kernel_density_clamping",
    "density_kernel_min_response",
    "radiance_sph_degree",
];

/// Refuses parameters with other activations, and particles with other kernels, than those that are
/// drawn.
pub(super) fn check(settings: &Value<'_>, layer: &str) -> Result<(), IngestError> {
    let wanted = [
        ("density_activation", "sigmoid"),
        ("scale_activation", "exp"),
        ("rotation_activation", "normalize"),
    ];
    for (key, wanted) in wanted {
        match settings.get(key) {
            Some(Value::Text(found)) if *found != wanted => {
                let reason = format!("is {found:?}; {wanted:?} is read");
                return Err(bad(&format!("config.layers.{layer}.{key}"), reason));
            }
            _ => (),
        }
    }
    let Some(particle) = settings.get("particle") else { return Ok(()) };
    let refused = |key: &str, reason: String| {
        Err(bad(&format!("config.layers.{layer}.particle.{key}"), reason))
    };
    match particle.get("density_kernel_degree") {
        None | Some(Value::Count(2)) => {}
        Some(Value::Count(degree)) => {
            let reason = format!(
                "is {degree}; Gaussians have 2, and such particles would be drawn in another width: train with \
                 render.particle_kernel_degree 2"
            );
            return refused("density_kernel_degree", reason);
        }
        Some(_) => return refused("density_kernel_degree", "is not a whole number".into()),
    }
    match particle.get("density_kernel_planar") {
        None | Some(Value::Bool(false)) => Ok(()),
        Some(Value::Bool(true)) => {
            let reason = "is true; only volumetric particles are drawn: train without it";
            refused("density_kernel_planar", reason.into())
        }
        Some(_) => refused("density_kernel_planar", "is neither true nor false".into()),
    }
}

/// Warns of settings of particles that are not read.
pub(super) fn warn_skipped(settings: &Value<'_>, layer: &str, reading: &mut Reading) {
    let keys = settings.get("particle").into_iter().flat_map(Value::keys);
    let skipped: Vec<&str> = keys.filter(|key| !KNOWN.contains(key)).collect();
    if !skipped.is_empty() {
        reading.warn_skipped(&format!("settings of config.layers.{layer}.particle"), &skipped);
    }
}
