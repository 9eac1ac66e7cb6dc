//! Gradients of the gpu backend: the stages once more, backwards.
//!
//! | step | what it does |
//! |---|---|
//! | project to rasterize | as for an image of the Gaussians alone |
//! | loss | the caller's, on the host |
//! | blend backwards | tile by tile: ten sums for each of its splats (`rasterize_gradient.wgsl`) |
//! | gather | the sums of a splat's tiles (`gather.wgsl`) |
//! | project backwards | from splats to Gaussians (`project_gradient.wgsl`), view by view |
//!
//! The third and fourth step alternate: one run of macro tiles after the other ([`macro_runs`]).
//! Views of other cameras than static pinholes are projected backwards on the host, in f64, as the
//! cpu backend does it ([`lens`]): a lens has no derivatives in WGSL.
//!
//! **The same input gives the same bytes** on one device: every sum has its place and its order,
//! and nothing is added atomically.
//!
//! Beside the buffers of the frame there are at most 116 B for each splat (but 10 MiB, or the
//! touches of one macro tile with the instances of one of its tiles, may always be summed), 25 B
//! for each pixel, and 1.25 KiB for each column of each visible cluster, which the host reads from
//! as much again; and for lenses, another 90 B for each splat. All include the quarter that buffers
//! grow beyond their need. A frame must fit the device at once.
//!
//! Images and derivatives are those of the Gaussians of the mirror, whose colours are rounded to 16
//! bits of the cluster's largest and whose rotations to 20.

mod clusters;
mod lens;
mod macro_runs;
mod pixels;
mod stages;

pub(super) use self::clusters::GradientClusters;
pub(super) use self::lens::{HostSplats, back_project};
pub(super) use self::macro_runs::MacroRuns;
pub(super) use self::pixels::{images, pack};
pub(super) use self::stages::{BackwardInputs, GradientStages};

use super::Gpu;
use crate::gradient::{Differentiate, GradientError, Gradients, LossGradient, check_frame};
use crate::{Backend, Frame, FrameStats};
use wildcity_scene::{RenderProfile, Scene};

impl Differentiate for Gpu {
    fn differentiate(
        &self,
        frame: &Frame<'_>,
        depth: bool,
        loss: LossGradient<'_>,
        gradients: &mut Gradients,
    ) -> Result<FrameStats, GradientError> {
        check_frame(frame, self.name())?;
        // The images of the Gaussians alone.
        let scene = Scene { sky: None, ..frame.scene.clone() };
        let profile = RenderProfile { background: [0.0; 3], ..*frame.profile };
        let frame = Frame { scene: &scene, profile: &profile, views: frame.views };
        self.in_turn(|chain| {
            match chain.differentiate(&frame, depth, loss, gradients, &self.cull) {
                // An error of the device must reach the turn, which then opens the device again.
                Err(GradientError::Render(error)) => Err(error),
                done => Ok(done),
            }
        })?
    }
}
