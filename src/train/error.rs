//! Why a run cannot go on.

use wildcity_render::RenderError;
use wildcity_render::gradient::GradientError;
use wildcity_scene::sky::SkyError;
use wildcity_scene::validate::BadGaussians;

use crate::poses::Place;
use crate::settings::SettingError;

/// Why a run cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    #[error(transparent)]
    Setting(#[from] SettingError),
    #[error(transparent)]
    Gradient(#[from] GradientError),
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An image of the run cannot be read.
    #[error("{0}")]
    Image(String),
    /// Nothing is left to learn from.
    #[error(
        "of {images} images {held_out} are held out, and none is left to learn from: give more images, or hold out none"
    )]
    NoImages { images: usize, held_out: usize },
    /// No Gaussian to begin with.
    #[error("there are no points to begin with: give a cloud of points, or a scene to refine")]
    Empty,
    /// Values that no scene may have.
    #[error("Gaussians to begin with: {0}")]
    Invalid(BadGaussians),
    /// A number of poses or labels that is not that of the images or Gaussians.
    #[error("there are {given} {what} for {wanted}")]
    Count { what: &'static str, given: usize, wanted: usize },
    /// Poses of a rig are to be trained, and there is none.
    #[error(
        "poses.mode is rig, and the images are of no rig: train on a log, or give image or off"
    )]
    NoRig,
    /// An image beyond those that the run began with.
    #[error("image {image} is not one of those that the run began with")]
    NoImage { image: usize },
    /// An image whose poses the run does not have.
    #[error(
        "image {image} is at time {} and camera {} of a rig that has fewer of them", place.ego, place.camera
    )]
    Place { image: usize, place: Place },
    /// A derivative that f32 does not hold: the run cannot go on from here.
    #[error("step {step}, image {image}: a derivative by {by} is not finite")]
    NotFinite { step: usize, image: usize, by: String },
    #[error(transparent)]
    Sky(#[from] SkyError),
    /// A colour, weight or depth that counts and is no number of its range.
    #[error(
        "value {index} of the {image} is {value}; colours are finite, weights and depths not below 0"
    )]
    Value { image: &'static str, index: usize, value: f32 },
    /// An image of another size than its camera's.
    #[error("the {image} has {given} values, and the camera's size asks for {wanted}")]
    Size { image: &'static str, given: usize, wanted: usize },
}

impl From<BadGaussians> for TrainError {
    fn from(cause: BadGaussians) -> Self {
        Self::Invalid(cause)
    }
}
