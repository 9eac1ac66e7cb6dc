//! Options of a sky: its file, and how it is oriented.

use std::path::PathBuf;

use anyhow::Context;
use glam::DMat3;

use wildcity_scene::sky::SkyModel;
use wildcity_twin::ingest::{Axes, sky};
use wildcity_twin::store::SkyBytes;

/// A sky on the command line.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct SkySource {
    /// Sky behind the Gaussians: safetensors with the sky of a drivestudio checkpoint
    /// (sky_head.layers.0.weight, ..); or a PNG or JPEG with a panorama (2:1), a cross (4:3 or 3:4)
    /// or a strip (6:1 or 1:6) of the six faces of a cube; or a folder with px.png, nx.png, py.png,
    /// ny.png, pz.png and nz.png.
    #[arg(long, value_name = "FILE")]
    sky: Option<PathBuf>,

    /// Training image that gives the sky its appearance, by its number, for a sky of a checkpoint
    /// [default: the mean of all]
    #[arg(long, value_name = "INDEX", requires = "sky")]
    sky_image: Option<u32>,

    /// Axes of the sky, in the form of `wildcity import --axes` [default: --axes for a sky of a
    /// checkpoint; y-up-z-forward for images, which puts the middle of a panorama to the north]
    #[arg(long, value_name = "AXES", requires = "sky", allow_hyphen_values = true)]
    sky_axes: Option<String>,
}

/// Axes of images: x right, y up, z forward.
const IMAGE_AXES: &str = "y-up-z-forward";

impl SkySource {
    /// Reads the sky, if `--sky` gives one. `network_axes` are the default axes of a sky network.
    pub(super) fn read(&self, network_axes: &str) -> anyhow::Result<Option<SkyBytes>> {
        let Some(path) = &self.sky else { return Ok(None) };
        let read =
            sky::read(path, self.sky_image).with_context(|| format!("{}", path.display()))?;
        let default_axes = match read.model {
            SkyModel::Network(..) => network_axes,
            SkyModel::Cube(_) => IMAGE_AXES,
        };
        let axes: Axes = self.sky_axes.as_deref().unwrap_or(default_axes).parse()?;
        let sky_from_world: DMat3 = axes.file_from_twin();
        Ok(Some(SkyBytes { bytes: read.bytes.into(), image: self.sky_image, sky_from_world }))
    }
}
