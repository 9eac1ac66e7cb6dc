//! A sky as a file.

use std::collections::HashMap;

use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, TensorView};
use wildcity_scene::sky::Network;

/// A sky as `wildcity import --sky` reads it: the tensors of drivestudio, with one appearance.
///
/// # Errors
/// The layers of the network do not have their shapes, which [`Network::new`] checks.
pub fn sky_file(network: &Network) -> Result<Vec<u8>, SafeTensorError> {
    let bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let mut tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
    for (number, layer) in network.layers().iter().enumerate() {
        let name = |part: &str| format!("sky_head.layers.{number}.{part}");
        tensors.push((name("weight"), vec![layer.outputs, layer.inputs], bytes(&layer.weight)));
        tensors.push((name("bias"), vec![layer.outputs], bytes(&layer.bias)));
    }
    let appearance = network.appearance();
    if !appearance.is_empty() {
        let name = "appearance_embedding.weight".to_owned();
        tensors.push((name, vec![1, appearance.len()], bytes(appearance)));
    }
    let mut views = HashMap::new();
    for (name, shape, bytes) in &tensors {
        views.insert(name.clone(), TensorView::new(Dtype::F32, shape.clone(), bytes)?);
    }
    safetensors::serialize(&views, None)
}
