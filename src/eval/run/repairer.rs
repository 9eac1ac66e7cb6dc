//! The model that repairs the images, if one is asked for.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, ensure};

use wildcity_repair::reference::ReferenceCache;
use wildcity_repair::{InputRole, LoadOptions, Model};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_session::{
    NeededReferences, OfflineDrawing, OfflineReferences, OfflineView, OpenScene, ReferenceSource,
    ViewReferences,
};
use wildcity_twin::store::Catalog;

use super::Settings;
use super::renderer::Renderer;
use crate::RepairSubject;

/// A model and the images that it compares with.
pub(super) struct Repairer {
    model: Arc<Model>,
    needed: NeededReferences,
    /// The recorded images of a twin.
    references: Option<OfflineReferences>,
    cache: ReferenceCache,
}

pub(super) struct Repaired {
    pub(super) rgb8: Vec<u8>,
    /// Name of the nearest recorded image, if the model saw it.
    pub(super) nearest: Option<String>,
}

impl Repairer {
    /// Loads the model, if one is asked for. `held_out` are the poses of the images that are
    /// compared.
    pub(super) fn load(
        settings: &Settings,
        source: &OpenScene,
        catalog: Option<&Catalog>,
        held_out: &[Pose],
    ) -> anyhow::Result<Option<Self>> {
        let Some(manifest) = &settings.repair else { return Ok(None) };
        let repairer = Self::open(manifest, &settings.networks, source, catalog, held_out);
        repairer.with_context(|| format!("--repair {}", manifest.display())).map(Some)
    }

    fn open(
        manifest: &Path,
        options: &LoadOptions,
        source: &OpenScene,
        catalog: Option<&Catalog>,
        held_out: &[Pose],
    ) -> anyhow::Result<Self> {
        let model = Arc::new(Model::load(manifest, options)?);
        let needed = NeededReferences::from_model(&model);
        let name = &model.manifest().name;
        let references = match source {
            OpenScene::Twin(resident) => {
                let cameras = resident
                    .version
                    .manifest
                    .rig
                    .as_ref()
                    .map(|rig| &rig.cameras[..])
                    .unwrap_or_default();
                let catalog = catalog.context("a twin is in a catalog")?.clone();
                let references =
                    OfflineReferences::open(resident.clone(), catalog, cameras, held_out)?;
                // The sizes of the images are known later.
                references.check(&model, &[])?;
                Some(references)
            }
            OpenScene::File(_) => {
                ensure!(
                    !needed.any(),
                    "the model {name:?} needs images of a recorded drive, which a scene file does not have: give a twin, or a \
                     model without this input"
                );
                OfflineReferences::check_scale(&model)?;
                None
            }
        };
        let has_drive = source.version().is_some_and(|it| !it.manifest.trajectories.is_empty());
        ensure!(
            has_drive || !model.needs(InputRole::Trust),
            "the model {name:?} needs the trust, which only a twin with a recorded drive has: `wildcity twin drive` adds one"
        );
        let cache = ReferenceCache::new(options.reference_bytes);
        Ok(Self { model, needed, references, cache })
    }

    pub(super) fn needs_depth(&self) -> bool {
        self.needed.warped || self.needs_normals() || self.model.needs(InputRole::Depth)
    }

    pub(super) fn needs_normals(&self) -> bool {
        self.model.needs(InputRole::Normals)
    }

    /// The description of the model on the page and in eval.json.
    pub(super) fn subject(&self) -> RepairSubject {
        let manifest = self.model.manifest();
        let references = self.references.as_ref().filter(|_| self.needed.any());
        let source = references.and_then(OfflineReferences::source).map(|source| match source {
            ReferenceSource::Recorded => "recorded",
            ReferenceSource::Rendered => "rendered",
        });
        RepairSubject {
            model: manifest.name.clone(),
            version: manifest.version.clone(),
            repair_hash: self.model.repair_hash().to_hex().to_string(),
            references: source,
            left_out: references.map_or(0, OfflineReferences::left_out),
        }
    }

    /// Repairs an image that was rendered with a profile.
    pub(super) fn repair(
        &self,
        renderer: &Renderer,
        of: &OfflineView<'_>,
        profile: &RenderProfile,
    ) -> anyhow::Result<Repaired> {
        let drawing = OfflineDrawing { profile, backend: &*renderer.backend, cache: &self.cache };
        let references = match &self.references {
            Some(references) => references.beside(of, self.needed, drawing)?,
            None => ViewReferences::default(),
        };
        let nearest = references.nearest().map(str::to_owned);
        ensure!(
            nearest.is_some() || !self.needed.nearest,
            "the model {:?} needs a recorded image of the camera {:?} within 30 m; there is none",
            self.model.manifest().name,
            of.camera.name
        );
        let (rgb8, _) = references.repaired(&self.model, of)?;
        Ok(Repaired { rgb8, nearest })
    }
}
