//! The renderer: six images of one step, by one of several backends that compute the same thing.
//!
//! The stages project, sort, bin, rasterize, resolve bear one name in every backend. An image is a
//! function of (scene, profile, views): no clock, no cache, no thread count.

pub mod automatic;
pub mod compare;
pub mod constants;
pub mod cpu;
pub mod gpu;
pub mod hybrid;
pub mod layout;
pub mod limits;
mod normals;
pub mod reference;
pub mod stage;
pub mod unscented;
pub mod view;

use std::sync::Arc;

use glam::{DMat3, DVec3};

use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::sky::{CubeMap, DrawableSky, SkyError};
use wildcity_scene::{Rays, RenderProfile, Rig, Scene};

pub use view::{RollingShutter, View};

/// One chain of stages: all views of one step.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    /// What is drawn.
    pub scene: &'a Scene,
    /// How it must be drawn.
    pub profile: &'a RenderProfile,
    /// From where: 1 to [`MAX_VIEWS`].
    pub views: &'a [View],
}

/// Most views of one frame: those of the largest rig.
pub const MAX_VIEWS: usize = Rig::MAX_CAMERAS;

/// Where the pixels of one view go, row by row from the top; what is `None` is not computed. What the
/// view's lens does not see is 0 in all of them.
#[derive(Debug, Default)]
pub struct Target<'a> {
    /// `[height, width, 4]`: linear red, green, blue, those of Gaussians premultiplied, on the sky or the
    /// background; and the opacity of the Gaussians alone.
    pub rgba: Option<&'a mut [f32]>,
    /// `[height, width, 3]`: the same, clamped to [0, 1] and rounded to 8 bit.
    pub rgb8: Option<&'a mut [u8]>,
    /// `[height, width]`: expected depth ([`Camera::depth_m`]) in metres, 0 where opacity is 0.
    pub depth_m: Option<&'a mut [f32]>,
    /// `[height, width]`: accumulated opacity, the validity of the depth.
    pub opacity: Option<&'a mut [f32]>,
    /// `[height, width, 3]`: unit normals of the surfaces of `depth_m`, which must be there, too: in the
    /// camera's axes, on the side that is seen; 0 where there is no depth.
    pub normals: Option<&'a mut [f32]>,
    /// What the camera makes of the colours, of `rgba` and `rgb8` alike.
    pub appearance: Option<&'a Appearance>,
}

impl Target<'_> {
    /// What every backend does with a view's pixels in the end.
    fn finish(&mut self, view: &View) {
        self.mask(&view.camera);
        if let (Some(depth_m), Some(normals)) = (&self.depth_m, &mut self.normals) {
            normals::write(view, depth_m, normals);
        }
    }

    /// Zeroes what a camera's lens does not see: nothing, where it is a pinhole.
    fn mask(&mut self, camera: &Camera) {
        let Some(field) = FieldMask::of(camera) else { return };
        if let Some(rgb8) = &mut self.rgb8 {
            field.clear_outside(camera, 3, rgb8);
        }
        for (values, image) in [(4, &mut self.rgba), (1, &mut self.depth_m), (1, &mut self.opacity)]
        {
            if let Some(image) = image {
                field.clear_outside(camera, values, image);
            }
        }
    }
}

/// Called once per view, as soon as its pixels are final, from a worker thread: the place to
/// encode one image while others are still drawn.
pub type OnViewDone<'a> = &'a (dyn Fn(usize, &Target<'_>) + Sync);

/// What a frame cost.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct FrameStats {
    /// Wall time per stage, in milliseconds, in the order of the chain.
    pub stages_ms: Vec<(&'static str, f64)>,
    /// (Gaussian, view) pairs that survived culling.
    pub visible_pairs: u64,
    /// (Gaussian, tile) pairs after binning.
    pub instances: u64,
    /// Gaussian-pixel evaluations of the rasterizer, idle lanes included.
    pub evaluations: u64,
}

/// Why a frame was not rendered. Nothing was written then.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// No view, or more than the sort key can tell apart.
    #[error("a frame has 1 to {MAX_VIEWS} views, not {count}")]
    Views {
        /// How many were given.
        count: usize,
    },
    /// The backend draws splats alone.
    #[error(
        "the {backend} backend draws splats, and the profile asks for rays=exact: use the reference \
         backend, or rays=splats"
    )]
    ExactRays {
        /// Its name.
        backend: &'static str,
    },
    /// A target's buffer is not of its view's size.
    #[error(
        "view {view}: buffer {buffer} holds {given} values; the camera's size asks for {wanted}"
    )]
    TargetSize {
        /// Which view.
        view: usize,
        /// Which buffer of [`Target`].
        buffer: &'static str,
        /// Its length.
        given: usize,
        /// The length that the camera asks for.
        wanted: usize,
    },
    /// Normals without the depth that they are computed of.
    #[error("view {view}: normals are computed of depth: give depth_m a buffer, too")]
    Normals {
        /// Which view.
        view: usize,
    },
    /// An overlay is not of its view's size.
    #[error("view {view}: the overlay is {given:?} pixels, and the image {wanted:?}")]
    Overlay {
        /// Which view.
        view: usize,
        /// Width and height of the overlay.
        given: [u32; 2],
        /// Width and height of the image.
        wanted: [u32; 2],
    },
    /// Not one target for each view.
    #[error("{targets} targets for {views} views; each view needs its own")]
    Targets {
        /// How many targets were given.
        targets: usize,
        /// How many views.
        views: usize,
    },
    /// More than a frame may hold.
    #[error("the frame needs more than {limit} {what}: ask for smaller images or fewer views")]
    TooMany {
        /// What there is too much of.
        what: &'static str,
        /// How many fit.
        limit: u64,
    },
    /// The scene alone is more than the device may hold.
    #[error(
        "the scene takes at least {needed_bytes} bytes of the GPU's memory and {limit_bytes} are \
         allowed: allow more with --gpu-memory-gib, or draw less with the profile's tau_px and reach_m"
    )]
    DeviceMemory {
        /// What its Gaussians take, without the ends of pages that no cluster fits into.
        needed_bytes: u64,
        /// What they may take.
        limit_bytes: u64,
    },
    /// The sky cannot be drawn as the profile asks.
    #[error(transparent)]
    Sky(#[from] SkyError),
    /// The device failed. It is opened anew for the next frame.
    #[error("{device} failed: {reason}")]
    Device {
        /// Its name.
        device: String,
        /// The driver's words.
        reason: String,
    },
}

/// Something that renders frames.
pub trait Backend: Send + Sync {
    /// The name, as `--backend` and observations spell it.
    fn name(&self) -> &'static str;

    /// What else the last bit of a pixel depends on, as `Avx512`; nothing for most.
    fn detail(&self) -> String {
        String::new()
    }

    /// Threads that it renders with. Pixels do not depend on it.
    fn threads(&self) -> usize {
        1
    }

    /// Frames that it has in hand at once: as many callers of [`Backend::render`] get on faster
    /// than one, and more do not. A backend that uses the whole machine for a frame says 1.
    fn frames_in_flight(&self) -> usize {
        1
    }

    /// Renders all views into their targets, `targets[i]` for `views[i]`.
    ///
    /// # Errors
    /// See [`RenderError`]; the same frame fails or succeeds the same way every time.
    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError>;
}

impl Frame<'_> {
    /// What is behind the Gaussians, and what takes directions in the world to its axes: the sky, or the
    /// profile's background as a sky of one colour; `None` if that is black.
    ///
    /// # Errors
    /// [`RenderError::Sky`].
    pub fn background(&self) -> Result<Option<(DrawableSky, DMat3)>, RenderError> {
        match &self.scene.sky {
            Some(sky) => Ok(Some((sky.drawable(self.profile.sky_error)?, sky.sky_from_world()))),
            None if self.profile.background == [0.0; 3] => Ok(None),
            None => {
                let map = CubeMap::uniform(DVec3::from_array(self.profile.background));
                Ok(Some((DrawableSky::CubeMap(Arc::new(map)), DMat3::IDENTITY)))
            }
        }
    }

    /// # Errors
    /// Names the first view whose target does not fit.
    pub fn check(&self, targets: &[Target<'_>]) -> Result<(), RenderError> {
        self.check_views()?;
        let count = self.views.len();
        if targets.len() != count {
            return Err(RenderError::Targets { targets: targets.len(), views: count });
        }
        for (view, (target, View { camera, .. })) in targets.iter().zip(self.views).enumerate() {
            let pixels = camera.pixels();
            let lengths = [
                ("rgba", target.rgba.as_ref().map(|b| b.len()), 4 * pixels),
                ("rgb8", target.rgb8.as_ref().map(|b| b.len()), 3 * pixels),
                ("depth_m", target.depth_m.as_ref().map(|b| b.len()), pixels),
                ("opacity", target.opacity.as_ref().map(|b| b.len()), pixels),
                ("normals", target.normals.as_ref().map(|b| b.len()), 3 * pixels),
            ];
            if target.normals.is_some() && target.depth_m.is_none() {
                return Err(RenderError::Normals { view });
            }
            if let Some(overlay) = target.appearance.and_then(|seen| seen.overlay.as_ref()) {
                let wanted = [camera.width_px, camera.height_px];
                if overlay.size_px() != wanted {
                    return Err(RenderError::Overlay { view, given: overlay.size_px(), wanted });
                }
            }
            for (buffer, given, wanted) in lengths {
                if let Some(given) = given.filter(|&given| given != wanted) {
                    return Err(RenderError::TargetSize { view, buffer, given, wanted });
                }
            }
        }
        Ok(())
    }

    /// # Errors
    /// The profile asks for rays that no splats are drawn for.
    pub fn check_splats(&self, backend: &'static str) -> Result<(), RenderError> {
        match self.profile.rays {
            Rays::Splats => Ok(()),
            Rays::Exact => Err(RenderError::ExactRays { backend }),
        }
    }

    /// # Errors
    /// No view, or too many.
    pub fn check_views(&self) -> Result<(), RenderError> {
        let count = self.views.len();
        match (1..=MAX_VIEWS).contains(&count) {
            true => Ok(()),
            false => Err(RenderError::Views { count }),
        }
    }
}
