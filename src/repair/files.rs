//! Reads the files of a model. The hash covers the bytes that run: each file is read once, and the
//! session is built from those bytes. A file that is replaced afterwards changes nothing until the
//! model is loaded again.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::RepairError;
use crate::limits::{MAX_MANIFEST_BYTES, MAX_MODEL_BYTES};
use crate::manifest::{Manifest, ModelFile};

/// A manifest and the bytes that it names.
pub(crate) struct ModelFiles {
    pub(crate) manifest: Manifest,
    pub(crate) manifest_bytes: Vec<u8>,
    pub(crate) graph: GraphFiles,
}

/// The files from which a session is built.
pub(crate) struct GraphFiles {
    pub(crate) path: PathBuf,
    pub(crate) bytes: Vec<u8>,
    /// External weights, by the name that the graph uses.
    pub(crate) weights: Vec<(String, Arc<[u8]>)>,
}

/// Reads only a manifest.
pub(crate) fn read_manifest(path: &Path) -> Result<Manifest, RepairError> {
    Manifest::parse(&read_text(path)?, path)
}

/// The text of a manifest.
pub(crate) fn read_text(path: &Path) -> Result<Vec<u8>, RepairError> {
    read_at_most(path, MAX_MANIFEST_BYTES)
}

pub(crate) fn read(path: &Path) -> Result<ModelFiles, RepairError> {
    let manifest_bytes = read_text(path)?;
    let manifest = Manifest::parse(&manifest_bytes, path)?;
    let graph = read_graph(path, &manifest.files)?;
    Ok(ModelFiles { manifest, manifest_bytes, graph })
}

/// The files that a manifest at `path` pins: the .onnx file, then external weights. There is at
/// least one.
pub(crate) fn read_graph(path: &Path, files: &[ModelFile]) -> Result<GraphFiles, RepairError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut contents = Vec::new();
    // All files share one limit, so that many small ones cannot exceed it together.
    let mut left = MAX_MODEL_BYTES;
    for (at, file) in files.iter().enumerate() {
        let path = folder.join(&file.path);
        let bytes = read_at_most(&path, left)?;
        // `read_at_most` has checked that it is no more than `left`.
        left -= bytes.len() as u64;
        let found = blake3::hash(&bytes).to_hex().to_string();
        // The manifest may have the digits in capitals; `Hash::from_hex` accepts both.
        if !found.eq_ignore_ascii_case(&file.blake3) {
            let pinned = file.blake3.clone();
            return Err(RepairError::Changed {
                path,
                field: format!("files[{at}]"),
                pinned,
                found,
            });
        }
        contents.push((file.path.clone(), bytes));
    }
    // The first file is the graph. `Manifest::parse` refuses an empty list.
    let (name, bytes) = contents.remove(0);
    let weights = contents.into_iter().map(|(name, bytes)| (name, bytes.into())).collect();
    Ok(GraphFiles { path: folder.join(name), bytes, weights })
}

fn read_at_most(path: &Path, limit: u64) -> Result<Vec<u8>, RepairError> {
    let error = |message: String| RepairError::File { path: path.to_owned(), message };
    // Before it is opened: opening a pipe waits for a writer.
    let metadata = fs::metadata(path).map_err(|e| error(e.to_string()))?;
    if !metadata.is_file() {
        return Err(error("not a regular file".to_owned()));
    }
    let file = fs::File::open(path).map_err(|e| error(e.to_string()))?;
    let mut bytes = Vec::new();
    // One byte more than allowed shows that there is more. The length of the metadata is no bound,
    // as the file may grow while it is read.
    file.take(limit + 1).read_to_end(&mut bytes).map_err(|e| error(e.to_string()))?;
    if bytes.len() as u64 > limit {
        return Err(error(format!("more than {limit} bytes are not read")));
    }
    Ok(bytes)
}

/// The absolute path of the runtime library. Checks that it is a file, for a clearer message than
/// the loader's.
pub(crate) fn check_library(path: &Path) -> Result<PathBuf, String> {
    let absolute =
        // Two paths to one file are one library, and `RuntimeLoaded` compares paths.
        fs::canonicalize(path).map_err(|error| format!("{error}; name a libonnxruntime.so"))?;
    if !absolute.is_file() {
        return Err("not a regular file; name a libonnxruntime.so".to_owned());
    }
    Ok(absolute)
}
