//! The layers of a sky's network, forwards and backwards, in f32.
//!
//! Weights are kept by inputs for the way forwards and by outputs for the way back, so that every
//! loop adds a multiple of one row to another: the compiler makes vector instructions of these
//! without changing the order of a sum.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use wildcity_scene::sky::Layer;

/// Nodes whose derivatives are summed apart, so that the sum is the same at any number of threads.
const PART: usize = 256;

/// Three linear layers with ReLU between them, the second of which sees the inputs again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Layers {
    octaves: usize,
    width: usize,
    appearance: usize,
    /// `[outputs, inputs]` of each layer.
    weights: [Vec<f32>; 3],
    biases: [Vec<f32>; 3],
}

/// What the layers compute of one node.
struct Values {
    /// After the first layer, then the inputs once more.
    joined: Vec<f32>,
    hidden: Vec<f32>,
    rgb: [f32; 3],
}

/// Derivatives by all weights and biases, and by the inputs.
struct Sums {
    weights: [Vec<f32>; 3],
    biases: [Vec<f32>; 3],
    inputs: Vec<f32>,
}

impl Layers {
    /// Weights and biases uniform within ±1/√inputs, as PyTorch's linear layers have them.
    /// `unit` gives a random number from 0 to 1 by its index.
    pub(super) fn new(
        octaves: usize,
        width: usize,
        appearance: usize,
        unit: impl Fn(u64) -> f64,
    ) -> Self {
        let mut layers = Self {
            octaves,
            width,
            appearance,
            weights: Default::default(),
            biases: Default::default(),
        };
        let mut index = 0;
        for (layer, [outputs, inputs]) in layers.shapes().into_iter().enumerate() {
            let mut random = |count: usize| -> Vec<f32> {
                // The index runs on through all layers, so that no two values share a random
                // number.
                let first = index;
                index += count as u64;
                let value = |k| (2.0 * unit(first + k) - 1.0) / (inputs as f64).sqrt();
                (0..count as u64).map(|k| value(k) as f32).collect()
            };
            layers.weights[layer] = random(outputs * inputs);
            layers.biases[layer] = random(outputs);
        }
        layers
    }

    /// Outputs and inputs of each layer.
    fn shapes(&self) -> [[usize; 2]; 3] {
        let inputs = self.input_count();
        [[self.width, inputs], [self.width, self.width + inputs], [3, self.width]]
    }

    /// The direction, its sines and cosines, and the appearance.
    pub(super) fn input_count(&self) -> usize {
        3 + 6 * self.octaves + self.appearance
    }

    pub(super) fn appearance_count(&self) -> usize {
        self.appearance
    }

    pub(super) fn parameters(&self) -> usize {
        self.shapes().iter().map(|[outputs, inputs]| outputs * (inputs + 1)).sum()
    }

    /// `[nodes, inputs]`: what the network reads for each direction.
    pub(super) fn inputs(&self, directions: &[[f32; 3]], appearance: &[f32]) -> Vec<f32> {
        let mut inputs = Vec::with_capacity(directions.len() * self.input_count());
        for direction in directions {
            inputs.extend(direction);
            let octaves = || (0..self.octaves).map(|octave| (1 << octave) as f32);
            inputs.extend(octaves().flat_map(|scale| direction.map(|axis| (scale * axis).sin())));
            inputs.extend(octaves().flat_map(|scale| direction.map(|axis| (scale * axis).cos())));
            inputs.extend(appearance);
        }
        inputs
    }

    /// `[nodes, 3]`: the colours, 0 to 1.
    pub(super) fn colors(&self, inputs: &[f32]) -> Vec<f32> {
        let by_input = self.transposed();
        let of_node = |inputs: &[f32]| self.values(&by_input, inputs).rgb;
        let colors: Vec<[f32; 3]> =
            inputs.par_chunks_exact(self.input_count()).map(of_node).collect();
        colors.concat()
    }

    /// The derivatives of a loss by all parameters, in their order, and by the inputs summed over
    /// the nodes, given those by the colours of the nodes.
    pub(super) fn gradient(&self, inputs: &[f32], by_colors: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let by_input = self.transposed();
        let count = self.input_count();
        let nodes = inputs.par_chunks(PART * count).zip(by_colors.par_chunks(PART * 3));
        let of_part = |(inputs, by_colors): (&[f32], &[f32])| {
            let mut sums = Sums::new(self);
            for (inputs, by_color) in inputs.chunks_exact(count).zip(by_colors.chunks_exact(3)) {
                self.add_node(&by_input, inputs, by_color, &mut sums);
            }
            sums
        };
        let mut total = Sums::new(self);
        for sums in nodes.map(of_part).collect::<Vec<_>>() {
            total.add(&sums);
        }
        let layers = total.weights.iter().zip(&total.biases);
        (
            layers.flat_map(|(weights, biases)| [&weights[..], biases].concat()).collect(),
            total.inputs,
        )
    }

    /// Adds a step to all parameters, in the order of [`Layers::gradient`].
    pub(super) fn add(&mut self, steps: &[f64]) {
        let layers = self.weights.iter_mut().zip(&mut self.biases);
        let values = layers.flat_map(|(weights, biases)| weights.iter_mut().chain(biases));
        for (value, step) in values.zip(steps) {
            *value = (f64::from(*value) + step) as f32;
        }
    }

    /// The layers of a network.
    pub(super) fn to_scene(&self) -> [Layer; 3] {
        let shapes = self.shapes();
        std::array::from_fn(|layer| Layer {
            outputs: shapes[layer][0],
            inputs: shapes[layer][1],
            weight: self.weights[layer].clone(),
            bias: self.biases[layer].clone(),
        })
    }

    /// The weights `[inputs, outputs]`.
    fn transposed(&self) -> [Vec<f32>; 3] {
        let shapes = self.shapes();
        std::array::from_fn(|layer| {
            let [outputs, inputs] = shapes[layer];
            // `k` counts the transposed matrix row by row: its row is an input, its column an
            // output.
            let weight = |k: usize| self.weights[layer][k % outputs * inputs + k / outputs];
            (0..inputs * outputs).map(weight).collect()
        })
    }

    fn values(&self, by_input: &[Vec<f32>; 3], inputs: &[f32]) -> Values {
        let apply = |layer: usize, inputs: &[f32]| {
            let mut outputs = self.biases[layer].clone();
            let rows = by_input[layer].chunks_exact(outputs.len());
            for (row, &input) in rows.zip(inputs) {
                add_scaled(&mut outputs, input, row);
            }
            outputs
        };
        let relu = |values: &mut Vec<f32>| values.iter_mut().for_each(|v| *v = v.max(0.0));
        let mut joined = apply(0, inputs);
        relu(&mut joined);
        joined.extend(inputs);
        let mut hidden = apply(1, &joined);
        relu(&mut hidden);
        let logits = apply(2, &hidden);
        let rgb = [0, 1, 2].map(|channel| 1.0 / (1.0 + (-logits[channel]).exp()));
        Values { joined, hidden, rgb }
    }

    fn add_node(
        &self,
        by_input: &[Vec<f32>; 3],
        inputs: &[f32],
        by_color: &[f32],
        sums: &mut Sums,
    ) {
        let Values { joined, hidden, rgb } = self.values(by_input, inputs);
        let by_logit: Vec<f32> =
            // The derivative of the sigmoid s is s (1 - s).
            rgb.iter().zip(by_color).map(|(rgb, by)| by * rgb * (1.0 - rgb)).collect();
        let mut by_hidden = self.back(2, &hidden, &by_logit, sums);
        // What ReLU cut off passes nothing on.
        let keep = |by: &mut [f32], values: &[f32]| {
            by.iter_mut().zip(values).for_each(|(by, &v)| *by = if v > 0.0 { *by } else { 0.0 });
        };
        keep(&mut by_hidden, &hidden);
        let mut by_joined = self.back(1, &joined, &by_hidden, sums);
        // The second layer sees the inputs once more, so they have derivatives by two ways.
        let (by_first, by_inputs) = by_joined.split_at_mut(self.width);
        keep(by_first, &joined);
        add_scaled(&mut sums.inputs, 1.0, by_inputs);
        let by_first_inputs = self.back(0, inputs, by_first, sums);
        add_scaled(&mut sums.inputs, 1.0, &by_first_inputs);
    }

    /// Adds the derivatives by the parameters of a layer, and returns those by its inputs.
    fn back(&self, layer: usize, inputs: &[f32], by_outputs: &[f32], sums: &mut Sums) -> Vec<f32> {
        let mut by_inputs = vec![0.0; inputs.len()];
        add_scaled(&mut sums.biases[layer], 1.0, by_outputs);
        let own = self.weights[layer].chunks_exact(inputs.len());
        let rows = own.zip(sums.weights[layer].chunks_exact_mut(inputs.len()));
        for ((weights, by_weights), &by) in rows.zip(by_outputs) {
            // Half of the outputs are cut off by ReLU.
            if by != 0.0 {
                add_scaled(by_weights, by, inputs);
                add_scaled(&mut by_inputs, by, weights);
            }
        }
        by_inputs
    }
}

impl Sums {
    fn new(layers: &Layers) -> Self {
        let zeros = |values: &Vec<f32>| vec![0.0; values.len()];
        Self {
            weights: layers.weights.each_ref().map(zeros),
            biases: layers.biases.each_ref().map(zeros),
            inputs: vec![0.0; layers.input_count()],
        }
    }

    fn add(&mut self, other: &Self) {
        for layer in 0..3 {
            add_scaled(&mut self.weights[layer], 1.0, &other.weights[layer]);
            add_scaled(&mut self.biases[layer], 1.0, &other.biases[layer]);
        }
        add_scaled(&mut self.inputs, 1.0, &other.inputs);
    }
}

fn add_scaled(to: &mut [f32], factor: f32, from: &[f32]) {
    for (to, &from) in to.iter_mut().zip(from) {
        *to += factor * from;
    }
}
