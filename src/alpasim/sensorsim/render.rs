//! Requests for images.

use std::sync::Arc;

use wildcity_render::MAX_VIEWS;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::Camera;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Manifest, Rig};
use wildcity_session::{Encoding, Engine, Still};
use wildcity_twin::residency::Resident;

use super::open::OpenVersions;
use super::status::SensorsimError;
use crate::camera::{camera_name, jpeg_quality, view, with_preset};
use crate::limits;
use crate::scene::{LocalFrame, SceneId};
use crate::wire::sensorsim as wire;

/// The rig of a twin without one, as for sessions.
const RIG: &str = wildcity_session::limits::RIG;

/// The preset with cameras that every scene offers beside those of its twin.
const OFFERED: &str = "alpamayo2";

/// A scene that was opened.
pub(super) struct OpenScene {
    pub(super) id: SceneId,
    pub(super) resident: Arc<Resident>,
    pub(super) frame: LocalFrame,
}

impl OpenScene {
    /// Opens a scene.
    ///
    /// # Errors
    /// There is none of this id, or its twin cannot be read.
    pub(super) async fn open(engine: &Arc<Engine>, id: &str) -> Result<Self, SensorsimError> {
        let id: SceneId = id.parse()?;
        let resident = engine.open_version(id.twin.clone(), Some(id.version)).await?;
        let frame = id.local_frame(&resident.version.manifest)?;
        Ok(Self { id, resident, frame })
    }

    /// The cameras that the scene offers.
    pub(super) fn cameras(&self) -> Vec<RigCamera> {
        offered_cameras(&self.resident.version.manifest)
    }

    /// The image that a request asks for.
    fn still(&self, request: &wire::RgbRenderRequest) -> Result<Still, SensorsimError> {
        let view = view(request, &self.frame)?;
        let encoding = match request.image_format() {
            wire::ImageFormat::Png => Encoding::Png,
            wire::ImageFormat::Jpeg => Encoding::Jpeg(jpeg_quality(request.image_quality)),
            wire::ImageFormat::RgbUint8Planar => Encoding::Raw,
            other => {
                let must =
                    format!("image_format {other:?}: PNG, JPEG and RGB_UINT8_PLANAR are offered");
                return Err(SensorsimError::Invalid(must));
            }
        };
        let appearance = self.appearance(request, &view.camera)?;
        Ok(Still { view, appearance, encoding })
    }

    /// The exposure of the twin's camera of the same name, and with `insert_ego_mask` its overlay.
    fn appearance(
        &self,
        request: &wire::RgbRenderRequest,
        camera: &Camera,
    ) -> Result<Appearance, SensorsimError> {
        let logical_id = match (&request.ego_mask_id, &request.camera_intrinsics) {
            (Some(mask), _) if request.insert_ego_mask => mask.camera_logical_id.as_str(),
            (_, Some(spec)) => spec.logical_id.as_str(),
            (_, None) => return Ok(Appearance::default()),
        };
        let own = camera_name(logical_id)
            .and_then(|name| self.cameras().into_iter().find(|camera| camera.name == name));
        let Some(own) = own else { return Ok(Appearance::default()) };
        if !request.insert_ego_mask || own.appearance.overlay.is_none() {
            return Ok(Appearance { overlay: None, ..own.appearance });
        }
        let Camera { width_px, height_px, .. } = *camera;
        let scaled = own.scaled(width_px.into(), height_px.into());
        Ok(scaled.map_err(|error| SensorsimError::Invalid(error.to_string()))?.appearance)
    }
}

/// The cameras that a scene of a twin offers: those of the twin's rig, then those of a preset.
pub fn offered_cameras(manifest: &Manifest) -> Vec<RigCamera> {
    let own = manifest.rig.clone().or_else(|| Rig::preset(RIG));
    let own = own.map(|rig| rig.cameras).unwrap_or_default();
    with_preset(&own, Rig::preset(OFFERED).map(|rig| rig.cameras).unwrap_or_default())
}

/// The images of requests, or why there is none, in their order. Requests of the same scene are rendered
/// together.
pub(super) async fn images(
    engine: &Arc<Engine>,
    open: &OpenVersions,
    requests: &[&wire::RgbRenderRequest],
) -> Vec<Result<wire::RgbRenderReturn, SensorsimError>> {
    let mut images: Vec<Option<Result<wire::RgbRenderReturn, SensorsimError>>> =
        requests.iter().map(|_| None).collect();
    let mut by_scene: Vec<(&str, Vec<usize>)> = Vec::new();
    for (index, request) in requests.iter().enumerate() {
        match by_scene.iter_mut().find(|(scene, _)| *scene == request.scene_id) {
            Some((_, indices)) => indices.push(index),
            None => by_scene.push((&request.scene_id, vec![index])),
        }
    }
    for (scene, indices) in by_scene {
        let asked: Vec<_> = indices.iter().map(|&index| requests[index]).collect();
        let answers = scene_images(engine, open, scene, &asked).await;
        for (index, answer) in indices.into_iter().zip(answers) {
            images[index] = Some(answer);
        }
    }
    let none = || Err(SensorsimError::Invalid("no image was made".to_owned()));
    images.into_iter().map(|image| image.unwrap_or_else(none)).collect()
}

async fn scene_images(
    engine: &Arc<Engine>,
    open: &OpenVersions,
    scene: &str,
    requests: &[&wire::RgbRenderRequest],
) -> Vec<Result<wire::RgbRenderReturn, SensorsimError>> {
    let opened = match OpenScene::open(engine, scene).await {
        Ok(opened) => opened,
        Err(error) => return repeated(&error, requests.len()),
    };
    let stills: Vec<_> = requests.iter().map(|request| opened.still(request)).collect();
    let good: Vec<Still> = stills.iter().flatten().cloned().collect();
    let mut rendered = match render(engine, open, &opened, scene, good).await {
        Ok(images) => images.into_iter(),
        Err(error) => return repeated(&error, requests.len()),
    };
    stills
        .into_iter()
        .map(|still| {
            let still = still?;
            let image_bytes = rendered.next().unwrap_or_default();
            let image_bytes = match still.encoding {
                Encoding::Raw => planar(&image_bytes),
                Encoding::Jpeg(_) | Encoding::Png => image_bytes,
            };
            Ok(wire::RgbRenderReturn { image_bytes })
        })
        .collect()
}

async fn render(
    engine: &Arc<Engine>,
    open: &OpenVersions,
    opened: &OpenScene,
    scene: &str,
    stills: Vec<Still>,
) -> Result<Vec<Vec<u8>>, SensorsimError> {
    if stills.is_empty() {
        return Ok(Vec::new());
    }
    // The memory of the largest frame: requests are rendered in frames of at most MAX_VIEWS.
    let views: Vec<_> = stills.iter().map(|still| still.view).take(MAX_VIEWS).collect();
    let renderer = open.stills(engine, opened.resident.clone(), scene, &views).await?;
    Ok(renderer.render(stills, limits::RENDER_TIMEOUT).await?)
}

/// The same error for each of several requests. Errors cannot be cloned, because those of the operating
/// system cannot; what a client sees of them can.
fn repeated(
    error: &SensorsimError,
    count: usize,
) -> Vec<Result<wire::RgbRenderReturn, SensorsimError>> {
    (0..count).map(|_| Err(SensorsimError::Repeated(error.status()))).collect()
}

/// [3, height, width] from [height, width, 3].
fn planar(rgb8: &[u8]) -> Vec<u8> {
    (0..3).flat_map(|channel| rgb8.iter().skip(channel).step_by(3).copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_are_one_after_the_other() {
        assert_eq!(planar(&[1, 2, 3, 4, 5, 6]), [1, 4, 2, 5, 3, 6]);
    }
}
