//! The parts of a glTF document that splats need; others are skipped. The gltf crate drops
//! attributes that core glTF does not define, so splats have a document type of their own.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::EXTENSION;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document {
    /// Extensions without which the document is another scene.
    #[serde(default)]
    pub(super) extensions_required: Vec<String>,
    pub(super) scene: Option<usize>,
    #[serde(default)]
    pub(super) scenes: Vec<Scene>,
    #[serde(default)]
    pub(super) nodes: Vec<Node>,
    #[serde(default)]
    pub(super) meshes: Vec<Mesh>,
    #[serde(default)]
    pub(super) accessors: Vec<Accessor>,
    #[serde(default)]
    pub(super) buffer_views: Vec<BufferView>,
    #[serde(default)]
    pub(super) buffers: Vec<Buffer>,
    #[serde(default)]
    pub(super) animations: Vec<serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
pub(super) struct Scene {
    #[serde(default)]
    pub(super) nodes: Vec<usize>,
}

#[derive(Deserialize)]
pub(super) struct Node {
    pub(super) mesh: Option<usize>,
    #[serde(default)]
    pub(super) children: Vec<usize>,
    pub(super) matrix: Option<[f64; 16]>,
    pub(super) translation: Option<[f64; 3]>,
    /// x, y, z, w.
    pub(super) rotation: Option<[f64; 4]>,
    pub(super) scale: Option<[f64; 3]>,
    pub(super) skin: Option<serde::de::IgnoredAny>,
    #[serde(default)]
    pub(super) extensions: BTreeMap<String, serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
pub(super) struct Mesh {
    pub(super) primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
pub(super) struct Primitive {
    pub(super) attributes: BTreeMap<String, usize>,
    #[serde(default)]
    pub(super) extensions: BTreeMap<String, Value>,
    /// Shapes that an animation mixes in.
    #[serde(default)]
    pub(super) targets: Vec<serde::de::IgnoredAny>,
}

impl Primitive {
    /// The extension that compresses the attributes, if there is one, and its settings.
    pub(super) fn compressed_by(&self) -> Option<(&str, &Value)> {
        let inner = self.extensions.get(EXTENSION)?.get("extensions")?.as_object()?;
        inner
            .iter()
            .map(|(name, settings)| (name.as_str(), settings))
            .find(|(name, _)| name.contains("compression"))
    }
}

impl Document {
    /// The bytes of a buffer view; `None` if it does not exist, or does not fit its buffer.
    pub(super) fn view_bytes<'a>(&self, buffers: &[&'a [u8]], index: usize) -> Option<&'a [u8]> {
        let view = self.buffer_views.get(index)?;
        let start = usize::try_from(view.byte_offset).ok()?;
        let end = start.checked_add(usize::try_from(view.byte_length).ok()?)?;
        buffers.get(view.buffer)?.get(start..end)
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub(super) buffer_view: Option<usize>,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) component_type: u32,
    #[serde(default)]
    pub(super) normalized: bool,
    pub(super) count: u64,
    #[serde(rename = "type")]
    pub(super) kind: String,
    pub(super) sparse: Option<serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    pub(super) buffer: usize,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) byte_length: u64,
    pub(super) byte_stride: Option<u64>,
    #[serde(default)]
    pub(super) extensions: BTreeMap<String, serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer {
    pub(super) uri: Option<String>,
    pub(super) byte_length: u64,
}
