//! The files of `--save-images`.

use wildcity_augment::mask_png;
use wildcity_eval::Pair;
use wildcity_render::View;

use super::Eval;
use crate::cli::output;
use crate::cli::real_images::picture;

impl Eval {
    /// Writes the compared pixels and the map of their errors.
    pub(super) fn save(
        &self,
        name: &str,
        [pixels, errors]: [&str; 2],
        pair: &Pair,
        error_map: &[f32],
    ) -> anyhow::Result<()> {
        let [width, height] = pair.size_px();
        let rendered = wildcity_session::png(pair.rendered(), width, height);
        self.save_file(pixels, name, &rendered.map_err(anyhow::Error::msg)?)?;
        let map = wildcity_eval::error_png(pair, error_map);
        self.save_file(errors, name, &map.map_err(anyhow::Error::msg)?)
    }

    /// Writes the pixels of a view off the trajectory.
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

    /// Writes a mask that is white where nothing moves, as `--masks` takes it.
    pub(super) fn save_mask(
        &self,
        name: &str,
        still: &[bool],
        size_px: [u32; 2],
    ) -> anyhow::Result<()> {
        self.save_file("masks", name, &mask_png(still, size_px)?)
    }

    fn save_file(&self, folder: &str, name: &str, png: &[u8]) -> anyhow::Result<()> {
        let path = self.out.join(folder).join(picture::inside(name)).with_extension("png");
        output::create_dir(path.parent().unwrap_or(&self.out))?;
        output::write(&path, png)
    }
}
