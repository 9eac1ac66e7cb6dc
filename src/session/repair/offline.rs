//! The repair of views without a session: the images beside them are read and drawn on the caller's thread.
//!
//! A replay finds its references by this, and the report measures by it what a repair gains and costs.

use std::sync::Arc;
use std::time::{Duration, Instant};

use wildcity_render::{Backend, View};
use wildcity_repair::reference::{Reference, ReferenceCache};
use wildcity_repair::{Image, InputRole, Model, RepairError, RepairTimes};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use super::drawn::{self, Beside, CameraRays, Sight};
use super::references::{ReferenceSource, ReferenceView, ReferenceViews};
use super::rendered_image::RenderedImage;
use super::session_repair;
use crate::error::SessionError;
use crate::record::format::profile_hash;
use crate::viewpoint::viewpoints;

/// What references are read and drawn with.
#[derive(Clone, Copy)]
pub(crate) struct ReferenceSupply<'a> {
    pub(crate) resident: &'a Arc<Resident>,
    pub(crate) profile: &'a RenderProfile,
    pub(crate) backend: &'a dyn Backend,
    pub(crate) catalog: &'a Catalog,
    pub(crate) cache: &'a ReferenceCache,
}

impl ReferenceSupply<'_> {
    /// A reference: from memory, or read and drawn.
    ///
    /// # Errors
    /// A recorded image or the twin cannot be read, or the depth cannot be drawn.
    pub(crate) fn reference(
        &self,
        views: &ReferenceViews,
        view: &ReferenceView,
    ) -> Result<Arc<Reference>, SessionError> {
        let Self { resident, profile, backend, catalog, cache } = *self;
        let key = view.key(&resident.version.hash, &profile_hash(profile));
        if let Some(known) = cache.get(&key) {
            return Ok(known);
        }
        let image = drawn::read(catalog, &resident.version, view)?;
        let scene = resident.scene(&viewpoints(&[view.view()]), profile)?;
        let projection = views.projection(&view.camera);
        let drawn = drawn::draw(view, image, projection, &scene, profile, backend);
        let reference = Arc::new(drawn?);
        cache.insert(key, reference.clone());
        Ok(reference)
    }
}

/// Repairs views of a version of a twin, one by one.
pub struct OfflineRepair<'a> {
    cameras: &'a [RigCamera],
    rays: CameraRays,
    /// `None` if the twin has no recorded drive.
    views: Option<ReferenceViews>,
    supply: ReferenceSupply<'a>,
}

/// A rendered view that may be repaired.
#[derive(Clone, Copy)]
pub struct OfflineView<'a> {
    /// Which camera.
    pub camera: usize,
    /// How it was rendered.
    pub view: &'a View,
    /// Where the rig was.
    pub world_from_rig: &'a Pose,
    /// Its pixels, depth and opacity; normals if a model needs them.
    pub rendered: &'a RenderedImage,
}

/// The recorded images beside a view.
#[derive(Debug)]
pub struct ViewReferences {
    beside: Beside,
    /// Time to read and draw those that were not in memory.
    pub read: Duration,
    /// How many those were.
    pub read_count: usize,
    /// Time to choose them, and to bring them into the view.
    pub warp: Duration,
}

impl ViewReferences {
    /// The recorded images in the view, and 1 for each pixel that they have, else 0.
    pub fn warped(&self) -> Option<(&Image, &[f32])> {
        self.beside.warped.as_ref().map(|(image, valid)| (image, &valid[..]))
    }
}

impl<'a> OfflineRepair<'a> {
    /// For the images of some cameras of a version, drawn as the version says. References stay in `cache`.
    ///
    /// # Errors
    /// The table of recorded images cannot be read.
    pub fn new(
        resident: &'a Arc<Resident>,
        catalog: &'a Catalog,
        backend: &'a dyn Backend,
        cameras: &'a [RigCamera],
        cache: &'a ReferenceCache,
    ) -> Result<Self, SessionError> {
        let version = resident.version.clone();
        let table = catalog.views(&version)?;
        let views = ReferenceViews::of(version, table, cameras);
        let profile = &resident.version.manifest.profile;
        let supply = ReferenceSupply { resident, profile, backend, catalog, cache };
        Ok(Self { cameras, rays: CameraRays::new(cameras.len()), views, supply })
    }

    /// Where the recorded images come from; `None` without a recorded drive.
    pub fn source(&self) -> Option<ReferenceSource> {
        self.views.as_ref().map(ReferenceViews::source)
    }

    /// Checks that a model can repair the images of the cameras.
    ///
    /// # Errors
    /// [`SessionError::RepairUnavailable`].
    pub fn check(&self, model: &Model) -> Result<(), SessionError> {
        session_repair::check_cameras(model, self.cameras)?;
        if session_repair::needs_warped(model) || model.needs(InputRole::Reference) {
            session_repair::check_references(model, self.views.as_ref(), self.cameras)?;
        }
        Ok(())
    }

    /// The recorded images beside a view: in it by its depth, and the nearest of the same camera if a model needs
    /// one. Blocks.
    ///
    /// # Errors
    /// An image or the twin cannot be read, or drawn.
    pub fn references(
        &self,
        of: &OfflineView<'_>,
        with_nearest: bool,
    ) -> Result<ViewReferences, SessionError> {
        let camera = &self.cameras[of.camera];
        let rays = self.rays.of(of.camera, camera);
        let sight = Sight { camera, rays, view: of.view, image: of.rendered };
        let mut found = ViewReferences {
            beside: Beside::default(),
            read: Duration::ZERO,
            read_count: 0,
            warp: Duration::ZERO,
        };
        let mut around = Vec::new();
        if let Some(views) = &self.views {
            let started = Instant::now();
            let overlapping = sight.overlapping(views.around(of.world_from_rig));
            found.warp = started.elapsed();
            for view in overlapping {
                let reference = self.read(views, &view, &mut found)?;
                around.push((view.name, reference));
            }
            let pose = &of.view.world_from_camera;
            let nearest = match with_nearest {
                true => views.nearest(&camera.name, pose, of.world_from_rig, None),
                false => None,
            };
            if let Some(nearest) = nearest {
                let reference = self.read(views, &nearest, &mut found)?;
                found.beside.set_reference(&nearest.name, &reference, &camera.camera);
            }
        }
        let started = Instant::now();
        sight.warped(&around, &mut found.beside);
        found.warp += started.elapsed();
        Ok(found)
    }

    /// The repaired pixels of a view, and how long the parts took. Blocks.
    ///
    /// # Errors
    /// The model fails.
    pub fn repaired(
        &self,
        model: &Model,
        of: &OfflineView<'_>,
        references: &ViewReferences,
    ) -> Result<(Vec<u8>, RepairTimes), RepairError> {
        let camera = &self.cameras[of.camera];
        session_repair::repair_timed(model, camera, of.rendered, &references.beside)
    }

    fn read(
        &self,
        views: &ReferenceViews,
        view: &ReferenceView,
        found: &mut ViewReferences,
    ) -> Result<Arc<Reference>, SessionError> {
        let key = view.key(&self.supply.resident.version.hash, &profile_hash(self.supply.profile));
        let is_new = self.supply.cache.get(&key).is_none();
        let started = Instant::now();
        let reference = self.supply.reference(views, view)?;
        if is_new {
            found.read += started.elapsed();
            found.read_count += 1;
        }
        Ok(reference)
    }
}
