//! The model and the cameras of `wildcity augment`.

use std::path::PathBuf;

use anyhow::{Context, ensure};

use wildcity_augment::{TrainingCamera, without_lens};
use wildcity_repair::{LoadOptions, Models, RepairError};
use wildcity_scene::Rig;
use wildcity_scene::geometry::Camera;
use wildcity_twin::store::Version;

use crate::cli::repair_options::runtime_library;

/// Largest number of threads of a model.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;
/// The rig of a twin without one, as in a session.
const DEFAULT_RIG: &str = "vehicle6";

/// The model that repairs the images.
#[derive(Debug, clap::Args)]
pub(super) struct ModelOptions {
    /// Manifest of the model that repairs the images (docs/repair.md) [default: none, images are as
    /// rendered]
    #[arg(long, value_name = "MODEL.json")]
    repair: Option<PathBuf>,

    /// Leave images below this trust as rendered: there the model would hallucinate.
    #[arg(long, value_name = "TRUST", default_value_t = 0.1, value_parser = trust, requires = "repair")]
    pub(super) at_least: f64,

    /// ONNX Runtime library for --repair, version 1.18 or later [default: $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of the model on the processor. The images do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,

    /// Memory for recorded images that the model compares with, in MiB.
    #[arg(long, value_name = "MIB", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..))]
    views_mib: u32,
}

impl ModelOptions {
    /// The model, or none. Reads its manifest, and loads nothing.
    pub(super) fn models(&self) -> Result<Models, RepairError> {
        let Some(manifest) = &self.repair else { return Ok(Models::default()) };
        let library = runtime_library(self.onnxruntime.as_ref());
        let threads = usize::from(self.repair_threads);
        let reference_bytes = u64::from(self.views_mib) << 20;
        let options = LoadOptions { threads, reference_bytes, ..LoadOptions::new(library) };
        Models::read(std::slice::from_ref(manifest), options)
    }
}

/// The cameras that are drawn: those named, or all of the rig, in the order of the rig.
pub(super) fn cameras(
    version: &Version,
    named: &[String],
    side_px: Option<u32>,
    lenses: bool,
) -> anyhow::Result<Vec<TrainingCamera>> {
    let rig = version.manifest.rig.clone().or_else(|| Rig::preset(DEFAULT_RIG));
    let rig = rig.context("the twin has no rig: `wildcity twin drive` gives it one")?;
    let known: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
    let unknown = named.iter().find(|name| !known.contains(&&***name));
    if let Some(unknown) = unknown {
        anyhow::bail!("--cameras {unknown:?}: the rig has {}", known.join(", "));
    }
    let is_drawn = |name: &String| named.is_empty() || named.contains(name);
    let cameras = rig.cameras.iter().filter(|camera| is_drawn(&camera.name)).map(|mounted| {
        let drawn = if lenses { mounted.camera } else { without_lens(&mounted.camera) };
        let camera = sized(drawn, side_px).with_context(|| format!("camera {:?}", mounted.name))?;
        let rig_from_camera = mounted.rig_from_camera;
        Ok(TrainingCamera { name: mounted.name.clone(), camera, rig_from_camera })
    });
    cameras.collect()
}

/// The camera with images of at most this side. Smaller images stay as they are.
fn sized(camera: Camera, side_px: Option<u32>) -> anyhow::Result<Camera> {
    let [width, height] = [camera.width_px, camera.height_px].map(f64::from);
    let scale = side_px.map_or(1.0, |side_px| f64::from(side_px) / width.max(height));
    if scale >= 1.0 {
        return Ok(camera);
    }
    let side = |px: f64| (px * scale).round().max(1.0) as u64;
    let scaled = camera.scaled(side(width), side(height))?;
    ensure!(scaled.width_px > 1 && scaled.height_px > 1, "--side leaves no image");
    Ok(scaled)
}

/// Metres, with or without their unit.
pub(super) fn metres(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let number = text.strip_suffix('m').unwrap_or(text).trim_end();
    number.parse().map_err(|_| format!("{text:?} is not a number of metres, such as 2 or 2m"))
}

fn trust(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(trust) if (0.0..=1.0).contains(&trust) => Ok(trust),
        _ => Err("expected a trust from 0 to 1".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::camera::Pinhole;

    use super::*;

    #[test]
    fn metres_have_a_unit_or_none() {
        assert_eq!((metres("2m"), metres(" 0.5 ")), (Ok(2.0), Ok(0.5)));
        assert!(metres("two").unwrap_err().contains("\"two\""));
    }

    #[test]
    fn images_are_shrunk_to_a_side_and_not_enlarged() {
        let pinhole = Pinhole { fx: 1800.0, fy: 1800.0, cx: 720.0, cy: 464.0 };
        let camera = Camera::from_pinhole(1440, 928, pinhole);
        let small = sized(camera, Some(360)).unwrap();
        assert_eq!((small.width_px, small.height_px, small.pinhole.fx), (360, 232, 450.0));
        assert_eq!(small.native_size_px, Some(camera.size_px()));
        assert_eq!(sized(camera, Some(4000)).unwrap(), camera);
        assert_eq!(sized(camera, None).unwrap(), camera);
    }
}
