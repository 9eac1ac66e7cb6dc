//! The repair of views without a session: references are read and rendered on the caller's thread.
//!
//! It is used by replays, by the report, which measures benefit and cost of the repair, and by
//! evaluations. A model gets the same inputs as in a session.

use std::sync::Arc;
use std::time::{Duration, Instant};

use wildcity_render::{Backend, View};
use wildcity_repair::reference::{Rays, Reference, ReferenceCache};
use wildcity_repair::{Image, InputRole, Model, RepairError, RepairTimes};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use super::drawn::{self, ReferenceInputs, WarpQuery};
use super::references::{ReferenceSource, ReferenceView, ReferenceViews, without};
use super::rendered_image::RenderedImage;
use super::session_repair;
use crate::error::SessionError;
use crate::record::format::profile_hash;
use crate::viewpoint::viewpoints;

/// Sources and renderer settings of references.
#[derive(Clone, Copy)]
pub(crate) struct ReferenceSupply<'a> {
    pub(crate) resident: &'a Arc<Resident>,
    pub(crate) profile: &'a RenderProfile,
    pub(crate) backend: &'a dyn Backend,
    pub(crate) catalog: &'a Catalog,
    pub(crate) cache: &'a ReferenceCache,
}

/// References of a view that are needed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NeededReferences {
    /// Images that are warped into the view by its depth.
    pub warped: bool,
    /// The nearest of the same camera.
    pub nearest: bool,
}

/// Finds the references of views of a version of a twin.
#[derive(Debug)]
pub struct OfflineReferences {
    resident: Arc<Resident>,
    catalog: Catalog,
    /// `None` if there is nothing to read or render.
    views: Option<ReferenceViews>,
    left_out: usize,
}

/// Renderer settings and cache of references.
#[derive(Clone, Copy)]
pub struct OfflineDrawing<'a> {
    /// Render profile of the twin.
    pub profile: &'a RenderProfile,
    pub backend: &'a dyn Backend,
    /// References that were read and rendered.
    pub cache: &'a ReferenceCache,
}

/// A rendered view that may be repaired.
#[derive(Clone, Copy)]
pub struct OfflineView<'a> {
    /// Its camera, by the name that recorded images have.
    pub camera: &'a RigCamera,
    /// The rays of that camera.
    pub rays: &'a Rays,
    /// How it was rendered.
    pub view: &'a View,
    /// Where the rig was: images are looked for around it.
    pub world_from_rig: &'a Pose,
    /// Its pixels, depth and opacity; normals if a model needs them.
    pub rendered: &'a RenderedImage,
    /// Name of the nearest image of the same camera for the previous view, if there was one.
    pub kept: Option<&'a str>,
}

/// The references of a view; none without a twin.
#[derive(Debug, Default)]
pub struct ViewReferences {
    pub(crate) beside: ReferenceInputs,
    /// Time to read and render references that were not in memory.
    pub read: Duration,
    /// How many those were.
    pub read_count: usize,
    /// Time to choose them, and to bring them into the view.
    pub warp: Duration,
}

impl NeededReferences {
    /// References that a model needs.
    pub fn from_model(model: &Model) -> Self {
        let nearest = model.needs(InputRole::Reference);
        Self { warped: session_repair::needs_warped(model), nearest }
    }

    /// Whether some are needed.
    pub fn any(self) -> bool {
        self.warped || self.nearest
    }
}

impl ReferenceSupply<'_> {
    /// The references of a view. Blocks.
    ///
    /// # Errors
    /// A recorded image or the twin cannot be read, or the depth cannot be rendered.
    pub(crate) fn beside(
        &self,
        views: &ReferenceViews,
        of: &OfflineView<'_>,
        needed: NeededReferences,
    ) -> Result<ViewReferences, SessionError> {
        let &OfflineView { camera, rays, view, world_from_rig, rendered, kept } = of;
        let mut found = ViewReferences::default();
        // First, as in a session: names are reported in this order.
        if needed.nearest {
            let pose = &view.world_from_camera;
            let nearest = views.nearest(camera, pose, world_from_rig, kept);
            if let Some(nearest) = nearest {
                let reference = self.timed(views, &nearest, &mut found)?;
                found.beside.set_reference(&nearest.name, &reference, &camera.camera);
            }
        }
        if needed.warped {
            let query = WarpQuery { camera, rays, view, image: rendered };
            // Reading is measured in `timed`, and not a second time here.
            let started = Instant::now();
            let overlapping = query.overlapping(views.around(world_from_rig));
            found.warp = started.elapsed();
            let mut around = Vec::new();
            for view in overlapping {
                let reference = self.timed(views, &view, &mut found)?;
                around.push((view.name, reference));
            }
            let started = Instant::now();
            query.warped(&around, &mut found.beside);
            found.warp += started.elapsed();
        }
        Ok(found)
    }

    /// A reference: from memory, or read and rendered.
    fn timed(
        &self,
        views: &ReferenceViews,
        view: &ReferenceView,
        found: &mut ViewReferences,
    ) -> Result<Arc<Reference>, SessionError> {
        let Self { resident, profile, backend, catalog, cache } = *self;
        // The same key as in a session, with which the cache may be shared.
        let key = view.key(&resident.version.hash, &profile_hash(profile));
        if let Some(known) = cache.get(&key) {
            return Ok(known);
        }
        let started = Instant::now();
        let image = drawn::read(catalog, &resident.version, view)?;
        let scene = resident.scene(&viewpoints(&[view.view()]), profile)?;
        let projection = views.projection(&view.camera);
        let drawn = drawn::draw(view, image, projection, &scene, profile, backend);
        let reference = Arc::new(drawn?);
        cache.insert(key, reference.clone());
        // Only what was not in memory counts.
        found.read += started.elapsed();
        found.read_count += 1;
        Ok(reference)
    }
}

impl ViewReferences {
    /// The images in the view, and 1 for each pixel that they have, else 0.
    pub fn warped(&self) -> Option<(&Image, &[f32])> {
        self.beside.warped.as_ref().map(|(image, valid)| (image, &valid[..]))
    }

    /// Name of the nearest image of the same camera.
    pub fn nearest(&self) -> Option<&str> {
        self.beside.nearest.as_deref()
    }

    /// The repaired pixels of their view, and how long the parts took. Blocks.
    ///
    /// # Errors
    /// The model fails.
    pub fn repaired(
        &self,
        model: &Model,
        of: &OfflineView<'_>,
    ) -> Result<(Vec<u8>, RepairTimes), RepairError> {
        session_repair::repair_timed(model, of.camera, of.rendered, &self.beside)
    }
}

impl OfflineReferences {
    /// The references of a version. If it has no recorded images, it is rendered with `cameras`.
    /// Recorded images at the poses `held_out` are left out: results are compared with them, so a
    /// model that gets them would get the ground truth.
    ///
    /// # Errors
    /// The table of recorded images cannot be read.
    pub fn open(
        resident: Arc<Resident>,
        catalog: Catalog,
        cameras: &[RigCamera],
        held_out: &[Pose],
    ) -> Result<Self, SessionError> {
        let version = resident.version.clone();
        let table = catalog.views(&version)?;
        let had = table.len();
        let table = without(table, held_out);
        let left_out = had - table.len();
        // There is nothing to read, and nothing to render with.
        let is_empty = table.is_empty() && cameras.is_empty();
        let views = if is_empty { None } else { ReferenceViews::new(version, table, cameras) };
        Ok(Self { resident, catalog, views, left_out })
    }

    /// Where the images come from; `None` without a recorded drive.
    pub fn source(&self) -> Option<ReferenceSource> {
        self.views.as_ref().map(ReferenceViews::source)
    }

    /// Number of recorded images that are left out.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// Checks that the output images of a model have the size of its input images.
    ///
    /// # Errors
    /// [`SessionError::RepairUnavailable`].
    pub fn check_scale(model: &Model) -> Result<(), SessionError> {
        // Without cameras, only the scale is left to check.
        session_repair::check_cameras(model, &[])
    }

    /// Checks that a model can repair the images of some cameras.
    ///
    /// # Errors
    /// [`SessionError::RepairUnavailable`].
    pub fn check(&self, model: &Model, cameras: &[RigCamera]) -> Result<(), SessionError> {
        session_repair::check_cameras(model, cameras)?;
        if NeededReferences::from_model(model).any() {
            session_repair::check_references(model, self.views.as_ref(), cameras)?;
        }
        Ok(())
    }

    /// The references of a view. Blocks. The first view at a place takes longer, because its
    /// references are rendered then.
    ///
    /// # Errors
    /// An image or the twin cannot be read or rendered.
    pub fn beside(
        &self,
        of: &OfflineView<'_>,
        needed: NeededReferences,
        drawing: OfflineDrawing<'_>,
    ) -> Result<ViewReferences, SessionError> {
        let Some(views) = &self.views else { return Ok(ViewReferences::default()) };
        let Self { resident, catalog, .. } = self;
        let OfflineDrawing { profile, backend, cache } = drawing;
        ReferenceSupply { resident, profile, backend, catalog, cache }.beside(views, of, needed)
    }
}
