//! Fast evaluation of a sky network: 16 directions at once, in f32.
//!
//! The appearance embedding is the same for every direction, so its products with the weights are
//! folded into the biases. Eight outputs are accumulated at once, so that each input is loaded once
//! for all of them.

use fearless_simd::{f32x16, i32x16, prelude::*};

use super::Network;
use crate::chunk::{LANES, Lanes};

/// Number of outputs that are accumulated at once.
const GROUP: usize = 8;

/// A network whose appearance embedding is folded into its biases.
#[derive(Clone, Debug)]
pub struct InferenceNetwork {
    octaves: usize,
    identity: bool,
    skip: bool,
    /// Number of values of an encoded direction: identity, sines and cosines.
    encoded: usize,
    /// Outputs of a hidden layer, rounded up to whole groups; padded outputs are 0.
    width: usize,
    layers: [Dense; 3],
}

/// A linear layer, stored by groups of outputs.
#[derive(Clone, Debug)]
struct Dense {
    inputs: usize,
    /// `[groups, inputs]`, eight outputs at a time.
    weight: Vec<[f32; GROUP]>,
    /// `[groups]`, eight outputs at a time.
    bias: Vec<[f32; GROUP]>,
}

/// Buffers for intermediate values, to be reused between evaluations.
#[derive(Clone, Debug)]
pub struct Scratch {
    /// Outputs of the first layer, followed by the encoded direction.
    joined: Vec<Lanes>,
    hidden: Vec<Lanes>,
    logits: [Lanes; GROUP],
}

impl InferenceNetwork {
    /// The fast form of a network.
    pub fn new(network: &Network) -> Self {
        let [first, second, third] = network.layers();
        let encoded = first.inputs - network.appearance().len();
        let width = first.outputs.next_multiple_of(GROUP);
        // Inputs of the second layer: the outputs of the first, padded to `width`, then the encoded
        // direction.
        let joined = |input: usize| match input {
            _ if input < width => (input < first.outputs).then_some(input),
            _ => Some(input - width + first.outputs),
        };
        let joined_inputs = if network.skip() { width + encoded } else { width };
        let appearance = network.appearance();
        // The appearance is the same for all directions, so that its products are a constant: in
        // f64, because the sum replaces many f32 additions.
        let folded = |layer: &super::Layer, output: usize, from: usize| {
            let row = &layer.weight[output * layer.inputs..][..layer.inputs];
            let products = row.iter().skip(from).zip(appearance);
            let sum: f64 = products.map(|(&w, &a)| f64::from(w) * f64::from(a)).sum();
            (f64::from(layer.bias[output]) + sum) as f32
        };
        Self {
            octaves: network.octaves(),
            identity: network.identity(),
            skip: network.skip(),
            encoded,
            width,
            layers: [
                Dense::new(first, encoded, Some, |output| folded(first, output, encoded)),
                Dense::new(second, joined_inputs, joined, |output| {
                    // Without a skip connection no weights follow these inputs, and nothing is
                    // folded.
                    folded(second, output, first.outputs + encoded)
                }),
                Dense::new(
                    third,
                    width,
                    |input| (input < first.outputs).then_some(input),
                    |output| third.bias[output],
                ),
            ],
        }
    }

    /// Outputs of a hidden layer, a multiple of 8.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of octaves of sines and cosines.
    pub fn octaves(&self) -> usize {
        self.octaves
    }

    /// Number of values of an encoded direction: identity, sines and cosines.
    pub fn encoded(&self) -> usize {
        self.encoded
    }

    /// Whether the direction itself is part of the encoded direction.
    pub fn identity(&self) -> bool {
        self.identity
    }

    /// Whether the second layer also reads the encoded direction, after the outputs of the first.
    pub fn skip(&self) -> bool {
        self.skip
    }

    /// All parameters for a GPU, by layer and output: the bias, followed by the weights in groups
    /// of four; the last group is padded with zeros.
    pub fn weights(&self) -> Vec<[f32; 4]> {
        let mut rows = Vec::new();
        for (layer, outputs) in self.layers.iter().zip([self.width, self.width, 3]) {
            for output in 0..outputs {
                let group = output / GROUP;
                let k = output % GROUP;
                // A row is an output: the bias and then its weights, four to a vector.
                rows.push([layer.bias[group][k], 0.0, 0.0, 0.0]);
                let weights = &layer.weight[group * layer.inputs..][..layer.inputs];
                rows.extend(weights.chunks(4).map(|four| {
                    std::array::from_fn(|i| four.get(i).map_or(0.0, |weight| weight[k]))
                }));
            }
        }
        rows
    }

    /// Memory of the parameters, in bytes.
    pub fn bytes(&self) -> usize {
        let of_layer = |layer: &Dense| (layer.weight.len() + layer.bias.len()) * 4 * GROUP;
        self.layers.iter().map(of_layer).sum()
    }

    /// Buffers for [`InferenceNetwork::rgb`], of one thread at a time.
    pub fn scratch(&self) -> Scratch {
        let zero = |len| vec![Lanes([0.0; LANES]); len];
        Scratch {
            joined: zero(self.width + self.encoded),
            hidden: zero(self.width),
            logits: [Lanes([0.0; LANES]); GROUP],
        }
    }

    /// Red, green, blue in (0, 1) along 16 unit directions, given as x, y, z.
    #[inline(always)]
    pub fn rgb<S: Simd>(
        &self,
        simd: S,
        direction: [f32x16<S>; 3],
        scratch: &mut Scratch,
    ) -> [[f32; LANES]; 3] {
        let Scratch { joined, hidden, logits } = scratch;
        // The first layer writes in front of the encoded direction, so that the second one reads
        // both as one slice without a copy.
        let (first, input) = joined.split_at_mut(self.width);
        self.encode(simd, direction, input);
        let [one, two, three] = &self.layers;
        one.apply::<S, true>(simd, input, first);
        let read = if self.skip { joined.len() } else { self.width };
        two.apply::<S, true>(simd, &joined[..read], hidden);
        three.apply::<S, false>(simd, hidden, logits);
        let mut rgb = [[0.0; LANES]; 3];
        for (rgb, logits) in rgb.iter_mut().zip(&*logits) {
            for (value, logit) in rgb.iter_mut().zip(&logits.0) {
                // The logistic function of three values only; the exponential is not worth a vector
                // form.
                *value = 1.0 / (1.0 + (-logit).exp());
            }
        }
        rgb
    }

    #[inline(always)]
    fn encode<S: Simd>(&self, simd: S, direction: [f32x16<S>; 3], input: &mut [Lanes]) {
        let mut next = 0;
        if self.identity {
            for (axis, to) in direction.iter().zip(&mut *input) {
                axis.store_array(&mut to.0);
            }
            next = 3;
        }
        // First all sines, then all cosines, as the network was trained.
        for quarter in [0.0, 0.5] {
            let mut scale = 1.0;
            for _ in 0..self.octaves {
                for axis in direction {
                    let scaled = axis * f32x16::splat(simd, scale);
                    sine(simd, scaled, quarter).store_array(&mut input[next].0);
                    next += 1;
                }
                scale *= 2.0;
            }
        }
    }
}

impl Dense {
    /// A layer whose input `i` is input `source(i)` of `layer`; where that is `None`, its weights
    /// are 0.
    fn new(
        layer: &super::Layer,
        inputs: usize,
        source: impl Fn(usize) -> Option<usize>,
        bias: impl Fn(usize) -> f32,
    ) -> Self {
        // Padded outputs have weights and biases of 0, so that their value is 0 after ReLU.
        let groups = layer.outputs.div_ceil(GROUP);
        let of = |group: usize, value: &dyn Fn(usize) -> f32| -> [f32; GROUP] {
            std::array::from_fn(|k| {
                let output = group * GROUP + k;
                if output < layer.outputs { value(output) } else { 0.0 }
            })
        };
        let weights = (0..groups * inputs).map(|at| {
            let group = at / inputs;
            let input = at % inputs;
            let weight = |output: usize| {
                source(input).map_or(0.0, |source| layer.weight[output * layer.inputs + source])
            };
            of(group, &weight)
        });
        let weight = weights.collect();
        Self { inputs, weight, bias: (0..groups).map(|group| of(group, &bias)).collect() }
    }

    #[inline(always)]
    fn apply<S: Simd, const RELU: bool>(&self, simd: S, from: &[Lanes], to: &mut [Lanes]) {
        let zero = f32x16::splat(simd, 0.0);
        let groups = self.weight.chunks_exact(self.inputs).zip(&self.bias);
        for ((weights, bias), to) in groups.zip(to.chunks_exact_mut(GROUP)) {
            // Sixteen directions times eight outputs: 8 vectors of 16 sums stay in registers.
            let mut sums = [zero; GROUP];
            for k in 0..GROUP {
                sums[k] = f32x16::splat(simd, bias[k]);
            }
            // One load of an input serves eight outputs.
            for (weight, value) in weights.iter().zip(from) {
                let value = f32x16::load_array_ref(simd, &value.0);
                for k in 0..GROUP {
                    sums[k] = f32x16::splat(simd, weight[k]).mul_add(value, sums[k]);
                }
            }
            for k in 0..GROUP {
                let sum = if RELU { sums[k].max(zero) } else { sums[k] };
                sum.store_array(&mut to[k].0);
            }
        }
    }
}

/// `sin(x + quarter π)`: the sine for `quarter` 0, the cosine for 0.5. The error is below 1.5e-7
/// for |x| up to 1,000.
///
/// Range reduction after Cody and Waite: subtract the nearest multiple of π (for the cosine, of π
/// shifted by π/2), with π split into three parts of which the first two have so few bits that
/// their products are exact. Then a minimax polynomial of degree 9, with an error of 5e-9 on [-π/2,
/// π/2]. Adding π/2 to x for the cosine would instead cost a rounding error of 4e-6 at x = 64.
#[inline(always)]
fn sine<S: Simd>(simd: S, x: f32x16<S>, quarter: f32) -> f32x16<S> {
    let splat = |value: f32| f32x16::splat(simd, value);
    let whole = x.mul_add(splat(std::f32::consts::FRAC_1_PI), splat(0.5 - quarter)).floor();
    let turns = -(whole + splat(quarter));
    // π = 3.140625 + 9.67741e-4 - 8.742278e-8, the largest part first. The products of the first
    // two are exact.
    let r = turns.mul_add(splat(3.140_625), x);
    let r = turns.mul_add(splat(9.677_41e-4), r);
    let r = turns.mul_add(splat(-8.742_278e-8), r);
    // Odd polynomial r + r³ P(r²), evaluated from the highest power.
    let square = r * r;
    let fit = square
        .mul_add(splat(2.600_054_6e-6), splat(-1.980_661_5e-4))
        .mul_add(square, splat(8.333_017e-3))
        .mul_add(square, splat(-1.666_665_7e-1));
    let sine = (fit * square).mul_add(r, r);
    // The sign flips with every multiple of π. For the cosine it flips once more, since it falls
    // where the sine of the remainder rises.
    let half_turns: i32x16<S> = whole.to_int();
    let odd = if quarter > 0.0 { half_turns + 1 } else { half_turns };
    let bits: i32x16<S> = sine.bitcast();
    (bits ^ (odd << 31)).bitcast()
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;

    #[test]
    fn sine_and_cosine_are_accurate() {
        // From -100 to 100, beyond the argument of 64 that seven octaves reach.
        for i in -64_000..=64_000 {
            let x = i as f32 / 640.0;
            for (quarter, truth) in [(0.0, f64::from(x).sin()), (0.5, f64::from(x).cos())] {
                let value = dispatch!(Level::new(), simd => {
                    sine(simd, f32x16::splat(simd, x), quarter).to_array()[0]
                });
                let off = (f64::from(value) - truth).abs();
                assert!(off < 1.5e-7, "{x}, {quarter}: {value}, truly {truth}");
            }
        }
    }
}
