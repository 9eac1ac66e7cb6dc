//! The exposure of each image as parameters: an affine map of colours, near the identity.

use serde::{Deserialize, Serialize};

use crate::adam::Adam;
use crate::compose::Exposure;

/// Exposures while they are trained, one for each image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct TrainedExposures {
    images: Vec<(Values, Adam)>,
}

/// A matrix row by row, then an offset.
type Values = [f64; 12];

const IDENTITY: Values = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];

impl TrainedExposures {
    pub(crate) fn new(images: usize) -> Self {
        Self { images: vec![(IDENTITY, Adam::new(IDENTITY.len())); images] }
    }

    pub(crate) fn images(&self) -> usize {
        self.images.len()
    }

    /// The exposure of an image, after that which was recorded: a factor of all colours.
    pub(crate) fn exposure(&self, image: usize, recorded: f32) -> Exposure<f32> {
        let (values, _) = &self.images[image];
        let value = |k: usize| recorded * values[k] as f32;
        Exposure {
            matrix: [0, 1, 2].map(|row| [0, 1, 2].map(|column| value(3 * row + column))),
            offset: [9, 10, 11].map(|k| values[k] as f32),
        }
    }

    /// Moves the exposure of an image. `weight` is that of the squared distance to the identity,
    /// so that no brightness moves from the scene to all exposures.
    pub(crate) fn step(
        &mut self,
        image: usize,
        recorded: f32,
        by: &Exposure<f32>,
        [rate, weight]: [f64; 2],
    ) {
        let (values, adam) = &mut self.images[image];
        // The recorded factor multiplies the matrix and not the offset.
        let by = by.matrix.iter().flatten().map(|by| recorded * by).chain(by.offset);
        let pull = |k: usize| 2.0 * weight * (values[k] - IDENTITY[k]);
        let by: Vec<f64> = by.enumerate().map(|(k, by)| f64::from(by) + pull(k)).collect();
        for (value, step) in values.iter_mut().zip(adam.step(&by, rate)) {
            *value += step;
        }
    }
}
