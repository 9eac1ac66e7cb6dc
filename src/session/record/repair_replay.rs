//! The repair of a recorded episode, decided and done again.
//!
//! The decisions depend on the trust of the rendered images, which is computed again, and are compared with the
//! record always. Repaired pixels are compared if the model is at hand, has the recorded hash and repeats its
//! bytes; otherwise the report says that they were not.

use std::sync::Arc;

use wildcity_render::View;
use wildcity_repair::{Model, Models, RepairError};
use wildcity_scene::Manifest;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;

use super::format::EpisodeHeader;
use super::repairs::RecordedRepair;
use super::replay_report::{ProvenanceChange, ReplayError};
use crate::observe::trust::TrainingCoverage;
use crate::repair::session_repair::{self, RenderedImage};

/// The repair of an episode that is replayed.
pub(super) struct RepairReplay<'a> {
    recorded: &'a RecordedRepair,
    /// The recorded model.
    model: Option<Arc<Model>>,
    coverage: TrainingCoverage,
    /// By camera, whether it is in repair after the frames so far.
    repairing: Vec<bool>,
}

impl<'a> RepairReplay<'a> {
    /// None if the episode was not repaired. Loads the model if `models` has it; what differs from the recorded
    /// one is added to `changes`.
    ///
    /// # Errors
    /// The model cannot be loaded, or the twin has no recorded drive any more.
    pub(super) fn new(
        header: &'a EpisodeHeader,
        manifest: &Manifest,
        models: &Models,
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
            if now != recorded.repair_hash {
                change("repair hash", &recorded.repair_hash, &now);
            } else if !(recorded.deterministic && loaded.is_deterministic()) {
                change("repair", "compared", "not compared: the model does not repeat its bytes");
            } else {
                model = Some(loaded);
            }
        }
        let coverage = coverage_of(manifest)?;
        let mut repairing = header.first_state().repairing().to_vec();
        repairing.resize(header.rig.cameras.len(), false);
        Ok(Some(Self { recorded, model, coverage, repairing }))
    }

    /// Goes over to another version of the twin.
    pub(super) fn switch_version(&mut self, manifest: &Manifest) -> Result<(), ReplayError> {
        self.coverage = coverage_of(manifest)?;
        Ok(())
    }

    /// The buffers of a camera's image that decisions and the model need.
    pub(super) fn buffers(&self, camera: &RigCamera) -> RenderedImage {
        let pixels = camera.camera.pixels();
        let needs = |role| self.model.as_ref().is_some_and(|model| model.needs(role));
        let normals = needs(wildcity_repair::InputRole::Normals);
        let depth = normals || needs(wildcity_repair::InputRole::Depth);
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

    /// Decides which of some cameras' images are repaired. `images` has a buffer for each camera of the rig, and
    /// gets its trust. `is_observe`: the ego is not at the pose, and the decision has no history.
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
        let before: Vec<bool> = match is_observe {
            true => Vec::new(),
            false => selected.iter().map(|&camera| self.repairing[camera]).collect(),
        };
        let decision = self.recorded.selection.decide(&before, &trusts);
        if !is_observe {
            for (&camera, is_on) in selected.iter().zip(decision.is_on) {
                self.repairing[camera] = is_on;
            }
        }
        (0..selected.len()).map(|view| decision.cameras.contains(&view)).collect()
    }

    /// The repaired pixels; none without the recorded model.
    pub(super) fn repaired(
        &self,
        camera: &RigCamera,
        image: &RenderedImage,
    ) -> Result<Option<Vec<u8>>, RepairError> {
        let model = self.model.as_deref();
        model.map(|model| session_repair::repair(model, camera, image)).transpose()
    }
}

fn coverage_of(manifest: &Manifest) -> Result<TrainingCoverage, ReplayError> {
    TrainingCoverage::new(manifest).ok_or(ReplayError::NoDrive)
}
