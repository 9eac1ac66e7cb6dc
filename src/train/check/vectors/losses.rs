//! The losses of the vectors: what make_vectors.py computes from the images of a view.

use glam::DVec3;
use wildcity_render::reference::gradient::Images;

use super::file::{PIXELS, SIZE_PX, VectorError, Vectors};
use crate::compose::{Background, Exposure, compose, compose_gradient};
use crate::loss::{disparity, dssim, l1};

/// A loss of the images of the Gaussians, over a background of one colour.
pub(super) enum ImageLoss {
    Products(Products),
    TrainingStep(TrainingStep),
}

/// `rgb · by_rgb + opacity · by_opacity + depth_sum · by_depth_sum`.
pub(super) struct Products {
    background: [f64; 3],
    /// `[height, width, 3]`, by the colours over the background.
    by_rgb: Vec<f64>,
    by_opacity: Vec<f64>,
    by_depth_sum: Vec<f64>,
}

/// The losses of a step: `0.8 L1 + 0.2 D-SSIM` of colours over a background, and 0.1 of disparity.
pub(super) struct TrainingStep {
    background: [f64; 3],
    target: Vec<f64>,
    depth_target_m: Vec<f64>,
}

/// A loss at some images.
#[derive(Default)]
pub(super) struct LossAt {
    pub(super) value: f64,
    pub(super) by: Images,
    /// Derivatives by the colour of the background.
    pub(super) by_background: [f64; 3],
}

/// A loss of the colours over a background, of the opacity and of the sum of depths.
struct Derivatives {
    value: f64,
    by_rgb: Vec<f64>,
    by_opacity: Vec<f64>,
    by_depth_sum: Vec<f64>,
}

impl ImageLoss {
    /// The loss of some images, and its derivatives.
    pub(super) fn at(&self, images: &Images) -> LossAt {
        let (Self::Products(Products { background, .. })
        | Self::TrainingStep(TrainingStep { background, .. })) = self;
        let rgb: Vec<f64> = images.rgb.iter().flat_map(|rgb| rgb.to_array()).collect();
        let exposure = Exposure::identity();
        let color = Background::Color(*background);
        let image = compose(&rgb, &images.opacity, color, &exposure);
        let loss = match self {
            Self::Products(products) => products.at(&image, images),
            Self::TrainingStep(step) => step.at(&image, images),
        };
        let by = compose_gradient(&rgb, &images.opacity, color, &exposure, &loss.by_rgb);
        // One colour is behind all pixels, so the derivatives by it add up.
        let sum = |channel: usize| by.background.iter().skip(channel).step_by(3).sum();
        let opacity = by.opacity.iter().zip(&loss.by_opacity).map(|(a, b)| a + b).collect();
        LossAt {
            value: loss.value,
            by: Images { rgb: points(&by.rgb), opacity, depth_sum_m: loss.by_depth_sum },
            by_background: [0, 1, 2].map(sum),
        }
    }
}

impl Products {
    /// The same loss of the colours alone, times a weight.
    pub(super) fn colors_alone(&self, weight: f64) -> Self {
        Self {
            background: self.background,
            by_rgb: self.by_rgb.iter().map(|by| weight * by).collect(),
            by_opacity: vec![0.0; PIXELS],
            by_depth_sum: vec![0.0; PIXELS],
        }
    }

    fn at(&self, image: &[f64], images: &Images) -> Derivatives {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let of_depths = dot(&self.by_depth_sum, &images.depth_sum_m);
        Derivatives {
            value: dot(&self.by_rgb, image) + dot(&self.by_opacity, &images.opacity) + of_depths,
            // The loss is linear: its factors are its derivatives.
            by_rgb: self.by_rgb.clone(),
            by_opacity: self.by_opacity.clone(),
            by_depth_sum: self.by_depth_sum.clone(),
        }
    }
}

impl TrainingStep {
    fn at(&self, image: &[f64], images: &Images) -> Derivatives {
        let similarity = dssim(SIZE_PX.map(|px| px as usize), image, &self.target).scaled(0.2);
        let colors = l1(image, &self.target, None).scaled(0.8).plus(&similarity);
        let depths =
            disparity(&images.opacity, &images.depth_sum_m, &self.depth_target_m).scaled(0.1);
        Derivatives {
            value: colors.value + depths.value,
            by_rgb: colors.by,
            // Colours depend on the opacity through the background only, which `compose_gradient`
            // adds.
            by_opacity: depths.by_opacity,
            by_depth_sum: depths.by_depth_sum,
        }
    }
}

impl Vectors {
    /// The loss of all cases but the training step.
    pub(super) fn products(&self) -> Result<Products, VectorError> {
        Ok(Products {
            background: self.background()?,
            by_rgb: self.values("v.rgb", 3 * PIXELS)?,
            by_opacity: self.values("v.alpha", PIXELS)?,
            by_depth_sum: self.values("v.depth", PIXELS)?,
        })
    }

    pub(super) fn training_step(&self) -> Result<TrainingStep, VectorError> {
        Ok(TrainingStep {
            background: self.background()?,
            target: self.values("target", 3 * PIXELS)?,
            depth_target_m: self.values("depth_target", PIXELS)?,
        })
    }

    fn background(&self) -> Result<[f64; 3], VectorError> {
        let rgb = self.values("background", 3)?;
        Ok([rgb[0], rgb[1], rgb[2]])
    }
}

fn points(values: &[f64]) -> Vec<DVec3> {
    values.as_chunks().0.iter().map(|&values| DVec3::from_array(values)).collect()
}
