//! Requests for images.

use std::sync::Arc;

use wildcity_render::MAX_VIEWS;
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::Camera;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Manifest, Rig};
use wildcity_session::{Engine, ImageEncoding, SessionError, Still, StillViews};
use wildcity_twin::residency::Resident;

use super::objects::{Object, ObjectAssets};
use super::open::OpenVersions;
use super::status::SensorsimError;
use crate::camera::{camera_name, jpeg_quality, view, with_preset};
use crate::lidar::{answer, lidar_view};
use crate::limits;
use crate::scene::{LocalFrame, SceneId};
use crate::wire::sensorsim as wire;

/// The rig of a twin without one, as for sessions.
const RIG: &str = wildcity_session::limits::RIG;

/// The preset with cameras that every scene offers in addition to those of its twin.
const OFFERED: &str = "alpamayo2";

/// A scene that was opened.
pub(crate) struct OpenScene {
    pub(crate) id: SceneId,
    pub(crate) resident: Arc<Resident>,
    pub(crate) frame: LocalFrame,
}

impl OpenScene {
    /// Opens a scene.
    ///
    /// # Errors
    /// There is no scene of this id, or its twin cannot be read.
    pub(crate) async fn open(engine: &Arc<Engine>, id: &str) -> Result<Self, SensorsimError> {
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
            wire::ImageFormat::Png => ImageEncoding::Png,
            wire::ImageFormat::Jpeg => ImageEncoding::Jpeg(jpeg_quality(request.image_quality)),
            wire::ImageFormat::RgbUint8Planar => ImageEncoding::Raw,
            other => {
                let must =
                    format!("image_format {other:?}: PNG, JPEG and RGB_UINT8_PLANAR are offered");
                return Err(SensorsimError::Invalid(must));
            }
        };
        // The overlay is scaled to the size of the image, which the view has.
        let appearance = self.appearance(request, &view.camera)?;
        Ok(Still { view, appearance, encoding })
    }

    /// The objects that a request's image or sweep shows.
    fn objects(&self, objects: &[wire::DynamicObject]) -> Result<Vec<Object>, SensorsimError> {
        let most = PlacedChunk::MAX_ACTORS;
        // The same bound as a session's, because a frame numbers its actors up to it.
        if objects.len() > most {
            let text = format!("{} dynamic_objects; at most {most} are accepted", objects.len());
            return Err(SensorsimError::Invalid(text));
        }
        objects.iter().map(|object| Object::read(object, &self.frame)).collect()
    }

    /// The exposure of the twin's camera of the same name, and with `insert_ego_mask` its overlay.
    fn appearance(
        &self,
        request: &wire::RgbRenderRequest,
        camera: &Camera,
    ) -> Result<Appearance, SensorsimError> {
        // The mask may be that of another camera than the one that the image is of.
        let logical_id = match (&request.ego_mask_id, &request.camera_intrinsics) {
            (Some(mask), _) if request.insert_ego_mask => mask.camera_logical_id.as_str(),
            (_, Some(spec)) => spec.logical_id.as_str(),
            (_, None) => return Ok(Appearance::default()),
        };
        let own = camera_name(logical_id)
            .and_then(|name| self.cameras().into_iter().find(|camera| camera.name == name));
        let Some(own) = own else { return Ok(Appearance::default()) };
        // The exposure applies without the overlay, too. Without one to scale, no size can be
        // refused.
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
    let own = manifest
        .rig
        .clone()
        .or_else(|| Rig::preset(RIG))
        .map(|rig| rig.cameras)
        .unwrap_or_default();
    with_preset(&own, Rig::preset(OFFERED).map(|rig| rig.cameras).unwrap_or_default())
}

/// Settings for the images of requests.
#[derive(Clone, Copy)]
pub(super) struct Renderer<'a> {
    pub(super) engine: &'a Arc<Engine>,
    pub(super) open: &'a OpenVersions,
    pub(super) assets: &'a Arc<ObjectAssets>,
}

/// A request's image, or why there is none.
type Image = Result<wire::RgbRenderReturn, SensorsimError>;

/// Requests that are rendered together because they have the same scene and objects.
struct Group {
    objects: Vec<Object>,
    /// Indices of the requests.
    indices: Vec<usize>,
    stills: Vec<Still>,
}

impl Renderer<'_> {
    /// The images of requests, or why there is none, in their order. Requests of the same scene and
    /// with the same objects are rendered together.
    pub(super) async fn images(self, requests: &[&wire::RgbRenderRequest]) -> Vec<Image> {
        let mut images: Vec<Option<Image>> = requests.iter().map(|_| None).collect();
        // A vector keeps the order of the requests; a request has one scene, or a few.
        let mut by_scene: Vec<(&str, Vec<usize>)> = Vec::new();
        for (index, request) in requests.iter().enumerate() {
            match by_scene.iter_mut().find(|(scene, _)| *scene == request.scene_id) {
                Some((_, indices)) => indices.push(index),
                None => by_scene.push((&request.scene_id, vec![index])),
            }
        }
        for (scene, indices) in by_scene {
            let asked: Vec<_> = indices.iter().map(|&index| requests[index]).collect();
            let answers = self.scene_images(scene, &asked).await;
            for (index, answer) in indices.into_iter().zip(answers) {
                images[index] = Some(answer);
            }
        }
        images.into_iter().map(|image| image.unwrap_or_else(no_image)).collect()
    }

    async fn scene_images(self, scene: &str, requests: &[&wire::RgbRenderRequest]) -> Vec<Image> {
        let opened = match OpenScene::open(self.engine, scene).await {
            Ok(opened) => opened,
            Err(error) => return repeated(&error, requests.len()).collect(),
        };
        // Off the threads that answer: an overlay is scaled for each image.
        let asked: Vec<_> = requests.iter().map(|request| (*request).clone()).collect();
        let read = tokio::task::spawn_blocking(move || {
            let still = |asked: &wire::RgbRenderRequest| {
                Ok((opened.still(asked)?, opened.objects(&asked.dynamic_objects)?))
            };
            let read: Vec<Result<_, SensorsimError>> = asked.iter().map(still).collect();
            (opened, read)
        });
        let Ok((opened, read)) = read.await else {
            return repeated(&SessionError::Crashed.into(), requests.len()).collect();
        };
        let mut images: Vec<Option<Image>> = requests.iter().map(|_| None).collect();
        let mut groups: Vec<Group> = Vec::new();
        for (index, read) in read.into_iter().enumerate() {
            // An invalid request fills its own place, and the others are rendered.
            match read {
                Err(error) => images[index] = Some(Err(error)),
                Ok((still, objects)) => {
                    // A frame draws its actors at one pose each, so that images with other objects
                    // or other poses are other frames. The images of one rig have the same.
                    let group = match groups.iter().position(|group| group.objects == objects) {
                        Some(group) => group,
                        None => {
                            groups.push(Group { objects, indices: Vec::new(), stills: Vec::new() });
                            groups.len() - 1
                        }
                    };
                    groups[group].indices.push(index);
                    groups[group].stills.push(still);
                }
            }
        }
        if groups.iter().any(|group| group.objects.iter().any(Object::is_unknown)) {
            self.open.warn_of_unknown_objects(scene);
        }
        // Each index is in one group, so that afterwards every place has its image or its error.
        for Group { objects, indices, stills } in groups {
            let answers: Vec<Image> = match self.render(&opened, scene, &objects, stills).await {
                Ok(files) => files.into_iter().map(image).collect(),
                Err(error) => repeated(&error, indices.len()).collect(),
            };
            for (index, answer) in indices.into_iter().zip(answers) {
                images[index] = Some(answer);
            }
        }
        images.into_iter().map(|image| image.unwrap_or_else(no_image)).collect()
    }

    /// The points of a sweep.
    pub(super) async fn sweep(
        self,
        request: &wire::LidarRenderRequest,
    ) -> Result<wire::LidarRenderReturn, SensorsimError> {
        let scene = &request.scene_id;
        let opened = OpenScene::open(self.engine, scene).await?;
        let view = lidar_view(request, &opened.frame)?;
        let objects = opened.objects(&request.dynamic_objects)?;
        if objects.iter().any(Object::is_unknown) {
            self.open.warn_of_unknown_objects(scene);
        }
        let resident = opened.resident.clone();
        let views = StillViews { images: &[], sweep: Some(&view) };
        let renderer = self.open.stills(self.engine, resident, scene, views).await?;
        let actors = self.assets.actors(self.engine, &objects).await?;
        let sweep = renderer.sweep(view.clone(), &actors, limits::RENDER_TIMEOUT).await?;
        // Half a million points: off the threads that answer.
        let answered = tokio::task::spawn_blocking(move || answer(&view, &sweep)).await;
        answered.map_err(|_| SessionError::Crashed.into())
    }

    async fn render(
        self,
        opened: &OpenScene,
        scene: &str,
        objects: &[Object],
        stills: Vec<Still>,
    ) -> Result<Vec<Vec<u8>>, SensorsimError> {
        // The memory of the largest frame: requests are rendered in frames of at most MAX_VIEWS.
        let views: Vec<_> = stills.iter().map(|still| still.view).take(MAX_VIEWS).collect();
        let resident = opened.resident.clone();
        let views = StillViews { images: &views, sweep: None };
        let renderer = self.open.stills(self.engine, resident, scene, views).await?;
        let actors = self.assets.actors(self.engine, objects).await?;
        let are_raw: Vec<bool> =
            stills.iter().map(|still| still.encoding == ImageEncoding::Raw).collect();
        let files = renderer.render(stills, &actors, limits::RENDER_TIMEOUT).await?;
        if !are_raw.contains(&true) {
            return Ok(files);
        }
        // Up to 64 MiB: off the threads that answer.
        let ordered = move || {
            let both = files.into_iter().zip(are_raw);
            both.map(|(file, is_raw)| if is_raw { planar(&file) } else { file }).collect()
        };
        tokio::task::spawn_blocking(ordered).await.map_err(|_| SessionError::Crashed.into())
    }
}

fn image(image_bytes: Vec<u8>) -> Image {
    Ok(wire::RgbRenderReturn { image_bytes })
}

fn no_image() -> Image {
    Err(SensorsimError::Invalid("no image was made".to_owned()))
}

/// The same error for each of several requests. Errors of the operating system cannot be cloned,
/// but the messages for the client can.
fn repeated(error: &SensorsimError, count: usize) -> impl Iterator<Item = Image> + use<> {
    let status = error.status();
    (0..count).map(move |_| Err(SensorsimError::Repeated(status.clone())))
}

/// [3, height, width] from [height, width, 3].
fn planar(rgb8: &[u8]) -> Vec<u8> {
    // All of red, then all of green, then all of blue.
    let mut planes = Vec::with_capacity(rgb8.len());
    for channel in 0..3 {
        planes.extend(rgb8.iter().skip(channel).step_by(3));
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_are_one_after_the_other() {
        assert_eq!(planar(&[1, 2, 3, 4, 5, 6]), [1, 4, 2, 5, 3, 6]);
    }
}
