//! The ten methods.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Semaphore, watch};
use tonic::Status;

use wildcity_scene::rig::RigCamera;
use wildcity_session::Engine;

use super::objects::ObjectAssets;
use super::open::OpenVersions;
use super::render::{OpenScene, Renderer};
use super::status::SensorsimError;
use crate::camera::{available, logical_id};
use crate::limits;
use crate::physics::ground_intersection;
use crate::scene::{SceneId, listed_starts_m, trajectory};
use crate::wire::{API_VERSION, common, physics, sensorsim as wire};

/// The state of the service.
pub(super) struct Sensorsim {
    engine: Arc<Engine>,
    open: OpenVersions,
    assets: Arc<ObjectAssets>,
    physics: Arc<Semaphore>,
    stopping: watch::Receiver<bool>,
}

impl Sensorsim {
    pub(super) fn new(engine: Arc<Engine>, stopping: watch::Receiver<bool>) -> Self {
        let open = OpenVersions::default();
        let assets = Arc::default();
        let physics = Arc::new(Semaphore::new(limits::PHYSICS_REQUESTS));
        Self { engine, open, assets, physics, stopping }
    }

    /// Frees the memory of scenes that are no longer drawn, until dropped.
    pub(super) async fn forget_idle(&self) {
        loop {
            // A tenth of the idle time, so that memory is freed 10 to 11 minutes after the last
            // image.
            tokio::time::sleep(Duration::from_secs(60)).await;
            self.open.forget_idle().await;
            self.assets.forget_idle();
        }
    }

    /// Version of the program and of the API. All renderers of a runtime must answer the same.
    pub(super) fn get_version(&self) -> Result<common::VersionId, Status> {
        let version = env!("CARGO_PKG_VERSION");
        Ok(common::VersionId {
            version_id: format!("wildcity {version}"),
            git_hash: format!("v{version}"),
            grpc_api_version: Some(API_VERSION),
        })
    }

    /// The latest version of each drive at every 100 m, and `*`: other versions and starts are
    /// valid too.
    pub(super) async fn get_available_scenes(
        &self,
    ) -> Result<common::AvailableScenesReturn, Status> {
        let listed = self.engine.twins().await.map_err(SensorsimError::from)?;
        let mut scene_ids = Vec::new();
        for twin in &listed.twins {
            for drive in &twin.trajectories {
                for start_m in listed_starts_m(drive.length_m) {
                    let id = SceneId {
                        twin: twin.name.clone(),
                        version: twin.number,
                        trajectory: drive.name.clone(),
                        start_m,
                    };
                    scene_ids.push(id.to_string());
                }
            }
        }
        // A scene that is not listed is as valid, so that the list may be cut.
        scene_ids.truncate(limits::LISTED_SCENES);
        scene_ids.push("*".to_owned());
        Ok(common::AvailableScenesReturn { scene_ids })
    }

    /// The scenes that were drawn recently.
    pub(super) async fn get_loaded_scenes(&self) -> Result<wire::LoadedScenesReturn, Status> {
        let entry = |scene_id| wire::LoadedSceneEntry {
            scene_id,
            loaded_instance_count: 1,
            reusable_instance_count: 1,
        };
        Ok(wire::LoadedScenesReturn {
            scenes: self.open.recent().await.into_iter().map(entry).collect(),
            loaded_instance_capacity: limits::OPEN_SCENES as u64,
        })
    }

    /// The twin's rig, then a preset's cameras with other names.
    pub(super) async fn get_available_cameras(
        &self,
        asked: wire::SceneRequest,
    ) -> Result<wire::AvailableCamerasReturn, Status> {
        let scene = OpenScene::open(&self.engine, &asked.scene_id).await?;
        let available_cameras = scene.cameras().iter().map(available).collect();
        Ok(wire::AvailableCamerasReturn { available_cameras })
    }

    /// The recorded poses of a scene.
    pub(super) async fn get_available_trajectories(
        &self,
        asked: wire::SceneRequest,
    ) -> Result<wire::AvailableTrajectoriesReturn, Status> {
        let scene = OpenScene::open(&self.engine, &asked.scene_id).await?;
        let recorded = trajectory(&scene.id, &scene.resident.version.manifest);
        let trajectory = Some(recorded.map_err(SensorsimError::from)?);
        let available_trajectories = vec![wire::AvailableTrajectory { trajectory }];
        Ok(wire::AvailableTrajectoriesReturn { available_trajectories })
    }

    /// The cameras with an overlay, of the latest version of each twin.
    pub(super) async fn get_available_ego_masks(
        &self,
    ) -> Result<wire::AvailableEgoMasksReturn, Status> {
        let listed = self.engine.twins().await.map_err(SensorsimError::from)?;
        let mut ego_mask_metadata = Vec::new();
        for twin in &listed.twins {
            let opened = self.engine.open_version(twin.name.clone(), Some(twin.number)).await;
            let resident = opened.map_err(SensorsimError::from)?;
            // The cameras of a preset have no overlay.
            let Some(rig) = &resident.version.manifest.rig else { continue };
            let has_overlay = |camera: &&RigCamera| camera.appearance.overlay.is_some();
            ego_mask_metadata.extend(rig.cameras.iter().filter(has_overlay).map(|camera| {
                let id = wire::EgoMaskId {
                    camera_logical_id: logical_id(&camera.name),
                    rig_config_id: rig.name.clone(),
                };
                wire::EgoMaskMetadata { ego_mask_id: Some(id) }
            }));
        }
        Ok(wire::AvailableEgoMasksReturn { ego_mask_metadata })
    }

    pub(super) async fn render_rgb(
        &self,
        asked: wire::RgbRenderRequest,
    ) -> Result<wire::RgbRenderReturn, Status> {
        // As a batch of one, so that both methods have the same rules.
        let mut images = self.images(&[&asked]).await?;
        let image = images.pop().ok_or_else(|| Status::internal("no image"))?;
        Ok(image?)
    }

    /// Several images. An invalid camera, pose or size fails only its own image. An error that
    /// concerns all images fails the request, so that a client can distinguish an invalid request
    /// from a busy server.
    pub(super) async fn batch_render_rgb(
        &self,
        asked: wire::BatchRgbRenderRequest,
    ) -> Result<wire::BatchRgbRenderReturn, Status> {
        // An item without its request is malformed, and with it the batch.
        let requests: Option<Vec<_>> =
            asked.items.iter().map(|item| item.request.as_ref()).collect();
        let requests =
            requests.ok_or_else(|| Status::invalid_argument("items: request is missing"))?;
        let images = self.images(&requests).await?;
        let mut items = Vec::with_capacity(images.len());
        for (item, image) in asked.items.iter().zip(images) {
            let camera_name = item.camera_name.clone();
            items.push(match image {
                Ok(result) => wire::BatchRgbRenderReturnItem {
                    camera_name,
                    result: Some(result),
                    success: true,
                    error_message: String::new(),
                },
                Err(error) => {
                    let status = error.status();
                    // The runtime retries a whole request by its status, which an item does not
                    // have.
                    if status.code() != tonic::Code::InvalidArgument {
                        return Err(status);
                    }
                    wire::BatchRgbRenderReturnItem {
                        camera_name,
                        result: None,
                        success: false,
                        error_message: format!("INVALID_ARGUMENT: {}", status.message()),
                    }
                }
            });
        }
        Ok(wire::BatchRgbRenderReturn { items })
    }

    /// Several images, and sweeps one after the other.
    pub(super) async fn render_aggregated(
        &self,
        asked: wire::AggregatedRenderRequest,
    ) -> Result<wire::AggregatedRenderReturn, Status> {
        let most = limits::BATCH_SWEEPS;
        if asked.lidar_requests.len() > most {
            let text =
                format!("{} sweeps; at most {most} are accepted", asked.lidar_requests.len());
            return Err(Status::invalid_argument(text));
        }
        let requests: Vec<_> = asked.rgb_requests.iter().collect();
        let images = self.images(&requests).await?;
        let rgb_returns = images.into_iter().collect::<Result<_, _>>()?;
        let mut lidar_returns = Vec::with_capacity(asked.lidar_requests.len());
        for lidar in asked.lidar_requests {
            lidar_returns.push(self.render_lidar(lidar).await?);
        }
        Ok(wire::AggregatedRenderReturn { rgb_returns, lidar_returns, ..Default::default() })
    }

    /// Boxes on the ground, of the service of AlpaSim's physics.
    pub(super) async fn ground_intersection(
        &self,
        asked: physics::GroundIntersectionRequest,
    ) -> Result<physics::GroundIntersectionReturn, Status> {
        self.unless_stopped(ground_intersection(&self.engine, &self.physics, asked)).await?
    }

    /// The points of a sweep.
    pub(super) async fn render_lidar(
        &self,
        asked: wire::LidarRenderRequest,
    ) -> Result<wire::LidarRenderReturn, Status> {
        let Self { engine, open, assets, .. } = self;
        let renderer = Renderer { engine, open, assets };
        Ok(self.unless_stopped(renderer.sweep(&asked)).await??)
    }

    async fn images(
        &self,
        requests: &[&wire::RgbRenderRequest],
    ) -> Result<Vec<Result<wire::RgbRenderReturn, SensorsimError>>, Status> {
        let most = limits::BATCH_IMAGES;
        if requests.len() > most {
            let text = format!("{} images; at most {most} are accepted", requests.len());
            return Err(Status::invalid_argument(text));
        }
        check_raw(requests)?;
        let Self { engine, open, assets, .. } = self;
        let renderer = Renderer { engine, open, assets };
        self.unless_stopped(renderer.images(requests)).await
    }

    /// The result of `work`, unless the service stops before.
    async fn unless_stopped<T>(&self, work: impl Future<Output = T>) -> Result<T, Status> {
        tokio::select! {
            result = work => Ok(result),
            () = stopped(self.stopping.clone()) => Err(SensorsimError::Stopping.into()),
        }
    }
}

/// Refuses raw images that no answer can hold, before any of them is rendered.
fn check_raw(requests: &[&wire::RgbRenderRequest]) -> Result<(), SensorsimError> {
    let raw =
        requests.iter().filter(|asked| asked.image_format() == wire::ImageFormat::RgbUint8Planar);
    let each = raw.map(|asked| 3 * u64::from(asked.resolution_h) * u64::from(asked.resolution_w));
    let bytes = each.fold(0, u64::saturating_add);
    let most = limits::MESSAGE_BYTES as u64;
    if bytes < most {
        return Ok(());
    }
    Err(SensorsimError::Invalid(format!(
        "the raw images have {bytes} bytes; an answer has less than {most}: ask for PNG or JPEG, or \
         for fewer images at once"
    )))
}

/// Returns when the service stops.
pub(super) async fn stopped(mut stopping: watch::Receiver<bool>) {
    // An error means that the sender was dropped, which stops the service as well.
    let _ = stopping.wait_for(|&stop| stop).await;
}
