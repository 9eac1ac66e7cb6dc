//! Training: Gaussians that look like recorded images.
//!
//! | module | what it is |
//! |---|---|
//! | [`check`] | the gradients of this machine against their definition |
//! | [`loss`] | losses of images, depths and Gaussians, each with its derivatives |
//! | [`run`] | a run: from images to Gaussians |
//! | [`start`] | from points to the Gaussians that it begins with |
//! | [`trainer`] | a step: what one image teaches |
//! | [`model`] | the Gaussians of a run, and Adam |
//! | [`settings`] | the settings of a run |
//! | `growth` | relocation and growth by Markov chain Monte Carlo |
//! | [`compose`] | from the Gaussians' images to the camera's: background or sky, and exposure |
//!
//! The renderer differentiates the images of the Gaussians ([`wildcity_render::gradient`]); all
//! that lies between these and a number is here. Every function is written for f32 and f64:
//! training computes in f32, and tests judge the same code in f64 by differences.

pub mod check;
pub mod compose;
mod growth;
pub mod loss;
pub mod model;
pub mod run;
pub mod settings;
pub mod start;
pub mod trainer;
