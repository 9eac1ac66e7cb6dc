//! Training: Gaussians that look like recorded images.
//!
//! | module | what it is |
//! |---|---|
//! | [`check`] | the gradients of this machine against their definition |
//! | [`loss`] | losses of images, depths and Gaussians, each with its derivatives |
//! | [`run`] | a run: from images to Gaussians |
//! | `images`, [`cache`] | its images, and those that are kept decoded |
//! | [`held_out`] | the images that judge it |
//! | [`history`], [`page`] | its curves, and all of it as a page |
//! | [`compare`] | runs that differ in their settings |
//! | [`blocks`] | a route in parts, each of which is a run |
//! | [`start`] | from points to the Gaussians that it begins with |
//! | [`trainer`] | a step: what one image teaches |
//! | [`sample`] | what a step learns from |
//! | [`model`] | the Gaussians of a run, and Adam |
//! | [`poses`] | the poses of a rig, trained |
//! | `exposures`, `sky` | the exposure of each image, and the sky behind all, trained |
//! | [`ground`] | which Gaussians are of the ground, and their terms |
//! | `growth` | relocation and growth by Markov chain Monte Carlo |
//! | [`checkpoint`] | the state of a run in a file |
//! | [`settings`] | the settings of a run |
//! | `objective` | the loss of an image, and all its derivatives |
//! | [`compose`] | from the Gaussians' images to the camera's: background or sky, and exposure |
//!
//! The renderer differentiates the images of the Gaussians ([`wildcity_render::gradient`]); all
//! that lies between these and a number is here. Every function is written for f32 and f64:
//! training computes in f32, and tests judge the same code in f64 by differences.

mod adam;
pub mod blocks;
pub mod cache;
pub mod check;
pub mod checkpoint;
pub mod compare;
pub mod compose;
mod error;
mod exposures;
pub mod ground;
mod growth;
pub mod held_out;
pub mod history;
mod images;
pub mod loss;
pub mod model;
mod objective;
pub mod page;
pub mod poses;
pub mod run;
pub mod sample;
pub mod settings;
mod sky;
pub mod start;
pub mod trainer;

pub use sky::sky_file;
