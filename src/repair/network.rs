//! Networks that measure images: a distance of two images (LPIPS), or the features of one (for
//! KID).
//!
//! A network is an .onnx file with a manifest in the same folder, like a repair model, but its
//! output is numbers. It has an input of the role `image` and, if it compares images, one of the
//! role `truth`.

use std::path::Path;
use std::time::Duration;

use parking_lot::Mutex;
use serde::{Deserialize, Serialize};

use crate::error::RepairError;
use crate::files;
use crate::image::Image;
use crate::limits::{MAX_SIDE_PX, MAX_THREADS};
use crate::manifest::{Dtype, Layout, ModelFile, Provider, default_memory_mib};
use crate::model::LoadOptions;
use crate::onnx::{Feed, Graph, Settings, Worker};
use crate::planes::Planes;
use crate::resample::{Kernel, resample};
use crate::roles;
use crate::validate::{self, Checked};

/// Most values of an output.
const MAX_VALUES: usize = 1 << 20;

/// A network as its manifest describes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkManifest {
    /// The format, which must be [`NetworkManifest::FORMAT`].
    pub format: String,
    /// The name that reports give its numbers.
    pub name: String,
    /// The version of the network, as its author counts.
    pub version: String,
    /// The licence of the weights.
    pub licence: String,
    /// The .onnx file, then files of external weights.
    pub files: Vec<ModelFile>,
    /// The providers on which it may run. The first is the default; there is no fall-back to
    /// another.
    pub providers: Vec<Provider>,
    /// GPU memory that the provider may take, in MiB.
    #[serde(default = "default_memory_mib")]
    pub memory_mib: u32,
    /// Longest run, in milliseconds.
    pub timeout_ms: u64,
    /// Height and width that images are resampled to (Lanczos 3), in pixels; their own without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<[u32; 2]>,
    /// The inputs of the graph: `[1, 3, height, width]` each.
    pub inputs: Vec<NetworkInput>,
    /// Name of the output that is used.
    pub output: String,
}

/// An input of a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkInput {
    /// Its name in the graph.
    pub name: String,
    /// The image that it gets.
    pub role: NetworkRole,
    /// Its type in the graph: f32 or f16.
    #[serde(default)]
    pub dtype: Dtype,
    /// The values of black and white.
    #[serde(default = "default_range")]
    pub range: [f32; 2],
}

fn default_range() -> [f32; 2] {
    [-1.0, 1.0]
}

/// The image that an input of a network gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkRole {
    /// The image that is measured.
    Image,
    /// The image that it is compared with.
    Truth,
}

/// A network that is loaded and checked. It runs one image at a time.
pub struct Network {
    manifest: NetworkManifest,
    worker: Mutex<Worker>,
}

impl std::fmt::Debug for Network {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Network").field("name", &self.manifest.name).finish_non_exhaustive()
    }
}

impl NetworkManifest {
    /// Value of the field `format` of a manifest.
    pub const FORMAT: &str = "wildcity.network/1";

    /// Reads and checks the text of a manifest; `file` is named in errors.
    ///
    /// # Errors
    /// [`RepairError::Manifest`] with the field that is wrong.
    pub fn parse(bytes: &[u8], file: &Path) -> Result<Self, RepairError> {
        validate::read(bytes, file, Self::FORMAT, Self::check)
    }

    fn check(&self) -> Checked {
        let wrong = |field: &str, message: String| Err((field.to_owned(), message));
        validate::check_name(&self.name)?;
        validate::check_run(&self.providers, self.timeout_ms, self.memory_mib)?;
        validate::check_files(&self.files)?;
        if let Some(sides) = self.size
            && !sides.iter().all(|side| (1..=MAX_SIDE_PX as u32).contains(side))
        {
            return wrong("size", format!("{sides:?}; [height, width] from 1 to {MAX_SIDE_PX}"));
        }
        let count = |role| self.inputs.iter().filter(|input| input.role == role).count();
        // A network is either a measure of one image or of a pair.
        if count(NetworkRole::Image) != 1 || count(NetworkRole::Truth) > 1 {
            let message = "exactly one must have the role \"image\", at most one \"truth\"";
            return wrong("inputs", message.to_owned());
        }
        for (at, input) in self.inputs.iter().enumerate() {
            if !validate::is_range(input.range) {
                let message = "[black, white]: two finite, different numbers".to_owned();
                return wrong(&format!("inputs[{at}].range"), message);
            }
            if input.dtype == Dtype::I64 {
                return wrong(&format!("inputs[{at}].dtype"), "i64; f32 or f16".to_owned());
            }
        }
        Ok(())
    }

    /// Whether it compares two images. Otherwise it measures one.
    pub fn compares(&self) -> bool {
        self.inputs.iter().any(|input| input.role == NetworkRole::Truth)
    }
}

impl Network {
    /// Reads the manifest at `path` and the files that it pins, and opens the runtime if this is
    /// the process's first network or model.
    ///
    /// # Errors
    /// The errors of [`crate::Model::load`].
    pub fn load(path: &Path, options: &LoadOptions) -> Result<Self, RepairError> {
        let manifest = NetworkManifest::parse(&files::read_text(path)?, path)?;
        if !(1..=MAX_THREADS).contains(&options.threads) {
            let message = format!("{}; 1 to {MAX_THREADS}", options.threads);
            return Err(RepairError::Input { field: "threads".to_owned(), message });
        }
        let graph = files::read_graph(path, &manifest.files)?;
        let settings = Settings {
            library: options.library.clone(),
            provider: options.provider.unwrap_or(manifest.providers[0]),
            threads: options.threads,
            gpu_bytes: (manifest.memory_mib as usize) << 20,
            load_timeout: options.load_timeout,
        };
        let (worker, graph) = Worker::start(graph, &settings)?;
        check_ports(&manifest, &graph, path)?;
        Ok(Self { manifest, worker: Mutex::new(worker) })
    }

    /// The manifest that the network was loaded from.
    pub fn manifest(&self) -> &NetworkManifest {
        &self.manifest
    }

    /// The values of the output for an image, and for the one that it is compared with if the
    /// network compares.
    ///
    /// # Errors
    /// `Input` if an image is missing or has another size, `NotFinite`, `TimedOut`, `Withdrawn`,
    /// `Run`.
    pub fn run(&self, image: &Image, truth: Option<&Image>) -> Result<Vec<f32>, RepairError> {
        let mut feeds = Vec::with_capacity(self.manifest.inputs.len());
        for input in &self.manifest.inputs {
            let (field, own) = match input.role {
                NetworkRole::Image => ("image", Some(image)),
                NetworkRole::Truth => ("truth", truth),
            };
            let wrong = |message: String| RepairError::Input { field: field.to_owned(), message };
            let own = own.ok_or_else(|| wrong("missing; the network has this role".to_owned()))?;
            // All images must have the size of the first: they are compared pixel by pixel.
            let is_sized = [own.width, own.height] == [image.width, image.height];
            if !is_sized || own.rgb8.len() != 3 * own.width * own.height || own.rgb8.is_empty() {
                return Err(wrong(format!("{} x {} px of another size", own.width, own.height)));
            }
            feeds.push(self.feed(input, own));
        }
        let limit = Duration::from_millis(self.manifest.timeout_ms);
        // Held for the run only: values are checked without it.
        let mut worker = self.worker.lock();
        let values = worker.run(feeds, &self.manifest.output, limit)?.values;
        drop(worker);
        let of = values.len();
        let count = values.iter().filter(|value| !value.is_finite()).count();
        if count > 0 {
            let output = self.manifest.output.clone();
            return Err(RepairError::NotFinite { output, count, of });
        }
        if !(1..=MAX_VALUES).contains(&of) {
            let message = format!("the network gave {of} values; 1 to {MAX_VALUES} are read");
            return Err(RepairError::Run { message });
        }
        Ok(values)
    }

    fn feed(&self, input: &NetworkInput, image: &Image) -> Feed {
        let mut planes: Planes = roles::rgb(image);
        if let Some([height, width]) = self.manifest.size.map(|sides| sides.map(|s| s as usize))
            && [height, width] != [image.height, image.width]
        {
            planes = resample(&planes, height, width, Kernel::Lanczos3)
                // Lanczos overshoots at edges, and networks are trained on 0 to 255.
                .map(|value| value.clamp(0.0, 255.0));
        }
        let planes = roles::in_range(planes, input.range);
        Feed {
            name: input.name.clone(),
            shape: crate::signature::image_shape(
                Layout::Nchw,
                3,
                [planes.height as i64, planes.width as i64],
            ),
            dtype: input.dtype,
            values: planes.values,
        }
    }
}

/// Compares names and types with those of the graph.
fn check_ports(manifest: &NetworkManifest, graph: &Graph, file: &Path) -> Result<(), RepairError> {
    let wrong = |field: String, message: String| {
        Err(RepairError::Manifest { file: file.to_owned(), field, message })
    };
    for (at, input) in manifest.inputs.iter().enumerate() {
        let Some(port) = graph.inputs.iter().find(|port| port.name == input.name) else {
            let known: Vec<&str> = graph.inputs.iter().map(|port| &*port.name).collect();
            let message = format!("{:?}; the graph has {}", input.name, known.join(", "));
            return wrong(format!("inputs[{at}].name"), message);
        };
        if port.dtype != Some(input.dtype) {
            let message = format!("{:?}; the graph has {}", input.dtype, port.type_name);
            return wrong(format!("inputs[{at}].dtype"), message.to_lowercase());
        }
    }
    // The runtime would refuse a run without one of its inputs; the message here names it.
    let is_given = |name: &str| manifest.inputs.iter().any(|input| input.name == name);
    if let Some(port) = graph.inputs.iter().find(|port| !is_given(&port.name)) {
        return wrong("inputs".to_owned(), format!("{:?} of the graph has no entry", port.name));
    }
    let Some(port) = graph.outputs.iter().find(|port| port.name == manifest.output) else {
        let known: Vec<&str> = graph.outputs.iter().map(|port| &*port.name).collect();
        let message = format!("{:?}; the graph has {}", manifest.output, known.join(", "));
        return wrong("output".to_owned(), message);
    };
    if !matches!(port.dtype, Some(Dtype::F32 | Dtype::F16)) {
        return wrong("output".to_owned(), format!("{} in the graph; f32 or f16", port.type_name));
    }
    Ok(())
}
