//! Compares the manifest with the inputs and outputs of the graph.

use std::path::Path;

use crate::error::RepairError;
use crate::manifest::{Dtype, Input, InputRole, Layout, Manifest};
use crate::onnx::{Graph, Port};

/// Checks names, types and ranks.
pub(crate) fn check(manifest: &Manifest, graph: &Graph, file: &Path) -> Result<(), RepairError> {
    let wrong = |field: String, message: String| {
        Err(RepairError::Manifest { file: file.to_owned(), field, message })
    };
    let names = |ports: &[Port]| {
        let names: Vec<String> = ports.iter().map(|port| format!("{:?}", port.name)).collect();
        names.join(", ")
    };
    for (at, input) in manifest.inputs.iter().enumerate() {
        let field = |name: &str| format!("inputs[{at}].{name}");
        let Some(port) = graph.inputs.iter().find(|port| port.name == input.name) else {
            let message = format!("{:?}; the graph has {}", input.name, names(&graph.inputs));
            return wrong(field("name"), message);
        };
        if port.dtype != Some(input.dtype) {
            let message =
                format!("{:?}; the graph has {}", input.dtype, port.type_name).to_lowercase();
            return wrong(field("dtype"), message);
        }
        if let Some(message) = wrong_shape(&port.shape, &promised(manifest, input)) {
            return wrong(field("role"), message);
        }
    }
    let is_listed = |port: &&Port| !manifest.inputs.iter().any(|input| input.name == port.name);
    // An input without an entry would get no value, and the run fail.
    if let Some(port) = graph.inputs.iter().find(is_listed) {
        return wrong("inputs".to_owned(), format!("{:?} of the graph has no entry", port.name));
    }
    let output = manifest.output();
    let Some(port) = graph.outputs.iter().find(|port| port.name == output.name) else {
        let message = format!("{:?}; the graph has {}", output.name, names(&graph.outputs));
        return wrong("outputs[0].name".to_owned(), message);
    };
    if !matches!(port.dtype, Some(Dtype::F32 | Dtype::F16)) {
        let message = format!("{} in the graph; f32 or f16 is read", port.type_name);
        return wrong("outputs[0].name".to_owned(), message);
    }
    let scale = i64::from(output.scale);
    let sides =
        // -1 for any size: then only rank and channels are compared.
        manifest.size.fixed.map_or([-1, -1], |sides| sides.map(|side| i64::from(side) * scale));
    let shape = image_shape(manifest.layout, output.role.channels() as i64, sides);
    match wrong_shape(&port.shape, &shape) {
        Some(message) => wrong("outputs[0].role".to_owned(), message),
        None => Ok(()),
    }
}

/// The shape of an input, -1 where the size of the image decides.
fn promised(manifest: &Manifest, input: &Input) -> Vec<i64> {
    match (input.role, input.role.channels()) {
        (_, Some(channels)) => {
            let sides = manifest.size.fixed.map_or([-1, -1], |sides| sides.map(i64::from));
            image_shape(manifest.layout, channels as i64, sides)
        }
        (InputRole::Trust, _) => vec![1, 1],
        _ => input.shape.iter().map(|side| i64::from(*side)).collect(),
    }
}

/// The shape of an image for the graph.
pub(crate) fn image_shape(layout: Layout, channels: i64, [height, width]: [i64; 2]) -> Vec<i64> {
    match layout {
        Layout::Nchw => vec![1, channels, height, width],
        Layout::Nhwc => vec![1, height, width, channels],
    }
}

/// The error in a shape of the graph, if any. -1 in the graph agrees with every size; -1 in the
/// manifest does not agree with a fixed size in the graph, because images have different sizes. A
/// shape of rank 0 may be one that the graph does not declare, so the probe run decides.
fn wrong_shape(graph: &[i64], manifest: &[i64]) -> Option<String> {
    if graph.is_empty() {
        return None;
    }
    let agrees = |(a, b): (&i64, &i64)| *a == -1 || a == b;
    let is_equal = graph.len() == manifest.len() && graph.iter().zip(manifest).all(agrees);
    (!is_equal).then(|| {
        format!(
            "the role has the shape {manifest:?}, the graph {graph:?}; correct role, layout or size"
        )
    })
}
