//! `--size`: one size for all images of a rig.

use wildcity_scene::Rig;

/// Width and height of an image, in pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Size([u64; 2]);

impl Size {
    /// Gives all cameras of a rig this size.
    pub(super) fn apply(self, rig: &mut Rig) -> anyhow::Result<()> {
        let Self([width, height]) = self;
        for camera in &mut rig.cameras {
            *camera = camera.scaled(width, height)?;
        }
        Ok(())
    }
}

impl std::str::FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides =
            text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
        sides
            .map(Self)
            .ok_or_else(|| format!("{text:?} is not a size; expected WxH, for example 96x60"))
    }
}
