//! The loss of one image, and its derivatives by all that the image is a function of.

use wildcity_render::View;
use wildcity_render::gradient::GaussianImages;
use wildcity_scene::Sky;

use crate::compose::{Background, ComposedGradient, Exposure, compose, compose_gradient};
use crate::loss::{disparity, dssim, l1, masked};
use crate::sample::Sample;
use crate::settings::Weights;
use crate::sky::{SkyImage, TrainedSky, fixed_image};

/// The losses of a step, without their weights.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    pub l1: f64,
    pub dssim: f64,
    /// In 1/m; 0 without measured depths.
    pub disparity: f64,
    /// The mean opacity where the sky is; 0 without a mask of it.
    pub sky: f64,
    /// The weighted sum of the ground's terms; 0 without Gaussians of the ground.
    pub ground: f64,
    /// Number of visible Gaussians.
    pub visible: u64,
    /// Wall time of each stage of the frame and its gradients, in milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// The loss of one image.
pub(crate) struct Objective<'a> {
    pub(crate) sample: &'a Sample<'a>,
    /// The camera at the pose that it has now.
    pub(crate) view: View,
    pub(crate) weights: &'a Weights,
    pub(crate) exposure: Exposure<f32>,
    pub(crate) sky: Option<&'a TrainedSky>,
    /// A sky that is not trained.
    pub(crate) fixed_sky: Option<&'a Sky>,
}

/// What a step needs of an objective, beside the derivatives by the Gaussians' images.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    pub(crate) report: StepReport,
    pub(crate) by_exposure: Exposure<f32>,
    /// The sky behind the image, and the derivatives by its colours.
    pub(crate) sky: Option<(SkyImage, Vec<f32>)>,
}

impl Objective<'_> {
    /// The derivatives by the images of the Gaussians, and by what else the image is made of.
    pub(crate) fn at(&self, images: &GaussianImages) -> (GaussianImages, Outcome) {
        let sample = self.sample;
        let sky = self.sky.map(|sky| sky.image(&self.view, sample.image, &images.opacity));
        let fixed = self.fixed_sky.map(|sky| fixed_image(sky, &self.view, &images.opacity));
        let background = match (&sky, &fixed) {
            // A sky that is trained and a fixed one do not occur together (`Fixed::sky`).
            (Some(SkyImage { rgb, .. }), _) | (None, Some(rgb)) => Background::Image(rgb),
            (None, None) => Background::Color(sample.background),
        };
        let GaussianImages { rgb, opacity, depth_sum_m } = images;
        let mut image = compose(rgb, opacity, background, &self.exposure);
        let mut report = StepReport::default();
        let clipped = clip(&mut image, sample.rgb);
        let mut by_image = self.by_colors(&image, &mut report);
        for index in clipped {
            // A clipped value does not change with the colours that it is made of.
            by_image[index] = 0.0;
        }
        let by = compose_gradient(rgb, opacity, background, &self.exposure, &by_image);
        let ComposedGradient { rgb, mut opacity, background, exposure } = by;
        let mut by_depth_sum = Vec::new();
        if let Some(measured_m) = sample.depth_m.filter(|_| !depth_sum_m.is_empty()) {
            let loss = disparity(&images.opacity, depth_sum_m, measured_m);
            report.disparity = loss.value;
            let loss = loss.scaled(f64::from(sample.weight) * self.weights.disparity);
            for (by, more) in opacity.iter_mut().zip(loss.by_opacity) {
                *by += more;
            }
            by_depth_sum = loss.by_depth_sum;
        }
        if let Some(sky) = sample.sky {
            // The mean opacity of the pixels that show the sky: a Gaussian there would take the
            // colour of the sky, and move with the camera.
            let pixels = sky.iter().filter(|is_sky| **is_sky).count().max(1) as f64;
            let by_each = (f64::from(sample.weight) * self.weights.sky / pixels) as f32;
            let shown = opacity.iter_mut().zip(&images.opacity).zip(sky);
            for ((by, opacity), _) in shown.filter(|(_, is_sky)| **is_sky) {
                report.sky += f64::from(*opacity) / pixels;
                *by += by_each;
            }
        }
        let by_images = GaussianImages { rgb, opacity, depth_sum_m: by_depth_sum };
        let sky = sky.map(|sky| (sky, background));
        (by_images, Outcome { report, by_exposure: exposure, sky })
    }

    /// The derivatives by the colours of the composed image.
    fn by_colors(&self, image: &[f32], report: &mut StepReport) -> Vec<f32> {
        let Sample { rgb, weights, .. } = *self.sample;
        let absolute = l1(image, rgb, weights);
        report.l1 = absolute.value;
        let factor = f64::from(self.sample.weight);
        let total = absolute.scaled(factor * (1.0 - self.weights.dssim));
        if self.weights.dssim == 0.0 {
            return total.by;
        }
        let size_px = self.sample.size_px();
        // Masked pixels are 0 on both sides.
        // D-SSIM compares windows, so that a pixel cannot be left out of a sum as L1 does.
        let similarity = match weights {
            None => dssim(size_px, image, rgb),
            Some(mask) => {
                let mut similarity = dssim(size_px, &masked(image, mask), &masked(rgb, mask));
                // The masked image is a product with the mask, and so are the derivatives by it.
                similarity.by = masked(&similarity.by, mask);
                similarity
            }
        };
        report.dssim = similarity.value;
        total.plus(&similarity.scaled(factor * self.weights.dssim)).by
    }
}

/// Values of the largest number that 8 bits hold: the sensor may have seen more.
const CLIPPED: f32 = 254.5 / 255.0;

/// Clips an image where the recorded one is clipped: how much brighter it is there is not known,
/// and an image of 8 stops more would darken all others. Returns the places.
fn clip(image: &mut [f32], recorded: &[f32]) -> Vec<usize> {
    let mut clipped = Vec::new();
    for (index, (value, recorded)) in image.iter_mut().zip(recorded).enumerate() {
        if *recorded >= CLIPPED && *value > 1.0 {
            *value = 1.0;
            clipped.push(index);
        }
    }
    clipped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_brighter_than_a_clipped_value_is_clipped() {
        let mut image = [1.5, 1.5, 0.9, f32::INFINITY];
        assert_eq!(clip(&mut image, &[1.0, 0.99, 1.0, 1.0]), [0, 3]);
        assert_eq!(image, [1.0, 1.5, 0.9, 1.0]);
    }
}
