//! Repeats the repair of a recorded episode and its decisions.
//!
//! The decisions depend on the trust of the rendered images, which is computed again, and are
//! compared with the record always. Repaired pixels are compared if the model is available, has the
//! recorded hash and is deterministic; otherwise the report mentions that they were not compared.

use std::sync::Arc;

use wildcity_render::{Backend, View};
use wildcity_repair::{InputRole, Model, Models, RepairError};
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Manifest, RenderProfile};
use wildcity_twin::residency::Resident;
use wildcity_twin::store::Catalog;

use super::format::EpisodeHeader;
use super::repairs::RecordedRepair;
use super::replay_report::{ProvenanceChange, ReplayError};
use crate::observe::trust::TrainingCoverage;
use crate::repair::drawn::{CameraRays, ReferenceInputs};
use crate::repair::offline::{NeededReferences, OfflineView, ReferenceSupply};
use crate::repair::references::ReferenceViews;
use crate::repair::rendered_image::RenderedImage;
use crate::repair::session_repair;
use crate::repair::status::RepairState;

/// The repair of an episode that is replayed.
pub(super) struct RepairReplay<'a> {
    recorded: &'a RecordedRepair,
    model: Option<Arc<Model>>,
    coverage: TrainingCoverage,
    /// Hysteresis state of each camera after the frames so far.
    state: RepairState,
    rays: CameraRays,
    /// The images that the model compares with, of the present version; if it needs some.
    references: Option<ReferenceViews>,
    models: &'a Models,
    catalog: &'a Catalog,
}

/// An image to repair again.
pub(super) struct ImageToRepair<'a> {
    pub(super) camera: usize,
    pub(super) mounted: &'a RigCamera,
    pub(super) rendered: &'a RenderedImage,
    pub(super) view: &'a View,
    pub(super) world_from_rig: &'a Pose,
    /// Whether the frame is of `observe`: the ego is not at its pose, so there is no history.
    pub(super) is_observe: bool,
}

/// Renderer settings for references.
#[derive(Clone, Copy)]
pub(super) struct Drawing<'a> {
    pub(super) resident: &'a Arc<Resident>,
    pub(super) profile: &'a RenderProfile,
    pub(super) backend: &'a dyn Backend,
}

impl<'a> RepairReplay<'a> {
    /// `None` if the episode was not repaired. Loads the model if `models` has it, and adds its
    /// differences from the recorded model to `changes`.
    ///
    /// # Errors
    /// The model cannot be loaded, or the twin has no recorded drive any more.
    pub(super) fn new(
        header: &'a EpisodeHeader,
        resident: &Resident,
        (models, catalog): (&'a Models, &'a Catalog),
        changes: &mut Vec<ProvenanceChange>,
    ) -> Result<Option<Self>, ReplayError> {
        let Some(recorded) = &header.repair else { return Ok(None) };
        let mut model = None;
        if models.names().any(|name| name == recorded.model) {
            let loaded =
                models.get(&recorded.model).map_err(|cause| ReplayError::Model(Box::new(cause)))?;
            let now = loaded.repair_hash().to_hex().to_string();
            let mut change = |what, recorded: &str, now: &str| {
                let recorded = recorded.to_owned();
                changes.push(ProvenanceChange { what, recorded, now: now.to_owned() });
            };
            // Another hash means other pixels: to compare them would report the model and not the
            // replay.
            if now != recorded.repair_hash {
                change("repair hash", &recorded.repair_hash, &now);
            } else if !(recorded.deterministic && loaded.is_deterministic()) {
                change("repair", "compared", "not compared: the model does not repeat its bytes");
            } else {
                model = Some(loaded);
            }
        }
        let coverage = training_coverage(&resident.version.manifest)?;
        let cameras = &header.rig.cameras;
        let state = header.first_state().repair_state().for_cameras(cameras.len());
        let rays = CameraRays::new(cameras.len());
        let references = None;
        // In two steps, since which references are read depends on the model.
        let mut replay =
            Self { recorded, model, coverage, state, rays, references, models, catalog };
        replay.read_references(resident, cameras)?;
        Ok(Some(replay))
    }

    /// Goes over to another version of the twin.
    pub(super) fn switch_version(
        &mut self,
        resident: &Resident,
        cameras: &[RigCamera],
    ) -> Result<(), ReplayError> {
        // From here on trusts are those of the other version.
        self.coverage = training_coverage(&resident.version.manifest)?;
        self.read_references(resident, cameras)
    }

    fn read_references(
        &mut self,
        resident: &Resident,
        cameras: &[RigCamera],
    ) -> Result<(), ReplayError> {
        let needs = |model: &Arc<Model>| NeededReferences::from_model(model).any();
        if self.model.as_ref().is_some_and(needs) {
            let version = resident.version.clone();
            let table = self
                .catalog
                .views(&version)
                .map_err(|cause| ReplayError::Reference(cause.to_string()))?;
            self.references = ReferenceViews::new(version, table, cameras);
        }
        Ok(())
    }

    /// The buffers of a camera's image that decisions and the model need.
    pub(super) fn buffers(&self, camera: &RigCamera) -> RenderedImage {
        let pixels = camera.camera.pixels();
        // Without the model nothing is repaired again, and its inputs are not rendered.
        let needs = |role| self.model.as_ref().is_some_and(|model| model.needs(role));
        let normals = needs(InputRole::Normals);
        let warped = self.model.as_deref().is_some_and(session_repair::needs_warped);
        // Normals are computed from depth, and references are warped by it.
        let depth = normals || warped || needs(InputRole::Depth);
        // An empty map is one that is not rendered.
        let map =
            |is_needed: bool, values: usize| vec![0.0; usize::from(is_needed) * values * pixels];
        RenderedImage {
            rgb8: vec![0; 3 * pixels],
            depth_m: map(depth, 1),
            opacity: map(true, 1),
            normals: map(normals, 3),
            trust: 0.0,
        }
    }

    /// Decides which of some cameras' images are repaired. `images` has a buffer for each camera of
    /// the rig, and gets its trust. `is_observe`: the ego is not at the pose, and the decision has
    /// no history.
    pub(super) fn decide(
        &mut self,
        is_observe: bool,
        world_from_rig: &Pose,
        selected: &[usize],
        views: &[View],
        images: &mut [RenderedImage],
    ) -> Vec<bool> {
        let mut trusts = Vec::with_capacity(selected.len());
        for (&camera, view) in selected.iter().zip(views) {
            let image = &mut images[camera];
            image.trust = self.coverage.trust(world_from_rig, view, &image.opacity).value;
            trusts.push(image.trust);
        }
        // No camera was on, as in the session.
        let before: Vec<bool> = if is_observe {
            Vec::new()
        } else {
            selected.iter().map(|&camera| self.state.is_on[camera]).collect()
        };
        let decision = self.recorded.selection.decide(&before, &trusts);
        if !is_observe {
            for (&camera, is_on) in selected.iter().zip(decision.is_on) {
                self.state.is_on[camera] = is_on;
            }
        }
        (0..selected.len()).map(|view| decision.cameras.contains(&view)).collect()
    }

    /// The repaired pixels; `None` without the recorded model.
    ///
    /// # Errors
    /// The model fails, or a reference cannot be read or drawn.
    pub(super) fn repaired(
        &mut self,
        image: &ImageToRepair<'_>,
        drawing: Drawing<'_>,
    ) -> Result<Option<Vec<u8>>, RepairError> {
        let Some(model) = self.model.clone() else { return Ok(None) };
        let inputs = self
            .reference_inputs(&model, image, drawing)
            .map_err(|message| RepairError::Input { field: "reference".to_owned(), message })?;
        let repaired = session_repair::repair(&model, image.mounted, image.rendered, &inputs)?;
        if !image.is_observe {
            // Only after a success, as in the session.
            self.state.references[image.camera] = inputs.nearest;
        }
        Ok(Some(repaired))
    }

    /// References that the model gets in addition to an image.
    fn reference_inputs(
        &self,
        model: &Model,
        image: &ImageToRepair<'_>,
        Drawing { resident, profile, backend }: Drawing<'_>,
    ) -> Result<ReferenceInputs, String> {
        let ImageToRepair { camera, mounted, rendered, view, world_from_rig, is_observe } = *image;
        // Only a model that needs references has a list of them.
        let Some(references) = &self.references else { return Ok(ReferenceInputs::default()) };
        let kept = if is_observe { None } else { self.state.references[camera].as_deref() };
        let rays = self.rays.camera_rays(camera, mounted);
        let of = OfflineView { camera: mounted, rays, view, world_from_rig, rendered, kept };
        let Self { models, catalog, .. } = *self;
        let cache = models.references();
        let supply = ReferenceSupply { resident, profile, backend, catalog, cache };
        let found = supply.beside(references, &of, NeededReferences::from_model(model));
        found.map(|found| found.beside).map_err(|error| error.to_string())
    }
}

fn training_coverage(manifest: &Manifest) -> Result<TrainingCoverage, ReplayError> {
    TrainingCoverage::new(manifest).ok_or(ReplayError::NoDrive)
}
