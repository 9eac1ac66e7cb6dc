//! The ONNX runtime library, and models in folders of their own.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::fs;
use std::path::PathBuf;

use serde_json::{Value, json};
use tempfile::TempDir;
use wildcity_repair::{LoadOptions, Model, RepairError};

use crate::root::root;

/// The runtime library. Panics with the remedy if there is none.
pub(crate) fn library() -> PathBuf {
    if let Some(path) = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty()) {
        return path.into();
    }
    installed().unwrap_or_else(|| {
        panic!(
            "these tests need an ONNX Runtime library: set ORT_DYLIB_PATH to a libonnxruntime.so, or \
             `python3 -m venv target/python && target/python/bin/pip install onnxruntime`, as .ci/test does"
        )
    })
}

/// target/python/lib/python3.*/site-packages/onnxruntime/capi/libonnxruntime.so.*
fn installed() -> Option<PathBuf> {
    let entries = |folder: PathBuf| {
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    let versions = entries(root().join("target/python/lib"));
    let files =
        versions.into_iter().flat_map(|v| entries(v.join("site-packages/onnxruntime/capi")));
    files.into_iter().find(|file| {
        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        name.starts_with("libonnxruntime.so")
    })
}

/// A model and its manifest in a folder.
pub(crate) struct Folder {
    pub(crate) folder: TempDir,
    pub(crate) manifest: Value,
}

impl Folder {
    /// `changes` replaces fields of a manifest for an RGB model of any size.
    pub(crate) fn new(onnx: &[u8], changes: Value) -> Folder {
        let folder = TempDir::new().unwrap();
        fs::write(folder.path().join("model.onnx"), onnx).unwrap();
        let mut manifest = json!({
            "format": "wildcity.repair/1", "name": "double", "version": "1", "licence": "MIT",
            "files": [{"path": "model.onnx", "blake3": blake3::hash(onnx).to_hex().to_string()}],
            "providers": ["cpu"], "timeout_ms": 60_000,
            "size": {"multiple_of": 1, "fit": "pad"}, "merge": "replace",
            "inputs": [{"name": "image", "role": "rgb"}],
            "outputs": [{"name": "repaired", "role": "rgb"}],
        });
        for (field, value) in changes.as_object().unwrap() {
            manifest[field] = value.clone();
        }
        Folder { folder, manifest }
    }

    pub(crate) fn path(&self) -> PathBuf {
        let path = self.folder.path().join("repair.json");
        fs::write(&path, serde_json::to_vec_pretty(&self.manifest).unwrap()).unwrap();
        path
    }

    pub(crate) fn load(&self) -> Result<Model, RepairError> {
        Model::load(&self.path(), &LoadOptions::new(library()))
    }

    pub(crate) fn load_with_threads(&self, threads: usize) -> Model {
        Model::load(&self.path(), &LoadOptions { threads, ..LoadOptions::new(library()) }).unwrap()
    }
}

/// The trained model of that name in the data, or nothing and a word on standard error.
pub(crate) fn trained(name: &str) -> Option<Vec<u8>> {
    let path = crate::data::real(&format!("onnx/{name}"))?;
    Some(fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
}
