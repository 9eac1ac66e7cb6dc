//! A sky on the command line.

use std::path::PathBuf;

use anyhow::Context;
use glam::DMat3;

use wildcity_scene::sky::SkyModel;
use wildcity_twin::ingest::{Axes, sky};
use wildcity_twin::store::SkyBytes;

/// A sky, and how it is looked at.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct SkySource {
    /// What is behind the Gaussians: safetensors with the sky of a drivestudio checkpoint
    /// (sky_head.layers.0.weight, ..), a panorama (2:1), a cross (4:3, 3:4) or strip (6:1, 1:6) of the
    /// six faces of a cube as PNG or JPEG, or a folder with px.png, nx.png, py.png, ny.png, pz.png and
    /// nz.png.
    #[arg(long, value_name = "FILE")]
    sky: Option<PathBuf>,

    /// Which image of the training set the sky is to look like; without, the mean of all.
    #[arg(long, value_name = "INDEX", requires = "sky")]
    sky_image: Option<u32>,

    /// Axes of the sky, as --axes has them [default: --axes for a network; y-up-z-forward, the middle
    /// to the north, for images]
    #[arg(long, value_name = "AXES", requires = "sky", allow_hyphen_values = true)]
    sky_axes: Option<String>,
}

/// Axes of images: x right, y up, z ahead.
const IMAGE_AXES: &str = "y-up-z-forward";

impl SkySource {
    /// Reads the sky, if there is one. A network's axes are `network_axes` unless others are given.
    pub(super) fn read(&self, network_axes: &str) -> anyhow::Result<Option<SkyBytes>> {
        let Some(path) = &self.sky else { return Ok(None) };
        let read = sky::read(path, self.sky_image);
        let read = read.with_context(|| format!("{}", path.display()))?;
        let usual = match read.model {
            SkyModel::Network(..) => network_axes,
            SkyModel::Cube(_) => IMAGE_AXES,
        };
        let axes: Axes = self.sky_axes.as_deref().unwrap_or(usual).parse()?;
        let sky_from_world: DMat3 = axes.file_from_twin();
        Ok(Some(SkyBytes { bytes: read.bytes.into(), image: self.sky_image, sky_from_world }))
    }
}
