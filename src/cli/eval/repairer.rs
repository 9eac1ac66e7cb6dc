//! The model that repairs the images, if one is asked for.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};

use wildcity_eval::RepairSubject;
use wildcity_repair::reference::ReferenceCache;
use wildcity_repair::{InputRole, LoadOptions, Model};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_session::{
    NeededReferences, OfflineDrawing, OfflineReferences, OfflineView, ReferenceSource,
    ViewReferences,
};

use super::renderer::Renderer;
use crate::cli::directories::Twins;
use crate::cli::repair_options::runtime_library;
use crate::cli::scene_source::Source;

/// Largest number of threads of a network.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;

/// `--repair` and the runtime of networks.
#[derive(Debug, clap::Args)]
pub(super) struct RepairerOptions {
    /// Also repair each image with the model of this manifest (docs/repair.md), and compare the
    /// repaired image, too. Every image is repaired, at any trust. A model that compares with
    /// recorded images needs a twin with a drive; the images that are compared here are withheld
    /// from it.
    #[arg(long, value_name = "FILE")]
    repair: Option<PathBuf>,

    /// ONNX Runtime library for --repair, --lpips and --features, version 1.18 or later [default:
    /// $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of each network on the processor. The results do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,
}

/// A model and the images that it compares with.
pub(super) struct Repairer {
    model: Arc<Model>,
    needed: NeededReferences,
    /// The recorded images of a twin.
    references: Option<OfflineReferences>,
    cache: ReferenceCache,
}

/// A repaired image.
pub(super) struct Repaired {
    pub(super) rgb8: Vec<u8>,
    /// Name of the nearest recorded image, if the model saw it.
    pub(super) nearest: Option<String>,
}

impl RepairerOptions {
    /// How networks are loaded.
    pub(super) fn load_options(&self) -> LoadOptions {
        let library = runtime_library(self.onnxruntime.as_ref());
        LoadOptions { threads: self.repair_threads.into(), ..LoadOptions::new(library) }
    }

    /// Loads the model, if one is asked for. `held_out` are the poses of the images that are
    /// compared.
    pub(super) fn load(
        &self,
        source: &Source,
        twins: &Twins,
        held_out: &[Pose],
    ) -> anyhow::Result<Option<Repairer>> {
        let Some(manifest) = &self.repair else { return Ok(None) };
        let repairer = self.open(manifest, source, twins, held_out);
        repairer.with_context(|| format!("--repair {}", manifest.display())).map(Some)
    }

    fn open(
        &self,
        manifest: &Path,
        source: &Source,
        twins: &Twins,
        held_out: &[Pose],
    ) -> anyhow::Result<Repairer> {
        let options = self.load_options();
        let model = Arc::new(Model::load(manifest, &options)?);
        let needed = NeededReferences::from_model(&model);
        let name = &model.manifest().name;
        let references = match source {
            Source::Twin(resident) => {
                let cameras = resident.version.manifest.rig.as_ref().map(|rig| &rig.cameras[..]);
                let cameras = cameras.unwrap_or_default();
                let catalog = twins.catalog()?;
                let references =
                    OfflineReferences::open(resident.clone(), catalog, cameras, held_out)?;
                // The sizes of the images are known later.
                references.check(&model, &[])?;
                Some(references)
            }
            Source::File(_) => {
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
        Ok(Repairer { model, needed, references, cache })
    }
}

impl Repairer {
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
