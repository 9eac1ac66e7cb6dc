//! A small sky network, as tensors of a checkpoint.

use crate::scene_files::Tensor;

/// A small network with small weights, which depend on `seed`.
pub(crate) fn tensors(seed: usize) -> Vec<Tensor> {
    let tensor = |name: &'static str, shape: &[usize]| {
        let count: usize = shape.iter().product();
        let values = (0..count).map(|i| 0.1 * (((i + seed) * 7 % 11) as f64 - 5.0)).collect();
        (name, shape.to_vec(), values)
    };
    vec![
        tensor("sky_head.layers.0.weight", &[8, 9]),
        tensor("sky_head.layers.0.bias", &[8]),
        tensor("sky_head.layers.1.weight", &[8, 17]),
        tensor("sky_head.layers.1.bias", &[8]),
        tensor("sky_head.layers.2.weight", &[3, 8]),
        tensor("sky_head.layers.2.bias", &[3]),
    ]
}
