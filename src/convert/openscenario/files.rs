//! The files beside a scenario: catalogs and roads.

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::{ConvertError, TEXT_BYTES};

/// The XML files of a directory, in order of their names; none if it is absent, because only what a
/// scenario refers to must be there.
pub(super) fn xml_files(directory: &Path) -> Vec<PathBuf> {
    let Ok(files) = std::fs::read_dir(directory) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = files.filter_map(|file| Some(file.ok()?.path())).collect();
    paths.retain(|path| {
        path.extension().is_some_and(|extension| extension == "xosc" || extension == "xml")
    });
    // A directory has no order of its own, and of two entries of one name the first counts.
    paths.sort();
    paths
}

/// Reads a file, whose size is bounded.
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, ConvertError> {
    let failed = |error: std::io::Error| {
        ConvertError::new(format!("{}", path.display()), format!("{error}; it must be readable"))
    };
    // To read a pipe could take for ever.
    let is_file = path.metadata().map_err(failed)?.is_file();
    if !is_file {
        return Err(ConvertError::new(format!("{}", path.display()), "is no file"));
    }
    let mut bytes = Vec::new();
    let file = std::fs::File::open(path).map_err(failed)?;
    // One byte more than the limit, so that `utf8_text` refuses a longer file.
    file.take(TEXT_BYTES as u64 + 1).read_to_end(&mut bytes).map_err(failed)?;
    Ok(bytes)
}

pub(super) fn read_text(path: &Path) -> Result<String, ConvertError> {
    let bytes = read_bytes(path)?;
    let text = crate::utf8_text(&bytes)
        .map_err(|error| ConvertError::new(format!("{}", path.display()), error.message))?;
    Ok(text.to_owned())
}
