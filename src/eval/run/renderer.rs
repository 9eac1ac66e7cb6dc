//! The renderer of the images.

use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_scene::srgb::change_stops;
use wildcity_session::{OpenScene, RenderedImage};

/// Changes of a render profile, and their check.
pub type ProfileChanges = dyn Fn(RenderProfile) -> anyhow::Result<RenderProfile>;

/// The renderer of the images.
pub(super) struct Renderer {
    pub(super) source: OpenScene,
    /// The profile of the scene.
    pub(super) own_profile: RenderProfile,
    /// Changes of the profile.
    pub(super) changes: Box<ProfileChanges>,
    pub(super) backend: Box<dyn Backend>,
    /// The transform from the axes of the images' poses to those of the scene.
    pub(super) alignment: Alignment,
    /// The maps that are rendered in addition to colours and opacity.
    pub(super) maps: Maps,
}

/// Maps of an image.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Maps {
    /// Also needed for normals.
    pub(super) depth: bool,
    pub(super) normals: bool,
}

impl Renderer {
    /// How an image is rendered: `near` of the list overrides the scene's, and the changes
    /// both.
    pub(super) fn profile(&self, near: Option<f64>) -> anyhow::Result<RenderProfile> {
        // The changes come last: what the user sets holds for every image.
        let near = near.unwrap_or(self.own_profile.near);
        (self.changes)(RenderProfile { near, ..self.own_profile })
    }

    pub(super) fn render(
        &self,
        view: &View,
        profile: &RenderProfile,
    ) -> anyhow::Result<RenderedImage> {
        let views = [*view];
        let scene = self.source.scene(&views, profile)?;
        let pixels = view.camera.pixels();
        let map =
            // A map that is not needed is empty, and costs neither memory nor time.
            |is_needed: bool, values: usize| vec![0.0; usize::from(is_needed) * values * pixels];
        let mut image = RenderedImage {
            rgb8: vec![0; 3 * pixels],
            depth_m: map(self.maps.depth, 1),
            opacity: map(true, 1),
            normals: map(self.maps.normals, 3),
            trust: 0.0,
        };
        let target = Target {
            rgb8: Some(&mut image.rgb8),
            depth_m: self.maps.depth.then_some(&mut image.depth_m),
            opacity: Some(&mut image.opacity),
            normals: self.maps.normals.then_some(&mut image.normals),
            ..Target::default()
        };
        let frame = Frame { scene: &scene, profile, views: &views };
        self.backend.render(&frame, &mut [target], &|_, _| {})?;
        Ok(image)
    }
}

/// Share of the pixels with an opacity of at least 1/2.
pub(super) fn covered(image: &RenderedImage) -> f64 {
    let covered = image.opacity.iter().filter(|opacity| **opacity >= 0.5).count();
    covered as f64 / image.opacity.len() as f64
}

/// Converts rendered and repaired pixels from the exposure of the twin to that of a real image, if
/// it is known.
pub(super) fn expose(
    stops: Option<f64>,
    rendered: &mut RenderedImage,
    repaired: &mut Option<Vec<u8>>,
) {
    let Some(stops) = stops else { return };
    change_stops(&mut rendered.rgb8, stops);
    if let Some(rgb8) = repaired {
        change_stops(rgb8, stops);
    }
}
