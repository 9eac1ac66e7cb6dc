//! The network of a sky, as in OmniRe (Chen et al. 2024), evaluated in f64 by its definition.
//!
//! Inputs, in order: the direction itself (if the first layer has inputs for it); its sines at
//! frequencies 1, 2, 4, ..., each with x, y, z; its cosines likewise; an appearance embedding.
//! Three linear layers with ReLU between them; with a skip connection, the second layer also reads
//! the inputs; a sigmoid at the end.

use glam::DVec3;

use super::SkyError;

/// A checked network with one appearance embedding.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    octaves: usize,
    identity: bool,
    skip: bool,
    layers: [Layer; 3],
    appearance: Vec<f32>,
}

/// One linear layer: `weight inputs + bias`.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    pub outputs: usize,
    pub inputs: usize,
    /// `[outputs, inputs]`, row by row.
    pub weight: Vec<f32>,
    pub bias: Vec<f32>,
}

/// Names of the layers' tensors in files.
const TENSORS: [[&str; 2]; 3] = [
    ["sky_head.layers.0.weight", "sky_head.layers.0.bias"],
    ["sky_head.layers.1.weight", "sky_head.layers.1.bias"],
    ["sky_head.layers.2.weight", "sky_head.layers.2.bias"],
];

impl Network {
    /// Largest width of a layer: four times that of trained skies. Evaluation takes 0.4 s per
    /// million pixels and core.
    pub const MAX_WIDTH: usize = 256;
    /// Largest number of octaves. The rounding error of an f32 direction, 6e-8, times 512 is 3e-5
    /// rad in the argument of the finest sine.
    pub const MAX_OCTAVES: usize = 10;
    /// Largest length of an appearance embedding.
    pub const MAX_APPEARANCE: usize = 256;
    /// Largest accepted weight. Three layers of at most 575 inputs stay below 3e36, within f32.
    const MAX_WEIGHT: f32 = 1e6;

    /// A network from its layers. Octaves, identity inputs and skip connection follow from the
    /// shapes. `appearance` may be empty.
    ///
    /// # Errors
    /// A shape does not fit the others or is too large, or a weight is not finite.
    pub fn new(layers: [Layer; 3], appearance: Vec<f32>) -> Result<Self, SkyError> {
        let shape = |layer: usize, must: String| {
            let Layer { outputs, inputs, .. } = layers[layer];
            Err(SkyError::Shape { tensor: TENSORS[layer][0], shape: vec![outputs, inputs], must })
        };
        if appearance.len() > Self::MAX_APPEARANCE {
            let tensor = "appearance_embedding.weight";
            let shape = vec![appearance.len()];
            let must = format!("an appearance has at most {} numbers", Self::MAX_APPEARANCE);
            return Err(SkyError::Shape { tensor, shape, must });
        }
        let inputs = layers[0].inputs;
        let width = layers[0].outputs;
        if !(1..=Self::MAX_WIDTH).contains(&width) {
            return shape(0, format!("a layer is from 1 to {} wide", Self::MAX_WIDTH));
        }
        // What is left of the inputs without the appearance; saturating, because the numbers come
        // from a file.
        let encoded = inputs.saturating_sub(appearance.len());
        // 6 inputs per octave (sine and cosine of x, y, z), and 3 more for the direction itself.
        let octaves = encoded / 6;
        let identity = encoded % 6 == 3;
        let fits = inputs >= appearance.len() && encoded > 0 && matches!(encoded % 6, 0 | 3);
        if !fits || octaves > Self::MAX_OCTAVES {
            let must = format!(
                "its inputs are 6 per octave, up to {} octaves, 3 more with the direction itself, and \
                 the {} of an appearance",
                Self::MAX_OCTAVES,
                appearance.len()
            );
            return shape(0, must);
        }
        // The second layer's shape says whether there is a skip connection.
        let skip = layers[1].inputs == width + inputs;
        if layers[1].outputs != width || !(skip || layers[1].inputs == width) {
            return shape(1, format!("it must be [{width}, {}]", width + inputs));
        }
        if [layers[2].outputs, layers[2].inputs] != [3, width] {
            return shape(2, format!("it must be [3, {width}]"));
        }
        // Shapes are consistent now; lengths and values are left.
        for (layer, [weight, bias]) in layers.iter().zip(TENSORS) {
            let Layer { outputs, inputs, .. } = *layer;
            for (tensor, values, shape) in
                [(weight, &layer.weight, vec![outputs, inputs]), (bias, &layer.bias, vec![outputs])]
            {
                if values.len() != shape.iter().product::<usize>() {
                    let must = format!("it holds {} values", values.len());
                    return Err(SkyError::Shape { tensor, shape, must });
                }
                check_values(tensor, values)?;
            }
        }
        check_values("appearance_embedding.weight", &appearance)?;
        Ok(Self { octaves, identity, skip, layers, appearance })
    }

    /// The colour in (0, 1) along a unit direction.
    pub fn rgb(&self, direction: DVec3) -> DVec3 {
        // Inputs in the order that the module comment states.
        let mut input = Vec::with_capacity(self.layers[0].inputs);
        if self.identity {
            input.extend(direction.to_array());
        }
        let octaves = || (0..self.octaves).map(|octave| f64::from(1 << octave) * direction);
        input.extend(octaves().flat_map(|scaled| scaled.to_array().map(f64::sin)));
        input.extend(octaves().flat_map(|scaled| scaled.to_array().map(f64::cos)));
        input.extend(self.appearance.iter().map(|&number| f64::from(number)));

        // The last layer has no ReLU: its outputs are logits of colours, which may be negative.
        let relu = |values: Vec<f64>| -> Vec<f64> {
            values.into_iter().map(|value| value.max(0.0)).collect()
        };
        let mut hidden = relu(self.layers[0].apply(&input));
        if self.skip {
            hidden.extend(&input);
        }
        let hidden = relu(self.layers[1].apply(&hidden));
        let logits = self.layers[2].apply(&hidden);
        DVec3::new(logits[0], logits[1], logits[2]).map(|logit| 1.0 / (1.0 + (-logit).exp()))
    }

    /// Number of octaves of sines and cosines.
    pub fn octaves(&self) -> usize {
        self.octaves
    }

    /// Whether the direction itself is an input.
    pub fn identity(&self) -> bool {
        self.identity
    }

    /// Whether the second layer also reads the inputs.
    pub fn skip(&self) -> bool {
        self.skip
    }

    /// The layers, from the direction to the colour.
    pub fn layers(&self) -> &[Layer; 3] {
        &self.layers
    }

    /// The appearance embedding: the last inputs of the network, the same for all directions.
    pub fn appearance(&self) -> &[f32] {
        &self.appearance
    }

    /// Memory of the weights, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let weights = |layer: &Layer| layer.weight.len() + layer.bias.len();
        4 * (self.layers.iter().map(weights).sum::<usize>() + self.appearance.len())
    }
}

impl Layer {
    fn apply(&self, input: &[f64]) -> Vec<f64> {
        let rows = self.weight.chunks_exact(self.inputs).zip(&self.bias);
        rows.map(|(row, &bias)| {
            let products = row.iter().zip(input).map(|(&weight, &value)| f64::from(weight) * value);
            f64::from(bias) + products.sum::<f64>()
        })
        .collect()
    }
}

fn check_values(tensor: &'static str, values: &[f32]) -> Result<(), SkyError> {
    let limits = -Network::MAX_WEIGHT..=Network::MAX_WEIGHT;
    match values.iter().position(|value| !limits.contains(value)) {
        Some(index) => Err(SkyError::Value { tensor, index, value: values[index] }),
        None => Ok(()),
    }
}
