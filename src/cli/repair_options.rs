//! `--repair` and related options: the models that repair images, the same on every command that
//! uses them.

use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;

use wildcity_repair::{LoadOptions, Models, RepairError};

/// Largest number of threads of a model.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;

/// The models that repair images.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct RepairOptions {
    /// Manifests of models that repair images, separated by commas (docs/repair.md);
    /// `wildcity dev repair` checks one. A model and the runtime are loaded when a session or a
    /// record asks for it by name.
    #[arg(long, value_name = "FILES")]
    repair: Option<Manifests>,

    /// ONNX Runtime library for --repair, version 1.18 or later [default: $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of each repair model on the processor. The images do not depend on it.
    #[arg(long, hide = true, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,

    /// Memory for recorded images that repair models compare with, in MiB. Images that do not fit
    /// are read again when needed.
    #[arg(long, hide = true, value_name = "MIB", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..))]
    views_mib: u32,
}

/// The manifests, by their paths.
#[derive(Clone, Debug)]
struct Manifests(Vec<PathBuf>);

impl FromStr for Manifests {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let paths: Vec<PathBuf> = text.split(',').map(|path| path.trim().into()).collect();
        if paths.iter().any(|path| path.as_os_str().is_empty()) {
            return Err("a path is empty; expected manifests separated by commas".to_owned());
        }
        Ok(Self(paths))
    }
}

/// The runtime library: the named one, or that of the environment; empty if neither is set.
pub(super) fn runtime_library(named: Option<&PathBuf>) -> PathBuf {
    let from_environment = || std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    named.cloned().or_else(from_environment).unwrap_or_default()
}

impl RepairOptions {
    /// The models, by name. Reads their manifests, and loads nothing.
    ///
    /// # Errors
    /// A manifest is wrong, or the library is not named or is not a file.
    pub(super) fn models(&self) -> Result<Arc<Models>, RepairError> {
        let Some(Manifests(paths)) = &self.repair else { return Ok(Arc::default()) };
        let library = runtime_library(self.onnxruntime.as_ref());
        let threads = usize::from(self.repair_threads);
        let reference_bytes = u64::from(self.views_mib) << 20;
        let options = LoadOptions { threads, reference_bytes, ..LoadOptions::new(library) };
        Models::read(paths, options).map(Arc::new)
    }
}
