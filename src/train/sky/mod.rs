//! A sky that is trained: the network that servers evaluate, with an appearance for each image.
//!
//! The network is that of [`wildcity_scene::sky::Network`] (OmniRe, Chen et al. 2024): sines and
//! cosines of a direction, three layers with ReLU, the inputs once more into the second, and a
//! sigmoid. At test time the appearance is the mean over the images.
//!
//! **A sky is smooth.** Its finest sine has a wavelength of 2π/32 rad, 11°, which is tens of
//! pixels: so a step evaluates the network at every fourth pixel of every fourth row, and
//! interpolates, with derivatives to match. It does so only where the Gaussians leave something to
//! be seen ([`SKY_CUT`]).

mod file;
mod layers;

use std::collections::HashMap;

use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use wildcity_render::View;
use wildcity_scene::Sky;
use wildcity_scene::random::{mix, to_unit};
use wildcity_scene::sky::{Layer, Network, SKY_CUT, SkyError};

pub use self::file::sky_file;
use self::layers::Layers;
use crate::adam::Adam;
use crate::settings::SkySettings;

/// Pixels between two directions at which the network is evaluated.
const STRIDE_PX: usize = 4;

/// A sky while it is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct TrainedSky {
    layers: Layers,
    adam: Adam,
    /// The appearance of each image.
    appearances: Vec<(Vec<f32>, Adam)>,
}

/// The sky behind one image.
#[derive(Clone, Debug)]
pub(crate) struct SkyImage {
    /// `[height, width, 3]`; black where it does not show.
    pub(crate) rgb: Vec<f32>,
    /// Inputs of the network at each node.
    inputs: Vec<f32>,
    pixels: Vec<ShownPixel>,
}

/// A pixel that shows sky, between four nodes.
#[derive(Clone, Copy, Debug)]
struct ShownPixel {
    pixel: usize,
    nodes: [usize; 4],
    weights: [f32; 4],
}

impl TrainedSky {
    /// A network with random weights, and the same appearance for every image.
    pub(crate) fn new(settings: &SkySettings, images: usize, seed: u64) -> Self {
        let layers = Layers::new(settings.octaves, settings.width, settings.embedding, |index| {
            to_unit(mix(seed ^ mix(index)))
        });
        let appearance = vec![0.0; settings.embedding];
        Self {
            adam: Adam::new(layers.parameters()),
            appearances: vec![(appearance, Adam::new(settings.embedding)); images],
            layers,
        }
    }

    pub(crate) fn images(&self) -> usize {
        self.appearances.len()
    }

    /// The sky behind an image, where its Gaussians leave something to be seen.
    pub(crate) fn image(&self, view: &View, image: usize, opacity: &[f32]) -> SkyImage {
        let (appearance, _) = &self.appearances[image];
        let (directions, pixels) = shown(view, opacity);
        let inputs = self.layers.inputs(&directions, appearance);
        let colors = self.layers.colors(&inputs);
        SkyImage { rgb: interpolated(&colors, &pixels, opacity.len()), inputs, pixels }
    }

    /// Moves the network and the appearance of an image, given the derivatives by the image of its
    /// sky. The rates are those of the network and of the appearance.
    ///
    /// Returns whether all derivatives are finite; if not, nothing has moved.
    pub(crate) fn step(
        &mut self,
        image: usize,
        sky: &SkyImage,
        by_rgb: &[f32],
        rates: [f64; 2],
    ) -> bool {
        let inputs = self.layers.input_count();
        let mut by_colors = vec![0.0; sky.inputs.len() / inputs * 3];
        for ShownPixel { pixel, nodes, weights } in &sky.pixels {
            for (node, weight) in nodes.iter().zip(weights) {
                for channel in 0..3 {
                    // The transpose of the interpolation.
                    by_colors[3 * node + channel] += weight * by_rgb[3 * pixel + channel];
                }
            }
        }
        let (by_layers, by_inputs) = self.layers.gradient(&sky.inputs, &by_colors);
        let (appearance, adam) = &mut self.appearances[image];
        // The last inputs are the appearance: of every node the same one.
        let by_appearance: Vec<f64> =
            by_inputs[inputs - appearance.len()..].iter().map(|&by| by.into()).collect();
        let by_layers: Vec<f64> = by_layers.iter().map(|&by| by.into()).collect();
        if !by_layers.iter().chain(&by_appearance).all(|by| (by * by).is_finite()) {
            return false;
        }
        let [rate, appearance_rate] = rates;
        self.layers.add(&self.adam.step(&by_layers, rate));
        for (value, step) in appearance.iter_mut().zip(adam.step(&by_appearance, appearance_rate)) {
            *value = (f64::from(*value) + step) as f32;
        }
        true
    }

    /// The network as servers evaluate it, with the mean appearance.
    ///
    /// # Errors
    /// A weight has left the range of networks.
    pub(crate) fn network(&self) -> Result<Network, SkyError> {
        let count = self.appearances.len().max(1) as f64;
        let mut mean = vec![0.0; self.layers.appearance_count()];
        for (appearance, _) in &self.appearances {
            for (mean, &value) in mean.iter_mut().zip(appearance) {
                *mean += f64::from(value) / count;
            }
        }
        let layers: [Layer; 3] = self.layers.to_scene();
        Network::new(layers, mean.into_iter().map(|value| value as f32).collect())
    }
}

/// A sky that is not trained, behind an image: black where it does not show. Images of a sky may
/// have edges, so that every pixel is evaluated.
pub(crate) fn fixed_image(sky: &Sky, view: &View, opacity: &[f32]) -> Vec<f32> {
    let width = view.camera.width_px as usize;
    let color = |(pixel, opacity): (usize, &f32)| {
        if !shows(*opacity) {
            return [0.0; 3];
        }
        let direction = view.ray_world(center_px([pixel % width, pixel / width]));
        direction.map_or([0.0; 3], |direction| sky.rgb(direction).as_vec3().to_array())
    };
    let colors: Vec<[f32; 3]> = opacity.par_iter().enumerate().map(color).collect();
    colors.concat()
}

/// Whether something of the sky shows behind an opacity.
fn shows(opacity: f32) -> bool {
    f64::from(1.0 - opacity) >= SKY_CUT
}

fn center_px([column, row]: [usize; 2]) -> DVec2 {
    DVec2::new(column as f64, row as f64) + 0.5
}

/// The pixels that show sky, and the directions of the nodes that they lie between.
fn shown(view: &View, opacity: &[f32]) -> (Vec<[f32; 3]>, Vec<ShownPixel>) {
    let mut nodes = Nodes::new(view);
    let mut pixels = Vec::new();
    let open = (0..opacity.len()).filter(|&pixel| shows(opacity[pixel]));
    pixels.extend(open.filter_map(|pixel| nodes.around(pixel)));
    (nodes.directions, pixels)
}

/// The image `[pixels, 3]` of the colours of nodes.
fn interpolated(colors: &[f32], shown: &[ShownPixel], pixels: usize) -> Vec<f32> {
    let mut rgb = vec![0.0; 3 * pixels];
    for ShownPixel { pixel, nodes, weights } in shown {
        for (node, weight) in nodes.iter().zip(weights) {
            for channel in 0..3 {
                rgb[3 * pixel + channel] += weight * colors[3 * node + channel];
            }
        }
    }
    rgb
}

/// The directions of one view at which a network is evaluated.
struct Nodes<'a> {
    view: &'a View,
    width: usize,
    height: usize,
    /// The node of each place of the grid that has been asked for; `None` out of the lens' field.
    grid: HashMap<[usize; 2], Option<usize>>,
    directions: Vec<[f32; 3]>,
}

impl<'a> Nodes<'a> {
    fn new(view: &'a View) -> Self {
        let [width, height] = [view.camera.width_px, view.camera.height_px].map(|px| px as usize);
        Self { view, width, height, grid: HashMap::new(), directions: Vec::new() }
    }

    /// The nodes around a pixel; at the edge of a lens' field, the pixel itself. `None` for a pixel
    /// outside of it.
    fn around(&mut self, pixel: usize) -> Option<ShownPixel> {
        let at = [pixel % self.width, pixel / self.width];
        let cell = at.map(|at| at / STRIDE_PX * STRIDE_PX);
        let last = [self.width - 1, self.height - 1];
        let next = [0, 1].map(|axis| (cell[axis] + STRIDE_PX).min(last[axis]));
        let corners =
            [[cell[0], cell[1]], [next[0], cell[1]], [cell[0], next[1]], [next[0], next[1]]];
        let nodes = corners.map(|corner| self.node(corner));
        let [Some(a), Some(b), Some(c), Some(d)] = nodes else {
            let node = self.node(at)?;
            return Some(ShownPixel { pixel, nodes: [node; 4], weights: [1.0, 0.0, 0.0, 0.0] });
        };
        let share = |axis: usize| {
            // At the last row or column both corners are the same pixel, and the share is 0.
            let length = (next[axis] - cell[axis]).max(1);
            (at[axis] - cell[axis]) as f32 / length as f32
        };
        // Bilinear between the four corners.
        let x = share(0);
        let y = share(1);
        let weights = [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y];
        Some(ShownPixel { pixel, nodes: [a, b, c, d], weights })
    }

    fn node(&mut self, at: [usize; 2]) -> Option<usize> {
        let Self { view, grid, directions, .. } = self;
        *grid.entry(at).or_insert_with(|| {
            let direction = view.ray_world(center_px(at))?;
            directions.push(direction.as_vec3().to_array());
            Some(directions.len() - 1)
        })
    }
}

#[cfg(test)]
mod tests;
