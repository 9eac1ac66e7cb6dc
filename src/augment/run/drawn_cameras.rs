//! The cameras of a run.

use anyhow::{Context, ensure};

use wildcity_scene::Rig;
use wildcity_scene::geometry::Camera;
use wildcity_twin::store::Version;

use crate::{TrainingCamera, without_lens};

/// The cameras that are drawn: those named, or all of the rig, in the order of the rig.
pub(super) fn cameras(
    version: &Version,
    named: &[String],
    side_px: Option<u32>,
    lenses: bool,
) -> anyhow::Result<Vec<TrainingCamera>> {
    let rig = version
        .manifest
        .rig
        .clone()
        .or_else(|| Rig::preset(wildcity_session::limits::RIG))
        .context("the twin has no rig: `wildcity twin drive` gives it one")?;
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

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::camera::Pinhole;

    use super::*;

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
