//! Graphs that replace models in tests. Each has one property.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use crate::onnx_protobuf::{
    BOOL, Dim, F16, F32, Graph, I64, Message, floats, graph_attribute, int, ints, node, port,
    tensor,
};

const IMAGE: [Dim; 4] = [Some(1), Some(3), None, None];

/// One input, one output, both RGB in f32.
fn rgb(nodes: Vec<Message>, constants: Vec<Message>) -> Vec<u8> {
    let inputs = vec![port("image", F32, &IMAGE)];
    let outputs = vec![port("repaired", F32, &[Some(1), None, None, None])];
    Graph { nodes, constants, inputs, outputs }.onnx()
}

/// The image itself.
pub(crate) fn identity() -> Vec<u8> {
    rgb(vec![node("Identity", &["image"], &["repaired"], &[])], Vec::new())
}

/// The image, times or plus a number.
pub(crate) fn arithmetic(operator: &str, value: f32) -> Vec<u8> {
    rgb(
        vec![node(operator, &["image", "value"], &["repaired"], &[])],
        vec![floats("value", &[], &[value])],
    )
}

/// A value of 0.5 or more becomes NaN: the square root of 0.49 - value.
pub(crate) fn nan_where_bright() -> Vec<u8> {
    let nodes = vec![
        node("Sub", &["limit", "image"], &["left"], &[]),
        node("Sqrt", &["left"], &["repaired"], &[]),
    ];
    rgb(nodes, vec![floats("limit", &[], &[0.49])])
}

/// The image without its first row, which shows only when it runs.
pub(crate) fn without_a_row() -> Vec<u8> {
    let index = |name: &str, value: u64| tensor(name, I64, &[1], &value.to_le_bytes());
    let constants = vec![index("from", 1), index("to", 1 << 40), index("rows", 2)];
    rgb(vec![node("Slice", &["image", "from", "to", "rows"], &["repaired"], &[])], constants)
}

/// Six channels.
pub(crate) fn six_channels() -> Vec<u8> {
    rgb(vec![node("Concat", &["image", "image"], &["repaired"], &[int("axis", 1)])], Vec::new())
}

/// A convolution of `side` x `side`, with a stride of `stride` down and up again. Its halo is
/// known.
pub(crate) fn convolution(side: usize, stride: usize) -> Vec<u8> {
    let pad = (side / 2) as u64;
    // Depthwise: each channel by itself, weights that are all different.
    let count = 3 * side * side;
    let weights: Vec<f32> = (0..count).map(|at| ((at * 37 % 101) as f32 - 50.0) / 500.0).collect();
    let constants = vec![floats("w", &[3, 1, side as u64, side as u64], &weights)];
    let attributes = [
        ints("pads", &[pad, pad, pad, pad]),
        ints("strides", &[stride as u64, stride as u64]),
        int("group", 3),
    ];
    let mut nodes = vec![node("Conv", &["image", "w"], &["small"], &attributes)];
    let mut constants = constants;
    if stride == 1 {
        nodes.push(node("Identity", &["small"], &["repaired"], &[]));
    } else {
        // Each value becomes a block: a transposed convolution with ones.
        constants.push(floats(
            "ones",
            &[3, 1, stride as u64, stride as u64],
            &vec![1.0; 3 * stride * stride],
        ));
        let attributes = [ints("strides", &[stride as u64, stride as u64]), int("group", 3)];
        nodes.push(node("ConvTranspose", &["small", "ones"], &["repaired"], &attributes));
    }
    rgb(nodes, constants)
}

/// Every output pixel depends on every input pixel.
pub(crate) fn global() -> Vec<u8> {
    let nodes = vec![
        node("GlobalAveragePool", &["image"], &["mean"], &[]),
        node("Sub", &["image", "mean"], &["repaired"], &[]),
    ];
    rgb(nodes, Vec::new())
}

/// Adds 1e-9 a trillion times, in a loop that looks at the image: it never ends.
pub(crate) fn endless() -> Vec<u8> {
    let trips = tensor("trips", I64, &[], &1_000_000_000_000_u64.to_le_bytes());
    add_in_a_loop(Vec::new(), vec![trips])
}

/// The same if a value is 0.9 or more; else the image itself.
pub(crate) fn endless_if_bright() -> Vec<u8> {
    let nodes = vec![
        node("ReduceMax", &["image"], &["max"], &[int("keepdims", 0)]),
        node("Div", &["max", "limit"], &["ratio"], &[]),
        node("Floor", &["ratio"], &["is_bright"], &[]),
        node("Mul", &["is_bright", "many"], &["count"], &[]),
        node("Cast", &["count"], &["trips"], &[int("to", I64)]),
    ];
    add_in_a_loop(nodes, vec![floats("limit", &[], &[0.9]), floats("many", &[], &[1e12])])
}

/// The image itself if the trust is above 0.4; under it a loop that never ends. Its inputs are
/// `image` and `trust`.
pub(crate) fn endless_if_doubtful() -> Vec<u8> {
    let nodes = vec![
        node("ReduceMax", &["trust"], &["max"], &[int("keepdims", 0)]),
        node("Div", &["limit", "max"], &["ratio"], &[]),
        node("Floor", &["ratio"], &["is_doubtful"], &[]),
        node("Mul", &["is_doubtful", "many"], &["count"], &[]),
        node("Cast", &["count"], &["trips"], &[int("to", I64)]),
    ];
    let constants = vec![floats("limit", &[], &[0.4]), floats("many", &[], &[1e12])];
    graph_in_a_loop(nodes, constants, vec![port("trust", F32, &[Some(1), Some(1)])])
}

/// A brighter image if the trust is above 0.4, NaN under it. Its inputs are `image` and `trust`.
pub(crate) fn nan_if_doubtful() -> Vec<u8> {
    let nodes = vec![
        node("Sub", &["trust", "limit"], &["spare"], &[]),
        node("Sqrt", &["spare"], &["root"], &[]),
        node("ReduceMax", &["root"], &["more"], &[int("keepdims", 0)]),
        node("Add", &["image", "more"], &["repaired"], &[]),
    ];
    Graph {
        nodes,
        constants: vec![floats("limit", &[], &[0.4])],
        inputs: vec![port("image", F32, &IMAGE), port("trust", F32, &[Some(1), Some(1)])],
        outputs: vec![port("repaired", F32, &[Some(1), None, None, None])],
    }
    .onnx()
}

/// A loop with `trips` iterations.
fn add_in_a_loop(nodes: Vec<Message>, constants: Vec<Message>) -> Vec<u8> {
    graph_in_a_loop(nodes, constants, Vec::new())
}

/// As [`add_in_a_loop`], with inputs in addition to the image.
fn graph_in_a_loop(
    mut nodes: Vec<Message>,
    mut constants: Vec<Message>,
    more_inputs: Vec<Message>,
) -> Vec<u8> {
    let body = Graph {
        nodes: vec![
            node("Identity", &["go_on"], &["go_on_out"], &[]),
            node("Add", &["sum", "step"], &["sum_out"], &[]),
        ],
        constants: vec![floats("step", &[], &[1e-9])],
        inputs: vec![
            port("iteration", I64, &[]),
            port("go_on", BOOL, &[]),
            port("sum", F32, &IMAGE),
        ],
        outputs: vec![port("go_on_out", BOOL, &[]), port("sum_out", F32, &IMAGE)],
    };
    let body = graph_attribute("body", &body.message());
    nodes.push(node("Loop", &["trips", "go", "image"], &["repaired"], &[body]));
    constants.push(tensor("go", BOOL, &[], &[1]));
    let inputs = [vec![port("image", F32, &IMAGE)], more_inputs].concat();
    let outputs = vec![port("repaired", F32, &[Some(1), None, None, None])];
    Graph { nodes, constants, inputs, outputs }.onnx()
}

/// The image and 0.02 of `depth`, 0.5 of `opacity` and 0.2 of `normals`.
pub(crate) fn sum_of_maps() -> Vec<u8> {
    let weighted = |map: &'static str, weight: &'static str, product: &'static str| {
        node("Mul", &[map, weight], &[product], &[])
    };
    let map = |name: &str, channels: u64| port(name, F32, &[Some(1), Some(channels), None, None]);
    Graph {
        nodes: vec![
            weighted("depth", "of_depth", "a"),
            weighted("opacity", "of_opacity", "b"),
            weighted("normals", "of_normals", "c"),
            node("Sum", &["image", "a", "b", "c"], &["repaired"], &[]),
        ],
        constants: vec![
            floats("of_depth", &[], &[0.02]),
            floats("of_opacity", &[], &[0.5]),
            floats("of_normals", &[], &[0.2]),
        ],
        inputs: vec![map("image", 3), map("depth", 1), map("opacity", 1), map("normals", 3)],
        outputs: vec![port("repaired", F32, &[Some(1), None, None, None])],
    }
    .onnx()
}

/// The signature of Difix: `image` and `reference` in f16, -1 to 1. The reference works on all
/// pixels, as attention does: its mean is added, weighted by a constant `strength`.
pub(crate) fn difix() -> Vec<u8> {
    let half = |value: f32| half::f16::from_f32(value).to_le_bytes();
    Graph {
        nodes: vec![
            node("GlobalAveragePool", &["reference"], &["mean"], &[]),
            node("Sub", &["mean", "image"], &["to_mean"], &[]),
            node("Mul", &["to_mean", "strength"], &["change"], &[]),
            node("Add", &["image", "change"], &["sum"], &[]),
            node("Clip", &["sum", "low", "high"], &["repaired"], &[]),
        ],
        constants: vec![tensor("low", F16, &[], &half(-1.0)), tensor("high", F16, &[], &half(1.0))],
        inputs: vec![
            port("image", F16, &IMAGE),
            port("reference", F16, &IMAGE),
            port("strength", F16, &[]),
        ],
        outputs: vec![port("repaired", F16, &IMAGE)],
    }
    .onnx()
}

/// `warped` where `valid` is 1, else `image`. These are its inputs.
pub(crate) fn warped_where_valid() -> Vec<u8> {
    let map = |name: &str, channels: u64| port(name, F32, &[Some(1), Some(channels), None, None]);
    Graph {
        nodes: vec![
            node("Mul", &["warped", "valid"], &["seen"], &[]),
            node("Sub", &["one", "valid"], &["unseen"], &[]),
            node("Mul", &["image", "unseen"], &["rest"], &[]),
            node("Add", &["seen", "rest"], &["repaired"], &[]),
        ],
        constants: vec![floats("one", &[], &[1.0])],
        inputs: vec![map("image", 3), map("warped", 3), map("valid", 1)],
        outputs: vec![port("repaired", F32, &[Some(1), None, None, None])],
    }
    .onnx()
}

/// The mean absolute difference of `image` and `truth`: one number.
pub(crate) fn distance() -> Vec<u8> {
    Graph {
        nodes: vec![
            node("Sub", &["image", "truth"], &["difference"], &[]),
            node("Abs", &["difference"], &["absolute"], &[]),
            node("GlobalAveragePool", &["absolute"], &["channels"], &[]),
            node("ReduceMean", &["channels"], &["distance"], &[int("keepdims", 0)]),
        ],
        constants: Vec::new(),
        inputs: vec![port("image", F32, &IMAGE), port("truth", F32, &IMAGE)],
        outputs: vec![port("distance", F32, &[])],
    }
    .onnx()
}

/// The mean of each channel of `image`: three features.
pub(crate) fn mean_color() -> Vec<u8> {
    Graph {
        nodes: vec![node("GlobalAveragePool", &["image"], &["features"], &[])],
        constants: Vec::new(),
        inputs: vec![port("image", F32, &IMAGE)],
        outputs: vec![port("features", F32, &[Some(1), Some(3), Some(1), Some(1)])],
    }
    .onnx()
}
