//! The model of `wildcity train augment`.

use std::path::PathBuf;

use wildcity_repair::{LoadOptions, Models, RepairError};

use crate::cli::repair_options::runtime_library;

/// Largest number of threads of a model.
const THREADS: i64 = wildcity_repair::limits::MAX_THREADS as i64;

/// The model that repairs the images.
#[derive(Debug, clap::Args)]
pub(super) struct ModelOptions {
    /// Manifest of the model that repairs the images (docs/repair.md) [default: none, images are as
    /// rendered]
    #[arg(long, value_name = "MODEL.json")]
    repair: Option<PathBuf>,

    /// Leave images below this trust as rendered: there the model would hallucinate.
    #[arg(long, value_name = "TRUST", default_value_t = 0.1, value_parser = trust, requires = "repair")]
    pub(super) at_least: f64,

    /// ONNX Runtime library for --repair, version 1.18 or later [default: $ORT_DYLIB_PATH]
    #[arg(long, value_name = "PATH")]
    onnxruntime: Option<PathBuf>,

    /// Threads of the model on the processor. The images do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=THREADS))]
    repair_threads: u16,

    /// Memory for recorded images that the model compares with, in MiB.
    #[arg(long, value_name = "MIB", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..))]
    views_mib: u32,
}

impl ModelOptions {
    /// The model, or none. Reads its manifest, and loads nothing.
    pub(super) fn models(&self) -> Result<Models, RepairError> {
        let Some(manifest) = &self.repair else { return Ok(Models::default()) };
        let library = runtime_library(self.onnxruntime.as_ref());
        let threads = usize::from(self.repair_threads);
        let reference_bytes = u64::from(self.views_mib) << 20;
        let options = LoadOptions { threads, reference_bytes, ..LoadOptions::new(library) };
        Models::read(std::slice::from_ref(manifest), options)
    }
}

/// Metres, with or without their unit.
pub(super) fn metres(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let number = text.strip_suffix('m').unwrap_or(text).trim_end();
    number.parse().map_err(|_| format!("{text:?} is not a number of metres, such as 2 or 2m"))
}

fn trust(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(trust) if (0.0..=1.0).contains(&trust) => Ok(trust),
        _ => Err("expected a trust from 0 to 1".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metres_have_a_unit_or_none() {
        assert_eq!((metres("2m"), metres(" 0.5 ")), (Ok(2.0), Ok(0.5)));
        assert!(metres("two").unwrap_err().contains("\"two\""));
    }
}
