//! Gradients of images: the derivatives of a loss by every parameter that an image depends on.
//!
//! # What is differentiated
//!
//! The images of the Gaussians alone: colour on black, opacity, and the sum of depths weighted as
//! the colours are ([`GaussianImages`]). A loss is a function of them, and background, sky,
//! exposure and expected depth are functions of them, too (`wildcity-train` has these, with their
//! derivatives), so no backend knows them.
//!
//! Pixels have one sample, as with the profile's `shrink=filter`, whatever it says.
//!
//! The parameters are those of [`GaussianGradient`], and a twist of each view ([`Twist`]), which
//! [`Twist::on_rig`] takes to the poses of a rig.
//!
//! # Formulas
//!
//! `v_x` is the derivative of the loss by x. A pixel blends its splats i = 1, 2, ... from front to
//! back, with `w_i = alpha_i T_i` and `T_(i+1) = (1 - alpha_i) T_i` (Kerbl et al. 2023, eq. 3):
//!
//! ```text
//! e_i = rgb_i · v_rgb + depth_i v_depth
//! v_alpha_i = T_i e_i - (sum over j > i of w_j e_j - T_end v_opacity)/(1 - alpha_i)
//! ```
//!
//! One sum per pixel takes the place of the colours behind each splat. It is known in front of the
//! first splat from the image itself, so that splats are walked **from front to back, as they are
//! drawn**: going from back to front would divide the transmittance by `1 - alpha` again and again.
//!
//! A splat's alpha is `2^(log2 opacity - |F d|²)` with the factor F of its inverse covariance
//! ([`Splat::factor`](crate::layout::Splat)) and `d` from its centre to the pixel. With `w = F d`
//! and `g = v_alpha alpha`, the sums of `g`, `g w` and `g w wᵀ` over its pixels are all that its
//! shape needs:
//!
//! ```text
//! v_mean = 2 ln2 Fᵀ Σ g w        v_covariance = 2 ln2² Fᵀ (Σ g w wᵀ) F
//! ```
//!
//! without the inverse of anything, so that needles lose nothing.
//!
//! # At steps
//!
//! Order, near and far, the cut, the cap and the stop are steps. Their derivatives are those of
//! gsplat: none. A splat at the cap passes nothing on to its shape and opacity, but its colour
//! counts; one below the cut or after the stop has no derivative. A colour that is clamped at 0 has
//! none, nor has the opacity's scale by `antialiased` at its floor. A slope that is clamped beyond
//! the image's edges has no derivative of its own. With a rolling shutter, a point whose image
//! moves nearly as fast as the readout has none by its moment.

mod color;
mod shape;
mod sums;
mod twist;

use std::borrow::Cow;
use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use wildcity_scene::chunk::{LANES, Lanes, column, columns};
use wildcity_scene::geometry::camera::FieldMask;
use wildcity_scene::{Chunk, Scene};

pub(crate) use self::color::color_gradient;
pub(crate) use self::shape::FootprintGradient;
pub(crate) use self::sums::{Partial, partial};
pub use self::twist::{RigTwists, Twist};

use crate::{Backend, Frame, FrameStats, RenderError, View};

/// The images of a view that a loss is a function of, or its derivatives by each of their values:
/// row by row from the top.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianImages {
    /// `[height, width, 3]`: linear red, green and blue of the Gaussians, premultiplied, on black.
    pub rgb: Vec<f32>,
    /// `[height, width]`: accumulated opacity of the Gaussians.
    pub opacity: Vec<f32>,
    /// `[height, width]`: sum of depths weighted by contribution, in metres. Divided by the opacity
    /// it is the expected depth. Empty if depth is not asked for.
    pub depth_sum_m: Vec<f32>,
}

/// Computes the derivatives of a loss by the images of all views, given these. Both are in the
/// order of the views; derivatives by depth may be empty, and those outside of a lens' field are
/// not read. It must not call the backend, which waits for it.
pub type LossGradient<'a> = &'a mut (dyn FnMut(&[GaussianImages]) -> Vec<GaussianImages> + Send);

/// The derivatives of a loss by the parameters of one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GaussianGradient {
    /// Per metre, in the axes of the world, or of its actor.
    pub mean_m: [f64; 3],
    /// By the unit quaternion (w, x, y, z), tangential to it. Divided by the length of a quaternion
    /// that is normalised, it is the derivative by that.
    pub quat_wxyz: [f64; 4],
    /// By the natural logarithms of the standard deviations.
    pub ln_scale: [f64; 3],
    /// By the base-2 logarithm of the peak opacity. Times `(1 - opacity)/ln 2` it is that by the
    /// logit.
    pub log2_opacity: f64,
}

/// The derivatives of a loss by all Gaussians of a scene, and by the poses of all views.
#[derive(Clone, Debug, Default)]
pub struct Gradients {
    /// By chunk: those of the twin, then those that are placed as actors.
    pub chunks: Vec<ChunkGradients>,
    pub twists: Vec<Twist>,
}

/// The derivatives of a loss by the Gaussians of one chunk, in the columns of [`Chunk`]
/// ([`mod@column`]): by the mean, by the **logarithm** of the scales, by the unit quaternion
/// tangentially, by the base-2 logarithm of the opacity, and by the spherical harmonics.
#[derive(Clone, Debug)]
pub struct ChunkGradients {
    sh_degree: u8,
    count: usize,
    pub(crate) lanes: Vec<Lanes>,
    /// For each lane group, a bit for each Gaussian that some view shows. Only these groups'
    /// columns are written.
    pub(crate) visible: Vec<u16>,
}

/// Why gradients were not computed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GradientError {
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The frame does not fit the memory of one pass.
    #[error(
        "gradients need all of a frame at once, and this one exceeds a limit of {limit_bytes} bytes: \
         use smaller images, fewer views or fewer Gaussians"
    )]
    Memory { limit_bytes: u64 },
    /// A loss that has the wrong size.
    #[error("view {view}: {given} derivatives by {image}; the image has {wanted} values")]
    Size { view: usize, image: &'static str, given: usize, wanted: usize },
    /// A derivative that is NaN or infinite.
    #[error("view {view}: the derivative by value {index} of {image} is {value:?}")]
    NotFinite { view: usize, image: &'static str, index: usize, value: f32 },
    /// Another number of derivatives than of views.
    #[error("the loss has derivatives for {given} views of {wanted}")]
    Views { given: usize, wanted: usize },
    /// The twin is shadowed by an actor, which is not differentiated.
    #[error("contact shadows have no derivatives: place the actors without shadows")]
    Shadows,
    /// Views draw different chunks, as those of a twin in levels of detail do.
    #[error("each view of the frame draws other chunks: differentiate at full detail")]
    Levels,
}

/// A backend that computes gradients, too. What a frame needs for them is allocated by this call
/// alone.
pub trait Differentiate: Backend {
    /// Renders the images of all views, asks `loss` for its derivatives by them, and computes those
    /// by all parameters. `gradients` is overwritten, and its memory used again.
    ///
    /// Depths are rendered if `depth` is set.
    ///
    /// # Errors
    /// The frame does not fit the memory, or is not differentiated; or the loss gave derivatives of
    /// another size, or some that are not finite.
    fn differentiate(
        &self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
    ) -> Result<FrameStats, GradientError>;
}

impl Gradients {
    /// Makes it fit a scene and a number of views; no Gaussian is visible.
    pub(crate) fn reset(&mut self, scene: &Scene, views: usize) {
        let chunks = chunks(scene);
        self.chunks.truncate(chunks.len());
        for (index, chunk) in chunks.into_iter().enumerate() {
            match self.chunks.get_mut(index) {
                Some(kept) => kept.reset(chunk),
                None => self.chunks.push(ChunkGradients::new(chunk)),
            }
        }
        self.twists.clear();
        self.twists.resize(views, Twist::default());
    }
}

/// The chunks of a scene in the order of [`Gradients::chunks`].
pub(crate) fn chunks(scene: &Scene) -> Vec<&Arc<Chunk>> {
    scene.chunks.iter().chain(scene.placed.iter().map(|placed| &placed.chunk)).collect()
}

impl ChunkGradients {
    fn new(chunk: &Chunk) -> Self {
        let mut gradients = Self { sh_degree: 0, count: 0, lanes: Vec::new(), visible: Vec::new() };
        gradients.reset(chunk);
        gradients
    }

    fn reset(&mut self, chunk: &Chunk) {
        let groups = chunk.len().div_ceil(LANES);
        self.sh_degree = chunk.sh_degree();
        self.count = chunk.len();
        // Columns of groups without a visible Gaussian are never read: they keep any value.
        self.lanes.resize(groups * columns(self.sh_degree), Lanes([0.0; LANES]));
        self.visible.clear();
        self.visible.resize(groups, 0);
    }

    /// The degree of its spherical harmonics.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Number of Gaussians, visible or not.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether the chunk has no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Whether some view shows a Gaussian.
    pub fn visible(&self, index: usize) -> bool {
        self.visible[index / LANES] >> (index % LANES) & 1 == 1
    }

    /// Adds the derivatives by a Gaussian that one more view shows, or by one more loss.
    pub fn add(&mut self, index: usize, geometry: &GaussianGradient, sh: &[DVec3; 16]) {
        let width = columns(self.sh_degree);
        let visible = &mut self.visible[index / LANES];
        let lanes = &mut self.lanes[index / LANES * width..][..width];
        if *visible == 0 {
            // The columns of a group hold any value until one of its Gaussians is visible.
            lanes.fill(Lanes([0.0; LANES]));
        }
        *visible |= 1 << (index % LANES);
        let GaussianGradient { mean_m, quat_wxyz, ln_scale, log2_opacity } = geometry;
        // In the order of the columns.
        let values = mean_m.iter().chain(ln_scale).chain(quat_wxyz).chain([log2_opacity]);
        let colors = sh.iter().flat_map(|coefficient| coefficient.to_array());
        for (column, value) in lanes.iter_mut().zip(values.copied().chain(colors)) {
            column.0[index % LANES] += value as f32;
        }
    }

    /// The columns of a lane group, if some view shows a Gaussian of it, and a bit for each of
    /// these. Those of its other Gaussians are 0.
    pub fn lane_group(&self, group: usize) -> Option<(&[Lanes], u16)> {
        let visible = self.visible[group];
        let width = columns(self.sh_degree);
        (visible != 0).then(|| (&self.lanes[group * width..(group + 1) * width], visible))
    }

    /// The derivative by one parameter of one Gaussian; 0 if no view shows it.
    pub fn value(&self, index: usize, column: usize) -> f32 {
        match self.lane_group(index / LANES) {
            Some((lanes, _)) => lanes[column].0[index % LANES],
            None => 0.0,
        }
    }

    /// The derivatives by one Gaussian, except those by its colour.
    pub fn gaussian(&self, index: usize) -> GaussianGradient {
        let value = |column| f64::from(self.value(index, column));
        let three = |first| [0, 1, 2].map(|axis| value(first + axis));
        GaussianGradient {
            mean_m: three(column::MEAN),
            quat_wxyz: [0, 1, 2, 3].map(|k| value(column::QUAT + k)),
            ln_scale: three(column::SCALE),
            log2_opacity: value(column::LOG2_OPACITY),
        }
    }
}

impl GaussianImages {
    /// The images with their names, and the number of values of each for `pixels` pixels.
    fn named(&self, pixels: usize) -> [(&'static str, &[f32], usize); 3] {
        [
            ("rgb", &self.rgb, 3 * pixels),
            ("opacity", &self.opacity, pixels),
            ("depth_sum_m", &self.depth_sum_m, pixels),
        ]
    }
}

/// Checks a frame before it is rendered for its gradients.
pub(crate) fn check_frame(frame: &Frame<'_>, backend: &'static str) -> Result<(), GradientError> {
    frame.check_views()?;
    frame.check_splats(backend)?;
    if frame.scene.placed.iter().any(|placed| placed.shadow.is_some()) {
        return Err(GradientError::Shadows);
    }
    // A view with a selection of its own sees a scene that is made for it.
    let has_own = |view| matches!(frame.scene.for_view(view), Cow::Owned(_));
    if (0..frame.views.len()).any(has_own) {
        return Err(GradientError::Levels);
    }
    Ok(())
}

/// Zeroes the pixels outside of the lens' field: of images, as every backend does, and so of the
/// derivatives by them. A pinhole has none.
pub(crate) fn mask(view: &View, images: &mut GaussianImages) {
    let Some(field) = FieldMask::from_camera(&view.camera) else { return };
    field.clear_outside(&view.camera, 3, &mut images.rgb);
    field.clear_outside(&view.camera, 1, &mut images.opacity);
    field.clear_outside(&view.camera, 1, &mut images.depth_sum_m);
}

/// Checks the sizes of the derivatives that a loss gave, and zeroes those outside of each lens'
/// field, which no pixel has.
pub(crate) fn check_sizes(
    frame: &Frame<'_>,
    depth: bool,
    derivatives: &mut [GaussianImages],
) -> Result<(), GradientError> {
    let wanted = frame.views.len();
    if derivatives.len() != wanted {
        return Err(GradientError::Views { given: derivatives.len(), wanted });
    }
    for (view, (images, of_view)) in derivatives.iter_mut().zip(frame.views).enumerate() {
        for (image, values, wanted) in images.named(of_view.camera.pixels()) {
            let is_left_out = image == "depth_sum_m" && values.is_empty();
            let wanted = if image == "depth_sum_m" && !depth { 0 } else { wanted };
            if values.len() != wanted && !is_left_out {
                return Err(GradientError::Size { view, image, given: values.len(), wanted });
            }
        }
        mask(of_view, images);
    }
    Ok(())
}

/// Checks that the derivatives by the images of a view are finite.
pub(crate) fn check_finite(view: usize, images: &GaussianImages) -> Result<(), GradientError> {
    for (image, values, _) in images.named(0) {
        // Sums of parts: one that is finite has no value that is not. (0 x is NaN for those.)
        let is_finite = |part: &[f32]| part.iter().map(|value| 0.0 * value).sum::<f32>() == 0.0;
        if !values.par_chunks(1 << 14).all(is_finite)
            && let Some(index) = values.iter().position(|value| !value.is_finite())
        {
            return Err(GradientError::NotFinite { view, image, index, value: values[index] });
        }
    }
    Ok(())
}
