//! Why a model was refused, or an image was not repaired.

use std::path::PathBuf;

/// A refusal: the field or file, what is wrong, and what to do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RepairError {
    /// A field of the manifest is wrong.
    #[error("{}: {field}: {message}", file.display())]
    Manifest {
        file: PathBuf,
        /// The path of the field, such as `inputs[0].role`.
        field: String,
        /// The error, and the accepted values.
        message: String,
    },
    /// There is no model of this name.
    #[error(
        "there is no repair model {name:?}; there is {}",
        if known.is_empty() { "none".to_owned() } else { known.join(", ") }
    )]
    Unknown {
        /// The name asked for.
        name: String,
        /// The names of the models.
        known: Vec<String>,
    },
    /// A file cannot be read.
    #[error("{}: {message}", path.display())]
    File {
        path: PathBuf,
        /// The message of the operating system, or the limit.
        message: String,
    },
    /// A file of the model is not the one that the manifest names.
    #[error(
        "{}: {field}.blake3: the manifest pins {pinned}, the file has {found}; restore the file, or pin the new \
         hash if you trust it", path.display()
    )]
    Changed {
        path: PathBuf,
        /// The entry of the manifest, such as `files[0]`.
        field: String,
        /// The hash in the manifest.
        pinned: String,
        /// The hash of the file.
        found: String,
    },
    /// No runtime library is named.
    #[error(
        "no ONNX Runtime library is named: give --onnxruntime PATH or set ORT_DYLIB_PATH to a \
         libonnxruntime.so from version 1.18 on (pip install onnxruntime has one, in onnxruntime/capi)"
    )]
    RuntimeUnnamed,
    /// The runtime library does not exist, or is not an ONNX runtime.
    #[error("--onnxruntime {}: {message}", path.display())]
    Runtime {
        /// The library as named.
        path: PathBuf,
        /// The error, and the accepted values.
        message: String,
    },
    /// Another runtime library is loaded already; a process has one.
    #[error(
        "--onnxruntime {}: this process has loaded {} already; name that one, or start another process",
        asked.display(), loaded.display()
    )]
    RuntimeLoaded {
        /// The library that is in use.
        loaded: PathBuf,
        /// The library that was named.
        asked: PathBuf,
    },
    /// The provider is not in this library or on this machine. There is no fall-back.
    #[error(
        "provider {provider}: {message}; name another provider of the manifest, or another library"
    )]
    Provider {
        /// `cpu`, `cuda` or `tensorrt`.
        provider: &'static str,
        /// The message of the runtime.
        message: String,
    },
    /// The runtime cannot read the model.
    #[error("{}: the runtime refuses the model: {message}", path.display())]
    Graph {
        path: PathBuf,
        /// The message of the runtime.
        message: String,
    },
    /// Building the session took too long.
    #[error("{}: the model was not ready within {limit_s} s", path.display())]
    LoadTimeout {
        path: PathBuf,
        /// The limit, in seconds.
        limit_s: u64,
    },
    /// An input of the view is missing or has another size.
    #[error("{field}: {message}")]
    Input {
        /// The role of the input, or `image`.
        field: String,
        /// The error, and the accepted values.
        message: String,
    },
    /// An output has another shape than the manifest promises.
    #[error(
        "output {output:?}: the model returned the shape {found:?}, the manifest promises {wanted:?}; correct \
         size, layout or outputs[0].scale"
    )]
    Shape {
        /// The name of the output.
        output: String,
        wanted: Vec<i64>,
        found: Vec<i64>,
    },
    /// An output has NaN or infinite values.
    #[error(
        "output {output:?}: {count} of {of} values are NaN or infinite; correct the range or dtype of the inputs \
         (f16 ends at 65504)"
    )]
    NotFinite {
        /// The name of the output.
        output: String,
        /// Number of values that are not finite.
        count: usize,
        /// Number of all values.
        of: usize,
    },
    /// A run took too long and was stopped; the model is usable again.
    #[error(
        "the model ran longer than timeout_ms {limit_ms} and was stopped; raise timeout_ms or lower the size"
    )]
    TimedOut {
        /// `timeout_ms` of the manifest.
        limit_ms: u64,
    },
    /// The model ran too long too often, or did not stop. It is not used again.
    #[error("the model is withdrawn: {reason}; load it again")]
    Withdrawn { reason: String },
    #[error("the runtime failed: {message}")]
    Run {
        /// The message of the runtime.
        message: String,
    },
    /// The model cannot be cut into tiles.
    #[error("size.fit: tiles are refused: {message}; use \"resize\" or \"pad\"")]
    Tiles {
        /// The result of the probe.
        message: String,
    },
}
