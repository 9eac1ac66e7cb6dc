//! The manifest of a model: the meaning of its inputs, the sizes that it takes, and how its output
//! is merged.

use serde::{Deserialize, Serialize};

/// A model as its manifest describes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The format, which must be [`Manifest::FORMAT`].
    pub format: String,
    /// The name that sessions ask for.
    pub name: String,
    /// The version of the model, as its author counts.
    pub version: String,
    /// The licence of the weights.
    pub licence: String,
    /// The .onnx file, then files of external weights.
    pub files: Vec<ModelFile>,
    /// The providers on which the model may run. The first is the default; there is no fall-back to
    /// another.
    pub providers: Vec<Provider>,
    /// GPU memory that the provider may take, in MiB.
    #[serde(default = "default_memory_mib")]
    pub memory_mib: u32,
    /// Longest run of one image or tile.
    pub timeout_ms: u64,
    /// The sizes that the model takes.
    pub size: Size,
    /// How the output becomes the image.
    pub merge: Merge,
    /// Order of the axes of images.
    #[serde(default)]
    pub layout: Layout,
    /// The inputs of the graph.
    pub inputs: Vec<Input>,
    /// The output of the graph: exactly one is used.
    pub outputs: Vec<Output>,
}

pub(crate) fn default_memory_mib() -> u32 {
    4096
}

/// A file of the model, pinned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// Name in the manifest's folder.
    pub path: String,
    /// BLAKE3 of the content, 64 hexadecimal digits.
    pub blake3: String,
}

/// Execution providers of ONNX Runtime.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// The processor. The same input gives the same bytes.
    Cpu,
    Cuda,
    /// NVIDIA TensorRT, and CUDA for the nodes that it does not support.
    Tensorrt,
}

impl Provider {
    /// As in the manifest.
    pub fn name(self) -> &'static str {
        match self {
            Provider::Cpu => "cpu",
            Provider::Cuda => "cuda",
            Provider::Tensorrt => "tensorrt",
        }
    }
}

/// The sizes that a model takes, in pixels: either `fixed` or `multiple_of`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Size {
    /// Height and width, if the model takes no other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fixed: Option<[u32; 2]>,
    /// Both sides must be multiples of this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub multiple_of: Option<u32>,
    /// How an image becomes such a size.
    pub fit: Fit,
    /// For `resize`: approximate number of pixels that the model should see.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixels: Option<u32>,
    /// For `tile` with `multiple_of`: height and width of a tile, its halo included.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tile: Option<[u32; 2]>,
}

/// How an image becomes a size that the model takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// Mirrored on the right and below; cut off afterwards.
    Pad,
    /// Resampled with Lanczos 3, there and back.
    Resize,
    /// Cut into tiles that overlap by the measured halo: equal to the whole, to the bit.
    Tile,
}

/// How the output becomes the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Merge {
    /// The output is the image.
    Replace,
    /// rendered + (output - input of the model): a model that changes nothing changes no byte.
    Residual,
}

/// Order of the axes of images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// Batch, channel, row, column.
    #[default]
    Nchw,
    /// Batch, row, column, channel.
    Nhwc,
}

/// An input of the graph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Its name in the graph.
    pub name: String,
    pub role: InputRole,
    /// Its type in the graph.
    #[serde(default)]
    pub dtype: Dtype,
    /// For images: the values of black and white.
    #[serde(default = "default_range")]
    pub range: [f32; 2],
    /// For `depth`: its unit.
    #[serde(default)]
    pub unit: Unit,
    /// For `constant`: the value of all its elements.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// For `constant`: its shape; empty for a scalar.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shape: Vec<u32>,
}

fn default_range() -> [f32; 2] {
    [0.0, 1.0]
}

/// What an input of the graph means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InputRole {
    /// The rendered image, 3 channels.
    Rgb,
    /// Its luma (BT.601, full range), 1 channel; chroma is resampled without the model.
    Luma,
    /// A recorded image nearby, 3 channels.
    Reference,
    /// Recorded images warped into the view, 3 channels.
    ReferenceWarped,
    /// 1 where `reference_warped` has a value, else 0, 1 channel.
    ReferenceValid,
    /// Distance along the camera's axis, 1 channel, in the unit of the input.
    Depth,
    /// Accumulated opacity from 0 to 1, 1 channel.
    Opacity,
    /// Unit vectors in the camera's axes, 3 channels.
    Normals,
    /// Field of the lens, 1 channel.
    Mask,
    /// Trust of the whole image, of shape \[batch, 1\].
    Trust,
    /// One value everywhere, such as a time step.
    Constant,
}

impl InputRole {
    /// As in the manifest.
    pub fn name(self) -> &'static str {
        match self {
            InputRole::Rgb => "rgb",
            InputRole::Luma => "luma",
            InputRole::Reference => "reference",
            InputRole::ReferenceWarped => "reference_warped",
            InputRole::ReferenceValid => "reference_valid",
            InputRole::Depth => "depth",
            InputRole::Opacity => "opacity",
            InputRole::Normals => "normals",
            InputRole::Mask => "mask",
            InputRole::Trust => "trust",
            InputRole::Constant => "constant",
        }
    }

    /// Channels of an input that has pixels.
    pub fn channels(self) -> Option<usize> {
        match self {
            InputRole::Rgb | InputRole::Reference | InputRole::ReferenceWarped => Some(3),
            InputRole::Normals => Some(3),
            InputRole::Luma | InputRole::ReferenceValid | InputRole::Depth => Some(1),
            InputRole::Opacity | InputRole::Mask => Some(1),
            InputRole::Trust | InputRole::Constant => None,
        }
    }
}

/// Type of an input in the graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Dtype {
    /// 32 bits (IEEE single).
    #[default]
    F32,
    /// 16 bits (IEEE half).
    F16,
    /// 64 bits; only for `constant`.
    I64,
}

/// Unit of the input `depth`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// Metres; 0 where there is no surface.
    #[default]
    Metre,
    /// 1 / metres; 0 where there is no surface.
    Inverse,
}

/// The output of the graph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Its name in the graph.
    pub name: String,
    pub role: OutputRole,
    /// The values of black and white.
    #[serde(default = "default_range")]
    pub range: [f32; 2],
    /// Scale of the output relative to the input.
    #[serde(default = "default_scale")]
    pub scale: u32,
}

fn default_scale() -> u32 {
    1
}

/// What the output of the graph means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputRole {
    /// An image, 3 channels.
    Rgb,
    /// Its luma, 1 channel.
    Luma,
    /// A residual that is added to the image, 3 channels, in units of `range`.
    Residual,
}

impl OutputRole {
    /// Channels of the output.
    pub fn channels(self) -> usize {
        if self == OutputRole::Luma { 1 } else { 3 }
    }
}

impl Size {
    /// The sides must be multiples of this, in pixels; 1 if the size is fixed.
    pub(crate) fn multiple(&self) -> usize {
        self.multiple_of.unwrap_or(1) as usize
    }
}

impl Manifest {
    /// Value of the field `format` of a manifest.
    pub const FORMAT: &str = "wildcity.repair/1";

    /// The input of the image itself.
    pub(crate) fn image_input(&self) -> &Input {
        let is_image = |input: &&Input| matches!(input.role, InputRole::Rgb | InputRole::Luma);
        // `check_inputs` demands exactly one; the first input is never taken in its place.
        self.inputs.iter().find(is_image).unwrap_or(&self.inputs[0])
    }

    pub(crate) fn output(&self) -> &Output {
        &self.outputs[0]
    }
}
