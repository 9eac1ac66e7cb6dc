//! Writes ONNX graphs: the few messages of onnx.proto3 that the tests need, by their field numbers.

#![allow(dead_code, reason = "every test binary uses another part of it")]

/// A message as bytes.
#[derive(Clone, Debug, Default)]
pub(crate) struct Message(pub(crate) Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    /// A number (wire type 0).
    pub(crate) fn number(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    /// Bytes, text or a message (wire type 2).
    pub(crate) fn bytes(mut self, field: u64, bytes: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(bytes.len() as u64);
        self.0.extend_from_slice(bytes);
        self
    }

    pub(crate) fn text(self, field: u64, text: &str) -> Self {
        self.bytes(field, text.as_bytes())
    }

    pub(crate) fn message(self, field: u64, message: &Message) -> Self {
        self.bytes(field, &message.0)
    }
}

/// `TensorProto.DataType`.
pub(crate) const F32: u64 = 1;
pub(crate) const I64: u64 = 7;
pub(crate) const BOOL: u64 = 9;
pub(crate) const F16: u64 = 10;

/// An initializer.
pub(crate) fn tensor(name: &str, data_type: u64, dims: &[u64], bytes: &[u8]) -> Message {
    let tensor = dims.iter().fold(Message::default(), |tensor, dim| tensor.number(1, *dim));
    tensor.number(2, data_type).text(8, name).bytes(9, bytes)
}

pub(crate) fn floats(name: &str, dims: &[u64], values: &[f32]) -> Message {
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    tensor(name, F32, dims, &bytes)
}

/// A node with attributes.
pub(crate) fn node(
    operator: &str,
    inputs: &[&str],
    outputs: &[&str],
    attributes: &[Message],
) -> Message {
    let node = inputs.iter().fold(Message::default(), |node, name| node.text(1, name));
    let node = outputs.iter().fold(node, |node, name| node.text(2, name)).text(4, operator);
    attributes.iter().fold(node, |node, attribute| node.message(5, attribute))
}

pub(crate) fn ints(name: &str, values: &[u64]) -> Message {
    let attribute =
        values.iter().fold(Message::default().text(1, name), |a, value| a.number(8, *value));
    attribute.number(20, 7)
}

pub(crate) fn int(name: &str, value: u64) -> Message {
    Message::default().text(1, name).number(3, value).number(20, 2)
}

pub(crate) fn graph_attribute(name: &str, graph: &Message) -> Message {
    Message::default().text(1, name).message(6, graph).number(20, 5)
}

/// A dimension: a size, or any.
pub(crate) type Dim = Option<u64>;

/// An input or output.
pub(crate) fn port(name: &str, data_type: u64, dims: &[Dim]) -> Message {
    let shape = dims.iter().enumerate().fold(Message::default(), |shape, (at, dim)| {
        let dim = match dim {
            Some(size) => Message::default().number(1, *size),
            None => Message::default().text(2, &format!("{name}_{at}")),
        };
        shape.message(1, &dim)
    });
    let tensor = Message::default().number(1, data_type).message(2, &shape);
    Message::default().text(1, name).message(2, &Message::default().message(1, &tensor))
}

/// Contents of a graph.
#[derive(Default)]
pub(crate) struct Graph {
    pub(crate) nodes: Vec<Message>,
    pub(crate) constants: Vec<Message>,
    pub(crate) inputs: Vec<Message>,
    pub(crate) outputs: Vec<Message>,
}

impl Graph {
    pub(crate) fn message(&self) -> Message {
        let graph =
            self.nodes.iter().fold(Message::default(), |graph, node| graph.message(1, node));
        let graph = graph.text(2, "double");
        let graph = self.constants.iter().fold(graph, |graph, tensor| graph.message(5, tensor));
        let graph = self.inputs.iter().fold(graph, |graph, port| graph.message(11, port));
        self.outputs.iter().fold(graph, |graph, port| graph.message(12, port))
    }

    /// The bytes of an .onnx file: IR version 8, opset 17.
    pub(crate) fn onnx(&self) -> Vec<u8> {
        let opset = Message::default().text(1, "").number(2, 17);
        Message::default().number(1, 8).message(7, &self.message()).message(8, &opset).0
    }
}
