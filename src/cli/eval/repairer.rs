//! The model that repairs the images, if one is asked for.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;

use wildcity_eval::RepairSubject;
use wildcity_render::View;
use wildcity_repair::{LoadOptions, Model};
use wildcity_scene::RenderProfile;
use wildcity_scene::geometry::Pose;
use wildcity_session::{ReferenceSource, RenderedImage, StillRepair, StillToRepair};

use super::renderer::Renderer;
use crate::cli::directories::Twins;
use crate::cli::repair_options::runtime_library;
use crate::cli::scene_source::Source;

/// Most threads of a network.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;

/// `--repair` and the runtime of networks.
#[derive(Debug, clap::Args)]
pub(super) struct RepairerOptions {
    /// Also repair each image by the model of this manifest (docs/repair.md), and compare the repaired image, too. Every
    /// image is repaired, whatever its trust. A model that compares with recorded images needs a twin with a drive; it
    /// does not get the images that are compared here.
    #[arg(long, value_name = "FILE")]
    repair: Option<PathBuf>,

    /// ONNX Runtime library for --repair, --lpips and --features, from version 1.18 on [default: ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of each network on the processor. The numbers do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,
}

/// A model and the images that it compares with.
pub(super) struct Repairer(StillRepair);

/// An image to repair, with where it is.
pub(super) struct PlacedImage<'a> {
    pub(super) camera_name: &'a str,
    pub(super) view: &'a View,
    pub(super) world_from_rig: &'a Pose,
    pub(super) rendered: &'a RenderedImage,
    pub(super) profile: &'a RenderProfile,
}

impl RepairerOptions {
    /// How networks are loaded.
    pub(super) fn load_options(&self) -> LoadOptions {
        let library = runtime_library(self.onnxruntime.as_ref());
        LoadOptions { threads: self.repair_threads.into(), ..LoadOptions::new(library) }
    }

    /// Loads the model, if one is asked for. `held_out` are the poses of the images that are compared.
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
        let twin = match source {
            Source::Twin(resident) => Some((twins.catalog()?, resident.clone())),
            Source::File(_) => None,
        };
        Ok(Repairer(StillRepair::open(model, twin, held_out, options.reference_bytes)?))
    }
}

impl Repairer {
    pub(super) fn needs_depth(&self) -> bool {
        self.0.needs_depth()
    }

    pub(super) fn needs_normals(&self) -> bool {
        self.0.needs_normals()
    }

    /// What the page and eval.json say of it.
    pub(super) fn subject(&self) -> RepairSubject {
        let model = self.0.model();
        let references = self.0.source().map(|source| match source {
            ReferenceSource::Recorded => "recorded",
            ReferenceSource::Rendered => "rendered",
        });
        RepairSubject {
            model: model.manifest().name.clone(),
            version: model.manifest().version.clone(),
            repair_hash: model.repair_hash().to_hex().to_string(),
            references,
            left_out: self.0.left_out(),
        }
    }

    /// The repaired pixels of an image.
    pub(super) fn repair(
        &self,
        renderer: &Renderer,
        image: &PlacedImage<'_>,
    ) -> anyhow::Result<Vec<u8>> {
        let &PlacedImage { camera_name, view, world_from_rig, rendered, profile } = image;
        let image = StillToRepair { camera_name, view, world_from_rig, rendered };
        Ok(self.0.repair(&image, profile, &*renderer.backend)?)
    }
}
