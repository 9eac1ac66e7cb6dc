//! The renderer: images of all cameras of one step, by one of several backends that compute the
//! same images.
//!
//! | backend | arithmetic | purpose |
//! |---|---|---|
//! | [`reference`](mod@reference) | f64, every pixel against every Gaussian, camera differentiated numerically | the definition that the others are compared with |
//! | [`cpu`] | f32, SIMD, all cores | the default without a GPU |
//! | [`gpu`] | f32, WGSL compute shaders, one per stage | the fastest |
//!
//! The stages project, sort, bin, rasterize and resolve have the same names in the cpu and the gpu
//! backend. Three combinations exist: [`automatic`] chooses a backend, [`hybrid`] runs the first
//! stages on the cpu and the rest on the gpu, and [`several`] draws on several devices. [`compare`]
//! measures how far images differ.
//!
//! An image is a function of (scene, render profile, views). It depends on no clock, no cache and
//! no number of threads.

mod actor_views;
#[cfg(feature = "gpu")]
pub mod automatic;
pub mod compare;
pub mod constants;
pub mod cpu;
pub mod expansion;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod gradient;
#[cfg(feature = "gpu")]
pub mod hybrid;
pub mod layout;
pub mod lidar;
pub mod limits;
mod normals;
pub mod reference;
mod samples;
pub mod several;
pub mod stage;
pub mod unscented;
pub mod view;

use std::sync::Arc;

use glam::{DMat3, DVec3};

use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::appearance::Appearance;
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::geometry::{Camera, Lidar};
use wildcity_scene::sky::{CubeMap, DrawableSky, SkyError};
use wildcity_scene::{Chunk, Rays, RenderProfile, Rig, Scene, Selection, SemanticClass};

use crate::gradient::Differentiate;
use crate::lidar::{LidarView, Sweep, Task};

pub use samples::sample_count;
pub use view::{RollingShutter, View};

/// The input of a render call: all views of one step.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    pub scene: &'a Scene,
    /// The accuracy and the thresholds.
    pub profile: &'a RenderProfile,
    /// The cameras: 1 to [`MAX_VIEWS`].
    pub views: &'a [View],
}

/// The twin in [`Target::instances`].
pub const TWIN_INSTANCE: u16 = 1;

/// Actor 0 in [`Target::instances`].
pub const FIRST_ACTOR_INSTANCE: u16 = 2;

/// Most views of one frame: the cameras of the largest rig.
pub const MAX_VIEWS: usize = Rig::MAX_CAMERAS;

/// Buffers for the images of one view, row by row from the top; an image that is `None` is not
/// computed. A backend writes every value of each buffer that it is given, whatever it held before.
/// Pixels outside of the lens' field are 0 in all of them.
#[derive(Debug, Default)]
pub struct Target<'a> {
    /// `[height, width, 4]`: linear red, green and blue of the Gaussians (premultiplied) over the
    /// sky or the background; and the opacity of the Gaussians only.
    pub rgba: Option<&'a mut [f32]>,
    /// `[height, width, 3]`: the same colours, clamped to [0, 1] and rounded to 8 bits.
    pub rgb8: Option<&'a mut [u8]>,
    /// `[height, width]`: expected depth ([`Camera::depth_m`]: z, or the distance for a lens that
    /// may see 90° and more) in metres, 0 where opacity is 0.
    pub depth_m: Option<&'a mut [f32]>,
    /// `[height, width]`: accumulated opacity, a measure of the validity of the depth.
    pub opacity: Option<&'a mut [f32]>,
    /// `[height, width, 3]`: unit normals of the surfaces of `depth_m`, which is then required,
    /// too. They are in the camera's axes and point towards the camera; 0 where there is no depth.
    pub normals: Option<&'a mut [f32]>,
    /// `[height, width]`: owner of the Gaussian that brings the transmittance to a half or less: 0
    /// none, [`TWIN_INSTANCE`] the twin, and `k` + [`FIRST_ACTOR_INSTANCE`] actor `k`.
    pub instances: Option<&'a mut [u16]>,
    /// `[height, width]`: the class ([`SemanticClass`]) of the Gaussian that `instances` is the
    /// owner of; [`SemanticClass::None`], which is 0, where there is none. A Gaussian of an actor
    /// without a class of its own has that of the actor ([`PlacedChunk::class`]).
    pub semantics: Option<&'a mut [u8]>,
    /// The camera's exposure and overlay, applied to `rgba` and `rgb8`.
    pub appearance: Option<&'a Appearance>,
}

impl Target<'_> {
    /// The last step of every backend: masks pixels outside of the lens' field, and computes
    /// normals.
    fn finish(&mut self, view: &View) {
        self.mask(&view.camera);
        // After the mask: pixels outside of the field have depth 0, and so no normal.
        if let (Some(depth_m), Some(normals)) = (&self.depth_m, &mut self.normals) {
            normals::write(view, depth_m, normals);
        }
    }

    /// Zeroes the pixels outside of the lens' field. A pinhole has none.
    fn mask(&mut self, camera: &Camera) {
        // The pixels outside may hold colours: no bound on splats keeps them empty.
        let Some(field) = FieldMask::from_camera(camera) else { return };
        if let Some(rgb8) = &mut self.rgb8 {
            field.clear_outside(camera, 3, rgb8);
        }
        if let Some(instances) = &mut self.instances {
            field.clear_outside(camera, 1, instances);
        }
        if let Some(semantics) = &mut self.semantics {
            field.clear_outside(camera, 1, semantics);
        }
        // Normals are missing here: they are computed from masked depths.
        for (values, image) in [(4, &mut self.rgba), (1, &mut self.depth_m), (1, &mut self.opacity)]
        {
            if let Some(image) = image {
                field.clear_outside(camera, values, image);
            }
        }
    }
}

/// The class of a Gaussian of a chunk, given the class of those that have none.
pub(crate) fn gaussian_class(chunk: &Chunk, index: usize, default: SemanticClass) -> SemanticClass {
    chunk.classes().map_or(default, |classes| classes[index].or(default))
}

/// Called once per view from a worker thread, with the view's index, as soon as its pixels are
/// final: one image can be encoded while others are still drawn.
pub type OnViewDone<'a> = &'a (dyn Fn(usize, &Target<'_>) + Sync);

/// Time and work of a frame.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct FrameStats {
    /// Wall time of each stage, in milliseconds, in the order of the stages.
    pub stages_ms: Vec<(&'static str, f64)>,
    /// Number of (Gaussian, view) pairs after culling: splats.
    pub visible_pairs: u64,
    /// Number of (Gaussian, tile) pairs after binning.
    pub instances: u64,
    /// Number of Gaussian-pixel evaluations of the rasterizer, with those of idle lanes.
    pub evaluations: u64,
    /// Largest size of the intermediate buffers in the machine's memory, in bytes. 0 if the backend
    /// does not count it.
    pub held_bytes: u64,
}

/// Why a frame was not rendered. Its targets may have been written in part.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// No view, or more than the sort key has bits for.
    #[error("a frame has 1 to {MAX_VIEWS} views, not {count}")]
    Views { count: usize },
    /// The profile asks for exact rays, and the backend draws only splats.
    #[error(
        "the {backend} backend draws splats, and the profile asks for rays=exact: use the reference \
         backend, or rays=splats"
    )]
    ExactRays { backend: &'static str },
    /// A target's buffer does not have its view's size.
    #[error(
        "view {view}: buffer {buffer} holds {given} values; the camera's size asks for {wanted}"
    )]
    TargetSize {
        view: usize,
        /// The field of [`Target`].
        buffer: &'static str,
        given: usize,
        /// The length that the camera's size requires.
        wanted: usize,
    },
    /// Normals are requested without depth.
    #[error("view {view}: normals are computed from depth: give depth_m a buffer, too")]
    Normals { view: usize },
    /// An overlay does not have its view's size.
    #[error("view {view}: the overlay is {given:?} pixels, and the image {wanted:?}")]
    Overlay {
        view: usize,
        /// Width and height of the overlay.
        given: [u32; 2],
        /// Width and height of the image.
        wanted: [u32; 2],
    },
    /// The number of targets differs from the number of views.
    #[error("{targets} targets for {views} views; each view needs its own")]
    Targets { targets: usize, views: usize },
    /// The frame exceeds a limit of the backend.
    #[error("the frame needs more than {limit} {what}: ask for smaller images or fewer views")]
    TooMany {
        /// The kind of item that is limited.
        what: &'static str,
        /// The largest number that fits.
        limit: u64,
    },
    /// The scene by itself exceeds the memory that the device may use.
    #[error(
        "the scene takes at least {needed_bytes} bytes of the GPU's memory and {limit_bytes} are \
         allowed: allow more with --gpu-memory-gib, or draw less with the profile's tau_px and reach_m"
    )]
    DeviceMemory {
        /// Memory of its Gaussians, without the unused ends of pages.
        needed_bytes: u64,
        /// Largest memory that they may take.
        limit_bytes: u64,
    },
    /// The sky cannot be drawn as the profile asks.
    #[error(transparent)]
    Sky(#[from] SkyError),
    /// The scene has sections for other views.
    #[error(
        "the sections of the scene were chosen for {selected_for} views, and the frame has {views}"
    )]
    Selection {
        /// Number of views of the frame.
        views: usize,
        /// Number of views of the scene's selection.
        selected_for: usize,
    },
    /// More actors in a view than
    /// [`PlacedChunk::MAX_ACTORS`](wildcity_scene::actor::PlacedChunk::MAX_ACTORS).
    #[error("{placed} chunks of actors are placed; at most {limit} are drawn: remove actors")]
    Actors {
        placed: usize,
        /// The largest number that is drawn.
        limit: usize,
    },
    /// The device failed. The next frame opens it again.
    #[error("{device} failed: {reason}")]
    Device {
        device: String,
        /// The driver's error message.
        reason: String,
    },
}

/// A renderer of frames.
pub trait Backend: Send + Sync {
    /// The name, as in `--backend` and in observations.
    fn name(&self) -> &'static str;

    /// The instruction set or the device, on which the last bit of a pixel may depend. May be
    /// empty.
    fn detail(&self) -> String {
        String::new()
    }

    /// The devices that it draws on, if there are several: each draws frames beside the others,
    /// with the same pixels, and has a memory of its own.
    fn devices(&self) -> Vec<Arc<dyn Backend>> {
        Vec::new()
    }

    /// Number of threads that it renders with. Pixels do not depend on it.
    fn threads(&self) -> usize {
        1
    }

    /// Number of frames that it processes at once: up to this number, more concurrent callers of
    /// [`Backend::render`] increase the throughput. It is 1 for a backend that uses the whole
    /// machine for one frame.
    fn frames_in_flight(&self) -> usize {
        1
    }

    /// Whether it can draw exact rays, which a profile may ask for.
    fn draws_exact_rays(&self) -> bool {
        false
    }

    /// Whether a small frame that is rendered while a large one is gets its share of the machine at
    /// once, so that it need not wait for the large one, even if [`Backend::frames_in_flight`] is
    /// 1.
    fn renders_beside(&self) -> bool {
        false
    }

    /// Whether the processor's cores are idle while it renders, so that several threads encode an
    /// image in parallel.
    fn has_idle_cores(&self) -> bool {
        false
    }

    /// This backend, if it computes gradients, too.
    fn as_differentiate(&self) -> Option<&dyn Differentiate> {
        None
    }

    /// Limits the intermediate buffers between the stages of a frame, in bytes. With less memory a
    /// frame is drawn in more parts, one after the other; its images do not depend on the limit.
    fn limit_frame_bytes(&self, _bytes: u64) {}

    /// Upper bound of its intermediate buffers in the machine's memory for a frame of these views
    /// with a profile, whatever the scene, in bytes.
    fn frame_bytes(&self, _views: &[View], _profile: &RenderProfile) -> u64 {
        0
    }

    /// As [`Backend::frame_bytes`], for a small frame that is rendered while a large one is.
    fn bytes_beside(&self, _views: &[View], _profile: &RenderProfile) -> u64 {
        0
    }

    /// Renders all views into their targets, `targets[i]` for `views[i]`, and calls `on_view_done`
    /// for each.
    ///
    /// # Errors
    /// See [`RenderError`]. Except for a failing device, the same frame gives the same result every
    /// time.
    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        on_view_done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError>;

    /// The sweep of a LiDAR: of all chunks of the scene, and of actors as
    /// [`PlacedChunk`] has them at the start and at the end of the sweep. Backends that have no
    /// kernel of their own compute it as [`cpu`] does.
    ///
    /// # Errors
    /// The same as those of [`Backend::render`].
    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        Ok(cpu::lidar::best_sweep(&Task::new(scene, profile, view)?))
    }

    /// Upper bound of the intermediate buffers of a sweep, whatever the scene, in bytes.
    fn sweep_bytes(&self, lidar: &Lidar) -> u64 {
        cpu::lidar::most_bytes(lidar, rayon::current_num_threads())
    }
}

impl Frame<'_> {
    /// The background, and the matrix `sky_from_world` that takes directions to its axes: the sky,
    /// or the profile's background as a sky of one colour; `None` if that is black.
    ///
    /// # Errors
    /// [`RenderError::Sky`].
    pub fn background(&self) -> Result<Option<(DrawableSky, DMat3)>, RenderError> {
        // A sky of the scene takes precedence over the profile's colour.
        match &self.scene.sky {
            Some(sky) => Ok(Some((sky.drawable(self.profile.sky_error)?, sky.sky_from_world()))),
            None if self.profile.background == [0.0; 3] => Ok(None),
            None => {
                // One colour as a cube map, so that backends have one way to add a background.
                let map = CubeMap::uniform(DVec3::from_array(self.profile.background));
                Ok(Some((DrawableSky::CubeMap(Arc::new(map)), DMat3::IDENTITY)))
            }
        }
    }

    /// Checks the number of views, and that each target fits its view.
    ///
    /// # Errors
    /// Names the first view with a target that does not fit.
    pub fn check(&self, targets: &[Target<'_>]) -> Result<(), RenderError> {
        self.check_views()?;
        let count = self.views.len();
        if targets.len() != count {
            return Err(RenderError::Targets { targets: targets.len(), views: count });
        }
        // In the order of views, and within one in the order of the fields: the first error is the
        // same every time.
        for (view, (target, View { camera, .. })) in targets.iter().zip(self.views).enumerate() {
            let pixels = camera.pixels();
            let lengths = [
                ("rgba", target.rgba.as_ref().map(|b| b.len()), 4 * pixels),
                ("rgb8", target.rgb8.as_ref().map(|b| b.len()), 3 * pixels),
                ("depth_m", target.depth_m.as_ref().map(|b| b.len()), pixels),
                ("opacity", target.opacity.as_ref().map(|b| b.len()), pixels),
                ("normals", target.normals.as_ref().map(|b| b.len()), 3 * pixels),
                ("instances", target.instances.as_ref().map(|b| b.len()), pixels),
                ("semantics", target.semantics.as_ref().map(|b| b.len()), pixels),
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

    /// Checks that the profile asks for splats.
    ///
    /// # Errors
    /// [`RenderError::ExactRays`].
    pub fn check_splats(&self, backend: &'static str) -> Result<(), RenderError> {
        match self.profile.rays {
            Rays::Splats => Ok(()),
            Rays::Exact => Err(RenderError::ExactRays { backend }),
        }
    }

    /// Checks the number of views, also against the scene's selection, and that of placed chunks.
    ///
    /// # Errors
    /// [`RenderError::Views`], [`RenderError::Selection`], [`RenderError::Actors`].
    pub fn check_views(&self) -> Result<(), RenderError> {
        // At most 16: the sort key has 4 bits for the view.
        let views = self.views.len();
        if !(1..=MAX_VIEWS).contains(&views) {
            return Err(RenderError::Views { count: views });
        }
        let Scene { chunks, selection, placed, .. } = self.scene;
        if let Some(Selection { views: selected_for, by_chunk }) = selection
            && (*selected_for, by_chunk.len()) != (views, chunks.len())
        {
            return Err(RenderError::Selection { views, selected_for: *selected_for });
        }
        let in_view = |view| placed.iter().filter(|placed| placed.views.contains(view)).count();
        let limit = PlacedChunk::MAX_ACTORS;
        match (0..views).map(in_view).find(|&placed| placed > limit) {
            Some(placed) => Err(RenderError::Actors { placed, limit }),
            None => Ok(()),
        }
    }
}
