//! Repair of single images, without a session: for programs that compare images with real ones.
//!
//! The model gets what a session gives it for an image of a pose that the ego is not at (`observe`). Recorded images
//! that are themselves compared are left out, since the model would see its own truth.

use std::sync::Arc;

use glam::DVec3;

use wildcity_render::{Backend, View};
use wildcity_repair::reference::{Rays, Reference, ReferenceCache};
use wildcity_repair::{InputRole, Model, RepairError};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::views::RecordedView;
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use super::drawn::{Beside, Sight};
use super::offline::ReferenceSupply;
use super::references::{ReferenceSource, ReferenceView, ReferenceViews};
use super::rendered_image::RenderedImage;
use super::session_repair;
use crate::error::SessionError;

/// A recorded image is one that is compared if it is so near to it, in metres ..
const SAME_PLACE_M: f64 = 0.05;

/// .. and looks in the same direction within this angle, in radians.
const SAME_DIRECTION_RAD: f64 = 0.02;

/// A model that repairs single images of a twin, or of a scene without a recorded drive.
#[derive(Debug)]
pub struct StillRepair {
    model: Arc<Model>,
    twin: Option<StillTwin>,
    cache: ReferenceCache,
}

/// The twin that references come from.
#[derive(Debug)]
struct StillTwin {
    catalog: Catalog,
    resident: Arc<Resident>,
    views: Option<ReferenceViews>,
    left_out: usize,
}

/// An image to repair.
#[derive(Clone, Copy, Debug)]
pub struct StillToRepair<'a> {
    /// Name of the camera, as the recorded images name it.
    pub camera_name: &'a str,
    /// Camera and pose.
    pub view: &'a View,
    /// Where the rig is: the recorded images are looked for around it.
    pub world_from_rig: &'a Pose,
    /// What was rendered, with the maps that [`StillRepair::needs_depth`] and [`StillRepair::needs_normals`] ask for.
    pub rendered: &'a RenderedImage,
}

/// Why an image was not repaired.
#[derive(Debug, thiserror::Error)]
pub enum StillRepairError {
    /// The model sees what only a twin with a recorded drive has.
    #[error(
        "the model {model:?} needs {what}, which {missing}: give a twin that has it (`wildcity twin drive`, `wildcity twin \
         views`), or a model without this input"
    )]
    Needs {
        /// Name of the model.
        model: String,
        /// What it needs.
        what: &'static str,
        /// Why there is none.
        missing: &'static str,
    },
    /// The model's output has another size.
    #[error(
        "the output of the model {model:?} is {scale} times as large as its input; images are compared in one size: give a \
         model of scale 1"
    )]
    Scale {
        /// Name of the model.
        model: String,
        /// Its scale.
        scale: u32,
    },
    /// The twin or a recorded image cannot be read, or a reference cannot be drawn.
    #[error(transparent)]
    Reference(#[from] SessionError),
    /// The model failed.
    #[error(transparent)]
    Model(#[from] RepairError),
}

impl StillRepair {
    /// The repair of images of a twin; of a scene without one if there is none. `held_out` are the poses of the images
    /// that are compared: recorded images there are left out. References take at most `cache_bytes` of memory.
    ///
    /// # Errors
    /// The model needs what there is not, or the table of recorded images cannot be read.
    pub fn open(
        model: Arc<Model>,
        twin: Option<(Catalog, Arc<Resident>)>,
        held_out: &[Pose],
        cache_bytes: u64,
    ) -> Result<Self, StillRepairError> {
        let name = || model.manifest().name.clone();
        let scale = model.manifest().outputs[0].scale;
        if scale != 1 {
            return Err(StillRepairError::Scale { model: name(), scale });
        }
        let needs = |what, missing| StillRepairError::Needs { model: name(), what, missing };
        let needs_images = needs_images(&model);
        let needs_trust = model.needs(InputRole::Trust);
        let twin = match twin {
            None if needs_images => {
                return Err(needs("images of a recorded drive", "a scene file does not have"));
            }
            None if needs_trust => {
                return Err(needs("the trust", "a scene file does not have"));
            }
            None => None,
            Some((catalog, resident)) => {
                let twin = StillTwin::open(catalog, resident, held_out, needs_images)?;
                if needs_images && twin.views.is_none() {
                    return Err(needs("images of a recorded drive", "this twin does not have"));
                }
                Some(twin)
            }
        };
        Ok(Self { model, twin, cache: ReferenceCache::new(cache_bytes) })
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Whether [`RenderedImage::depth_m`] is needed.
    pub fn needs_depth(&self) -> bool {
        session_repair::needs_warped(&self.model)
            || self.needs_normals()
            || self.model.needs(InputRole::Depth)
    }

    /// Whether [`RenderedImage::normals`] are needed.
    pub fn needs_normals(&self) -> bool {
        self.model.needs(InputRole::Normals)
    }

    /// Where the images that the model compares with come from, if it needs some.
    pub fn source(&self) -> Option<ReferenceSource> {
        self.views().map(ReferenceViews::source)
    }

    /// Number of recorded images that are compared themselves, and so left out.
    pub fn left_out(&self) -> usize {
        self.twin.as_ref().map_or(0, |twin| twin.left_out)
    }

    fn views(&self) -> Option<&ReferenceViews> {
        self.twin.as_ref()?.views.as_ref()
    }

    /// The repaired pixels of an image, `[height, width, 3]`. Blocks. The first image of a place takes longer, because
    /// the references of the place are drawn.
    ///
    /// # Errors
    /// The model fails, or a reference cannot be read or drawn.
    pub fn repair(
        &self,
        image: &StillToRepair<'_>,
        profile: &RenderProfile,
        backend: &dyn Backend,
    ) -> Result<Vec<u8>, StillRepairError> {
        let camera = RigCamera::new(image.camera_name, image.view.camera, Pose::IDENTITY);
        let mut beside = Beside::default();
        if let Some(twin) = &self.twin
            && let Some(views) = &twin.views
        {
            let reference =
                |view: &ReferenceView| self.reference(twin, views, view, profile, backend);
            let StillToRepair { view, world_from_rig, rendered, .. } = *image;
            if self.model.needs(InputRole::Reference) {
                let pose = &view.world_from_camera;
                let nearest = views.nearest(image.camera_name, pose, world_from_rig, None);
                let Some(nearest) = nearest else {
                    return Err(StillRepairError::Needs {
                        model: self.model.manifest().name.clone(),
                        what: "an image of the same camera within 30 m",
                        missing: "there is not here",
                    });
                };
                beside.set_reference(&nearest.name, &*reference(&nearest)?, &view.camera);
            }
            if session_repair::needs_warped(&self.model) {
                let rays = Rays::of(&view.camera);
                let sight = Sight { camera: &camera, rays: &rays, view, image: rendered };
                let mut around = Vec::new();
                for view in sight.overlapping(views.around(world_from_rig)) {
                    let drawn = reference(&view)?;
                    around.push((view.name, drawn));
                }
                sight.warped(&around, &mut beside);
            }
        }
        Ok(session_repair::repair(&self.model, &camera, image.rendered, &beside)?)
    }

    /// A reference: from memory, or read and drawn.
    fn reference(
        &self,
        twin: &StillTwin,
        views: &ReferenceViews,
        view: &ReferenceView,
        profile: &RenderProfile,
        backend: &dyn Backend,
    ) -> Result<Arc<Reference>, StillRepairError> {
        let StillTwin { catalog, resident, .. } = twin;
        let supply = ReferenceSupply { resident, profile, backend, catalog, cache: &self.cache };
        Ok(supply.reference(views, view)?)
    }
}

impl StillTwin {
    fn open(
        catalog: Catalog,
        resident: Arc<Resident>,
        held_out: &[Pose],
        needs_images: bool,
    ) -> Result<Self, StillRepairError> {
        let mut left_out = 0;
        let mut views = None;
        if needs_images {
            let version = resident.version.clone();
            let mut table = catalog.views(&version).map_err(SessionError::from)?;
            let had = table.len();
            table.retain(|view| !is_held_out(view, held_out));
            left_out = had - table.len();
            let cameras = version.manifest.rig.as_ref().map(|rig| rig.cameras.clone());
            let cameras = cameras.unwrap_or_default();
            // A twin whose images are all compared is drawn, as one without images; without a rig it has no cameras.
            if !(table.is_empty() && cameras.is_empty()) {
                views = ReferenceViews::of(version, table, &cameras);
            }
        }
        Ok(Self { catalog, resident, views, left_out })
    }
}

/// Whether a model sees images beside the rendered one.
fn needs_images(model: &Model) -> bool {
    session_repair::needs_warped(model) || model.needs(InputRole::Reference)
}

/// Whether a recorded image is one that is compared.
fn is_held_out(view: &RecordedView, held_out: &[Pose]) -> bool {
    let axis = |pose: &Pose| pose.rotation * DVec3::Z;
    let own = &view.world_from_camera;
    held_out.iter().any(|pose| {
        own.position_m.distance(pose.position_m) <= SAME_PLACE_M
            && axis(own).angle_between(axis(pose)) <= SAME_DIRECTION_RAD
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use wildcity_scene::geometry::Camera;
    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::manifest::ObjectRef;

    #[test]
    fn only_an_image_of_the_same_place_and_direction_is_left_out() {
        let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 5.0, cy: 5.0 };
        let view = RecordedView {
            trajectory: "log".into(),
            station_m: 0.0,
            camera_name: "front".into(),
            camera: Camera::from_pinhole(10, 10, pinhole),
            world_from_camera: Pose { position_m: DVec3::X, ..Pose::IDENTITY },
            exposure_stops: None,
            image: ObjectRef { object: "0".repeat(64), bytes: 3 },
        };
        let at = |x_m: f64, turn_rad: f64| Pose {
            position_m: DVec3::X * x_m,
            rotation: DQuat::from_rotation_y(turn_rad),
        };
        for (x_m, turn_rad, is_same) in [
            (1.0, 0.0, true),
            (1.04, 0.01, true),
            (1.06, 0.0, false),
            (0.5, 0.0, false),
            (1.0, 0.03, false),
            (1.0, 3.1, false),
        ] {
            assert_eq!(is_held_out(&view, &[at(9.0, 0.0), at(x_m, turn_rad)]), is_same, "{x_m}");
        }
        assert!(!is_held_out(&view, &[]));
    }
}
