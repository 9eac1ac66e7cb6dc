//! Networks of the user that measure images.

use std::path::Path;

use anyhow::{Context, ensure};

use crate::{Kid, KidScores};
use wildcity_repair::{Image, Network};

use super::Settings;

/// Networks that measure images.
pub(super) struct Networks {
    lpips: Option<Network>,
    features: Option<Network>,
}

/// The features of images that are compared as one set.
#[derive(Debug, Default)]
pub(super) struct FeatureSet {
    pub(super) rendered: Vec<Vec<f32>>,
    pub(super) repaired: Vec<Vec<f32>>,
}

impl Networks {
    pub(super) fn load(settings: &Settings) -> anyhow::Result<Self> {
        let load = |option: &str, path: &Path, compares: bool| {
            let about = || format!("{option} {}", path.display());
            let network = Network::load(path, &settings.networks).with_context(about)?;
            let roles =
                if compares { "roles \"image\" and \"truth\"" } else { "role \"image\" only" };
            ensure!(
                network.manifest().compares() == compares,
                "{}: inputs: {option} takes a network with the {roles}",
                path.display()
            );
            Ok(network)
        };
        let lpips = settings.lpips.as_ref().map(|path| load("--lpips", path, true)).transpose()?;
        let features =
            settings.features.as_ref().map(|path| load("--features", path, false)).transpose()?;
        Ok(Self { lpips, features })
    }

    /// Name of the network of LPIPS, with its version.
    pub(super) fn lpips_name(&self) -> Option<String> {
        self.lpips.as_ref().map(name)
    }

    /// The distance of an image from the real one; `None` without such a network. Pixels that do
    /// not count are those of the real image in both.
    pub(super) fn lpips(
        &self,
        size_px: [u32; 2],
        image: &[u8],
        truth: &[u8],
        counts: Option<&[bool]>,
    ) -> anyhow::Result<Option<f64>> {
        let Some(network) = &self.lpips else { return Ok(None) };
        // A copy: other measures need the pixels as they were rendered.
        let mut pixels = image.to_vec();
        for (pixel, _) in counts.into_iter().flatten().enumerate().filter(|(_, counts)| !**counts) {
            pixels[3 * pixel..3 * pixel + 3].copy_from_slice(&truth[3 * pixel..3 * pixel + 3]);
        }
        let values = network.run(&sized(size_px, pixels), Some(&sized(size_px, truth.to_vec())))?;
        ensure!(
            // Networks are files of the user, and may compute something else.
            values.len() == 1,
            "--lpips: the network gave {} values; a distance is one",
            values.len()
        );
        Ok(Some(f64::from(values[0])))
    }

    /// The features of an image; `None` without such a network.
    pub(super) fn features(
        &self,
        size_px: [u32; 2],
        image: &[u8],
    ) -> anyhow::Result<Option<Vec<f32>>> {
        let Some(network) = &self.features else { return Ok(None) };
        Ok(Some(network.run(&sized(size_px, image.to_vec()), None)?))
    }

    /// The distances of a set from the real images; `None` without such a network.
    pub(super) fn kid(
        &self,
        set: &FeatureSet,
        truth: &[Vec<f32>],
    ) -> anyhow::Result<Option<KidScores>> {
        let Some(network) = &self.features else { return Ok(None) };
        let kid = |features: &[Vec<f32>]| Kid::compare(features, truth).context("--features");
        let repaired = (!set.repaired.is_empty()).then(|| kid(&set.repaired)).transpose()?;
        Ok(Some(KidScores { network: name(network), rendered: kid(&set.rendered)?, repaired }))
    }
}

fn name(network: &Network) -> String {
    let manifest = network.manifest();
    format!("{} {}", manifest.name, manifest.version)
}

fn sized([width, height]: [u32; 2], rgb8: Vec<u8>) -> Image {
    Image { width: width as usize, height: height as usize, rgb8 }
}
