//! The manifest of a model: what its inputs mean, which sizes it takes, how its output is merged.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::RepairError;
use crate::limits::{
    MAX_CONSTANT_VALUES, MAX_FILES, MAX_INPUTS, MAX_MULTIPLE_PX, MAX_SCALE, MAX_SIDE_PX,
    MAX_TIMEOUT_MS,
};

/// A model as its manifest describes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`Manifest::FORMAT`].
    pub format: String,
    /// The name that sessions ask for.
    pub name: String,
    /// The version of the model, as its author counts.
    pub version: String,
    /// The licence of the weights.
    pub licence: String,
    /// The .onnx file, then files of external weights.
    pub files: Vec<ModelFile>,
    /// Where the model may run. The first is the default; there is no fall-back to another.
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

fn default_memory_mib() -> u32 {
    4096
}

/// A file of the model, pinned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// Beside the manifest: a name without folders.
    pub path: String,
    /// BLAKE3 of the content, 64 hexadecimal digits.
    pub blake3: String,
}

/// What computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// The processor. The same input gives the same bytes.
    Cpu,
    /// NVIDIA CUDA.
    Cuda,
    /// NVIDIA TensorRT, and CUDA for what it does not take.
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
    /// Of `resize`: pixels that the model should see, about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixels: Option<u32>,
    /// Of `tile` with `multiple_of`: height and width of a tile, its halo included.
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
    /// rendered + (output - what the model got): a model that changes nothing changes no byte.
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
    /// What it means.
    pub role: InputRole,
    /// Its type in the graph.
    #[serde(default)]
    pub dtype: Dtype,
    /// Of images: the values of black and white.
    #[serde(default = "default_range")]
    pub range: [f32; 2],
    /// Of `depth`.
    #[serde(default)]
    pub unit: Unit,
    /// Of `constant`: each of its values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Of `constant`: its shape; a scalar has none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shape: Vec<u32>,
}

fn default_range() -> [f32; 2] {
    [0.0, 1.0]
}

/// What an input means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InputRole {
    /// The rendered image, 3 channels.
    Rgb,
    /// Its luma (BT.601, full range), 1 channel; chroma is resampled beside the model.
    Luma,
    /// A recorded image nearby, 3 channels.
    Reference,
    /// Recorded images brought into the view, 3 channels.
    ReferenceWarped,
    /// Where `reference_warped` has a value, 1 channel.
    ReferenceValid,
    /// 1 channel, metres.
    Depth,
    /// 1 channel.
    Opacity,
    /// 3 channels.
    Normals,
    /// Field of the lens, 1 channel.
    Mask,
    /// Shape \[batch, 1\].
    Trust,
    /// The same value everywhere, such as a time step.
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
    /// 32 bits.
    #[default]
    F32,
    /// 16 bits (IEEE half).
    F16,
    /// 64 bits; of `constant` only.
    I64,
}

/// Unit of `depth`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// Metres; 0 where nothing is.
    #[default]
    Metre,
    /// 1 / metres; 0 where nothing is.
    Inverse,
}

/// The output of the graph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Its name in the graph.
    pub name: String,
    /// What it means.
    pub role: OutputRole,
    /// The values of black and white.
    #[serde(default = "default_range")]
    pub range: [f32; 2],
    /// Size of the output in sizes of the input.
    #[serde(default = "default_scale")]
    pub scale: u32,
}

fn default_scale() -> u32 {
    1
}

/// What an output means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputRole {
    /// An image, 3 channels.
    Rgb,
    /// Its luma, 1 channel.
    Luma,
    /// What is to be added to the image, 3 channels, in units of `range`.
    Residual,
}

impl OutputRole {
    /// Channels of the output.
    pub fn channels(self) -> usize {
        if self == OutputRole::Luma { 1 } else { 3 }
    }
}

impl Manifest {
    /// The field `format`.
    pub const FORMAT: &str = "wildcity.repair/1";

    /// Reads and checks the text of a manifest; `file` is named in errors.
    ///
    /// # Errors
    /// [`RepairError::Manifest`] with the field that is wrong.
    pub fn parse(bytes: &[u8], file: &Path) -> Result<Manifest, RepairError> {
        let wrong = |field: String, message: String| RepairError::Manifest {
            file: file.to_owned(),
            field,
            message,
        };
        let mut reader = serde_json::Deserializer::from_slice(bytes);
        let manifest: Manifest = serde_path_to_error::deserialize(&mut reader)
            .map_err(|error| wrong(error.path().to_string(), error.into_inner().to_string()))?;
        reader.end().map_err(|error| wrong("end".to_owned(), error.to_string()))?;
        manifest.check().map_err(|(field, message)| wrong(field, message))?;
        Ok(manifest)
    }

    /// The input of the image itself.
    pub(crate) fn image_input(&self) -> &Input {
        let is_image = |input: &&Input| matches!(input.role, InputRole::Rgb | InputRole::Luma);
        self.inputs.iter().find(is_image).unwrap_or(&self.inputs[0])
    }

    /// The output.
    pub(crate) fn output(&self) -> &Output {
        &self.outputs[0]
    }

    /// What the types do not say. The field and what is accepted.
    fn check(&self) -> Result<(), (String, String)> {
        let wrong = |field: &str, message: String| Err((field.to_owned(), message));
        if self.format != Manifest::FORMAT {
            let message = format!("{:?}; this program reads {:?}", self.format, Manifest::FORMAT);
            return wrong("format", message);
        }
        let is_letter = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if self.name.is_empty() || self.name.len() > 64 || !self.name.chars().all(is_letter) {
            let message = format!("{:?}; 1 to 64 letters, digits, '.', '_' and '-'", self.name);
            return wrong("name", message);
        }
        if self.providers.is_empty() {
            return wrong("providers", "empty; name \"cpu\", \"cuda\" or \"tensorrt\"".to_owned());
        }
        if !(1..=MAX_TIMEOUT_MS).contains(&self.timeout_ms) {
            let message = format!("{}; 1 to {MAX_TIMEOUT_MS}", self.timeout_ms);
            return wrong("timeout_ms", message);
        }
        if self.memory_mib == 0 {
            return wrong("memory_mib", "0; at least 1".to_owned());
        }
        self.check_files()?;
        self.check_size()?;
        self.check_inputs()?;
        self.check_output()
    }

    fn check_files(&self) -> Result<(), (String, String)> {
        if self.files.is_empty() || self.files.len() > MAX_FILES {
            let message =
                format!("{} files; name 1 to {MAX_FILES}, the .onnx file first", self.files.len());
            return Err(("files".to_owned(), message));
        }
        for (at, file) in self.files.iter().enumerate() {
            let is_name =
                Path::new(&file.path).file_name().is_some_and(|name| name == file.path.as_str());
            if !is_name {
                let message = format!("{:?}; the name of a file beside the manifest", file.path);
                return Err((format!("files[{at}].path"), message));
            }
            if blake3::Hash::from_hex(&file.blake3).is_err() {
                let message = format!("{:?}; 64 hexadecimal digits (`b3sum FILE`)", file.blake3);
                return Err((format!("files[{at}].blake3"), message));
            }
        }
        Ok(())
    }

    fn check_size(&self) -> Result<(), (String, String)> {
        let wrong = |field: &str, message: String| Err((format!("size.{field}"), message));
        let size = &self.size;
        let is_side = |side: &u32| (1..=MAX_SIDE_PX as u32).contains(side);
        let multiple = match (size.fixed, size.multiple_of) {
            (Some(sides), None) if sides.iter().all(is_side) => 1,
            (None, Some(multiple)) if (1..=MAX_MULTIPLE_PX).contains(&multiple) => multiple,
            (Some(sides), None) => {
                return wrong(
                    "fixed",
                    format!("{sides:?}; [height, width] from 1 to {MAX_SIDE_PX}"),
                );
            }
            (None, Some(multiple)) => {
                return wrong("multiple_of", format!("{multiple}; 1 to {MAX_MULTIPLE_PX}"));
            }
            _ => {
                return wrong(
                    "fixed",
                    "give either \"fixed\": [height, width] or \"multiple_of\"".to_owned(),
                );
            }
        };
        let needs_pixels = size.fit == Fit::Resize && size.fixed.is_none();
        let is_count = size.pixels.is_some_and(|pixels| (1..=1 << 28).contains(&pixels));
        if needs_pixels && !is_count {
            return wrong("pixels", "needed with \"fit\": \"resize\": 1 to 268435456".to_owned());
        }
        if !needs_pixels && size.pixels.is_some() {
            return wrong(
                "pixels",
                "only with \"fit\": \"resize\" and \"multiple_of\"; remove it".to_owned(),
            );
        }
        let needs_tile = size.fit == Fit::Tile && size.fixed.is_none();
        let is_tile = |side: &u32| is_side(side) && side.is_multiple_of(multiple);
        if needs_tile && !size.tile.is_some_and(|sides| sides.iter().all(is_tile)) {
            return wrong(
                "tile",
                format!("needed with \"fit\": \"tile\": [height, width], multiples of {multiple}"),
            );
        }
        if !needs_tile && size.tile.is_some() {
            return wrong(
                "tile",
                "only with \"fit\": \"tile\" and \"multiple_of\"; remove it".to_owned(),
            );
        }
        Ok(())
    }

    fn check_inputs(&self) -> Result<(), (String, String)> {
        if self.inputs.is_empty() || self.inputs.len() > MAX_INPUTS {
            let message = format!("{} inputs; 1 to {MAX_INPUTS}", self.inputs.len());
            return Err(("inputs".to_owned(), message));
        }
        let mut images = 0;
        for (at, input) in self.inputs.iter().enumerate() {
            let wrong = |field: &str, message: &str| {
                Err((format!("inputs[{at}].{field}"), message.to_owned()))
            };
            let is_constant = input.role == InputRole::Constant;
            images += usize::from(matches!(input.role, InputRole::Rgb | InputRole::Luma));
            if self.inputs[..at].iter().any(|other| other.name == input.name) {
                return wrong("name", "named twice; each input of the graph has one entry");
            }
            if !is_range(input.range) {
                return wrong("range", "[black, white]: two finite, different numbers");
            }
            if is_constant != input.value.is_some_and(f64::is_finite)
                || (!is_constant && !input.shape.is_empty())
            {
                return wrong(
                    "value",
                    "a finite number, needed with the role \"constant\" and only there",
                );
            }
            let values: f64 = input.shape.iter().map(|side| f64::from(*side)).product();
            if values > MAX_CONSTANT_VALUES as f64 {
                return wrong("shape", "more than 1048576 values");
            }
            if input.dtype == Dtype::I64 && !is_constant {
                return wrong("dtype", "i64 only with the role \"constant\"; f32 or f16 here");
            }
        }
        if images != 1 {
            let message = format!("{images} have the role \"rgb\" or \"luma\"; exactly one must");
            return Err(("inputs".to_owned(), message));
        }
        Ok(())
    }

    fn check_output(&self) -> Result<(), (String, String)> {
        let wrong =
            |field: &str, message: &str| Err((format!("outputs[0].{field}"), message.to_owned()));
        let [output] = &self.outputs[..] else {
            let message = format!("{} outputs; exactly one", self.outputs.len());
            return Err(("outputs".to_owned(), message));
        };
        if !is_range(output.range) {
            return wrong("range", "[black, white]: two finite, different numbers");
        }
        if !(1..=MAX_SCALE).contains(&output.scale) {
            return wrong("scale", "1 to 4");
        }
        let is_luma_in = self.image_input().role == InputRole::Luma;
        if (output.role == OutputRole::Luma) != is_luma_in {
            return wrong("role", "\"luma\" if and only if an input has the role \"luma\"");
        }
        let adds = output.role == OutputRole::Residual || self.merge == Merge::Residual;
        if adds && output.scale != 1 {
            return wrong("scale", "1 with a residual: a larger image has nothing to add to");
        }
        if output.role == OutputRole::Residual && self.merge == Merge::Replace {
            return Err((
                "merge".to_owned(),
                "\"residual\" with the output role \"residual\"".to_owned(),
            ));
        }
        Ok(())
    }
}

fn is_range(range: [f32; 2]) -> bool {
    range.iter().all(|end| end.is_finite()) && range[0] != range[1]
}
