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

/// Other keys of a layer: names, devices, and what only trades speed for accuracy.
const KNOWN_OF_LAYER: [&str; 8] = [
    "density_activation",
    "device",
    "name",
    "particle",
    "precision",
    "rotation_activation",
    "scale_activation",
    "transmittance_threshold",
];

/// Keys of `nre_data` and its `config`, but for those that say how the whole picture is made.
const KNOWN_OF_DATA: [&str; 4] = ["config", "model", "state_dict", "version"];
const KNOWN_OF_CONFIG: [&str; 5] =
    ["appearance_embedding", "background", "layers", "name", "renderer"];

/// Values of the payload's settings that are drawn. Others are an appearance or a background that
/// belongs to the picture.
const DRAWN: [(&[&str], &str); 3] = [
    (&["model"], "nre"),
    (&["config", "appearance_embedding", "name"], "skip-appearance"),
    (&["config", "background", "name"], "skip-background"),
];

/// Warns of settings of the payload that are drawn in another way, or that are not known.
pub(super) fn check_data(data: &Value<'_>, reading: &mut Reading) {
    warn_unknown(data, &KNOWN_OF_DATA, "nre_data", reading);
    if let Some(config) = data.get("config") {
        warn_unknown(config, &KNOWN_OF_CONFIG, "config", reading);
    }
    for (path, drawn) in DRAWN {
        let found = path.iter().try_fold(data, |value, key| value.get(key));
        if let Some(Value::Text(found)) = found
            && *found != drawn
        {
            reading.warn(format!("{} is {found:?}; it is drawn as {drawn:?}", path.join(".")));
        }
    }
    let background = data.get("config").and_then(|config| config.get("background"));
    let is_linear = background.and_then(|settings| settings.get("composite_in_linear_space"));
    if matches!(is_linear, Some(Value::Bool(true))) {
        let key = "config.background.composite_in_linear_space";
        reading.warn(format!("{key} is true; the sky is blended as stored values, not as light"));
    }
}

/// Warns of keys of a map that are not known.
fn warn_unknown(map: &Value<'_>, known: &[&str], place: &str, reading: &mut Reading) {
    let unknown: Vec<&str> = map.keys().filter(|key| !known.contains(key)).collect();
    if !unknown.is_empty() {
        reading.warn_skipped(&format!("entries of {place}"), &unknown);
    }
}

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

/// Warns of settings of a layer and of its particles that are not read.
pub(super) fn warn_skipped(settings: &Value<'_>, layer: &str, reading: &mut Reading) {
    warn_unknown(settings, &KNOWN_OF_LAYER, &format!("config.layers.{layer}"), reading);
    let keys = settings.get("particle").into_iter().flat_map(Value::keys);
    let skipped: Vec<&str> = keys.filter(|key| !KNOWN.contains(key)).collect();
    if !skipped.is_empty() {
        reading.warn_skipped(&format!("settings of config.layers.{layer}.particle"), &skipped);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::ReadLimits;

    fn map<'a>(entries: Vec<(&'a str, Value<'a>)>) -> Value<'a> {
        Value::Map(entries.into_iter().map(|(key, value)| (Value::Text(key), value)).collect())
    }

    fn warned(check: impl Fn(&mut Reading)) -> String {
        let mut reading = Reading::new(&ReadLimits::for_own_file());
        check(&mut reading);
        reading.into_notes().unwrap().warnings.join("; ")
    }

    #[test]
    fn settings_of_the_whole_picture_are_named() {
        let data = |model: &'static str, sky: &'static str, is_linear: bool| {
            let linear = ("composite_in_linear_space", Value::Bool(is_linear));
            let background = map(vec![("name", Value::Text(sky)), linear]);
            let appearance = map(vec![("name", Value::Text("skip-appearance"))]);
            let config = vec![("background", background), ("appearance_embedding", appearance)];
            map(vec![("model", Value::Text(model)), ("config", map(config))])
        };
        let warned = |data: Value<'_>| warned(|reading| check_data(&data, reading));
        assert_eq!(warned(data("nre", "skip-background", false)), "");
        let linear = warned(data("nre", "skip-background", true));
        assert!(linear.starts_with("config.background.composite_in_linear_space is true"));
        let sky = warned(data("other", "sky-mlp", false));
        assert_eq!(
            sky,
            "model is \"other\"; it is drawn as \"nre\"; \
             config.background.name is \"sky-mlp\"; it is drawn as \"skip-background\""
        );
        let unknown =
            map(vec![("fog", Value::Other), ("config", map(vec![("tone", Value::Other)]))]);
        assert_eq!(
            warned(unknown),
            "entries of nre_data not read: fog; entries of config not read: tone"
        );
    }

    #[test]
    fn unknown_settings_of_a_layer_are_named() {
        let particle =
            map(vec![("density_kernel_degree", Value::Count(2)), ("noise", Value::Other)]);
        let settings = map(vec![
            ("precision", Value::Count(16)),
            ("opacity_scale", Value::Other),
            ("particle", particle),
        ]);
        assert_eq!(
            warned(|reading| warn_skipped(&settings, "street", reading)),
            "entries of config.layers.street not read: opacity_scale; \
             settings of config.layers.street.particle not read: noise"
        );
    }
}
