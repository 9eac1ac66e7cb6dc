//! What a step learns from.

use wildcity_render::View;

use crate::error::TrainError;
use crate::poses::Place;

/// An image to learn from.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// The camera, at the pose that was recorded.
    pub view: View,
    /// The number of the image within the run, for what is trained of each image.
    pub image: usize,
    /// Its poses of the run's rig, if there is one.
    pub place: Option<Place>,
    /// `[height, width, 3]`: the colours of the image, 0 to 1.
    pub rgb: &'a [f32],
    /// `[height, width]`: the weight of each pixel; 0 leaves it out.
    pub weights: Option<&'a [f32]>,
    /// `[height, width]`: the pixels that show the sky, where that is known.
    pub sky: Option<&'a [bool]>,
    /// `[height, width]`: measured depths in metres; 0 where there is none.
    pub depth_m: Option<&'a [f32]>,
    /// The colour behind all Gaussians of a run without a sky.
    pub background: [f32; 3],
    /// Factor of the losses: less than 1 for an image that is trusted less.
    pub weight: f32,
    /// Recorded factor of all colours: 2 for an image that was exposed a stop more than others.
    pub exposure: f32,
}

impl Sample<'_> {
    /// Width and height, in pixels.
    pub(crate) fn size_px(&self) -> [usize; 2] {
        [self.view.camera.width_px, self.view.camera.height_px].map(|px| px as usize)
    }

    pub(crate) fn check(&self) -> Result<(), TrainError> {
        let pixels = self.view.camera.pixels();
        let sizes = [
            ("image", Some(self.rgb.len()), 3 * pixels),
            ("mask", self.weights.map(<[f32]>::len), pixels),
            ("sky", self.sky.map(<[bool]>::len), pixels),
            ("depth", self.depth_m.map(<[f32]>::len), pixels),
        ];
        for (image, given, wanted) in sizes {
            if let Some(given) = given.filter(|&given| given != wanted) {
                return Err(TrainError::Size { image, given, wanted });
            }
        }
        for (image, value) in [("weight", self.weight), ("exposure", self.exposure)] {
            if !(0.0..=f32::MAX).contains(&value) {
                return Err(TrainError::Value { image, index: 0, value });
            }
        }
        // A NaN is in no range.
        let is_fault = |value: &f32| !(0.0..=f32::MAX).contains(value);
        let out_of_range = |values: &[f32]| values.iter().position(is_fault);
        for (image, values) in [("mask", self.weights), ("depth", self.depth_m)] {
            if let Some((values, index)) = values.and_then(|v| Some((v, out_of_range(v)?))) {
                return Err(TrainError::Value { image, index, value: values[index] });
            }
        }
        let counts = |index: usize| self.weights.is_none_or(|weights| weights[index / 3] > 0.0);
        // A pixel that is left out may hold anything.
        let is_fault = |index: &usize| !self.rgb[*index].is_finite() && counts(*index);
        match (0..self.rgb.len()).find(is_fault) {
            Some(index) => Err(TrainError::Value { image: "image", index, value: self.rgb[index] }),
            None => Ok(()),
        }
    }
}
