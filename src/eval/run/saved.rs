//! The files of an evaluation besides its report: compared images and maps of their errors.

use wildcity_augment::mask_png;
use wildcity_render::View;

use super::Evaluator;
use crate::Pair;
use crate::images::picture;

impl Evaluator<'_> {
    /// Saves the compared pixels and the map of their errors.
    pub(super) fn save_pair(
        &self,
        name: &str,
        [pixels, errors]: [&str; 2],
        pair: &Pair,
        error_map: &[f32],
    ) -> anyhow::Result<()> {
        let [width, height] = pair.size_px();
        let rendered = wildcity_session::png(pair.rendered(), width, height);
        self.save_file(pixels, name, &rendered.map_err(anyhow::Error::msg)?)?;
        let map = crate::error_png(pair, error_map);
        self.save_file(errors, name, &map.map_err(anyhow::Error::msg)?)
    }

    /// Saves the pixels of a view off the trajectory.
    pub(super) fn save_pixels(
        &self,
        folder: &str,
        name: &str,
        rgb8: &[u8],
        view: &View,
    ) -> anyhow::Result<()> {
        let file = wildcity_session::png(rgb8, view.camera.width_px, view.camera.height_px);
        self.save_file(folder, name, &file.map_err(anyhow::Error::msg)?)
    }

    /// Saves a mask that is white where nothing moves, in the form of masks of real images.
    pub(super) fn save_mask(
        &self,
        name: &str,
        still: &[bool],
        size_px: [u32; 2],
    ) -> anyhow::Result<()> {
        self.save_file("masks", name, &mask_png(still, size_px)?)
    }

    fn save_file(&self, folder: &str, name: &str, png: &[u8]) -> anyhow::Result<()> {
        let Some(save) = self.save else { return Ok(()) };
        // Names of a list may contain `..`: a saved file must stay in its folder.
        let name = picture::inside(name).with_extension("png");
        save(&std::path::Path::new(folder).join(name), png)
    }
}
