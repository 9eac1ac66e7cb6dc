//! The version that a push is made from, and conflicts with versions that came after it.

use wildcity_twin::store::{Catalog, StoreError, Version};

use crate::error::PushError;
use crate::request::{CellSelection, PushRequest};
use crate::source::SourceAxes;

/// The number of the twin's latest version, if the twin exists. Also refuses a push early if its
/// cells changed since the base that it names.
///
/// # Errors
/// The base does not exist, or [`StoreError::Overlap`].
pub fn check_base(catalog: &Catalog, request: &PushRequest) -> Result<Option<u64>, PushError> {
    let versions = match catalog.versions(&request.twin) {
        Ok(versions) => versions,
        // The push makes the twin. A base of a twin that does not exist is an error instead.
        Err(StoreError::NoTwin { .. }) if request.base.is_none() => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    // A base that is the latest has no differences, so this needs no case of its own.
    let latest = versions.last().map(|entry| entry.number);
    if let (Some(base), Some(latest)) = (request.base, latest) {
        let diff = catalog.diff(&request.twin, base, latest)?;
        let changed = diff.cells.iter().map(|difference| difference.cell);
        let cells: Vec<[i32; 2]> = match &request.cells {
            CellSelection::These(selected) => {
                changed.filter(|cell| selected.contains(cell)).collect()
            }
            CellSelection::All => changed.collect(),
            // These cells are known only after the files are read; the store then detects
            // conflicts.
            CellSelection::Touched => Vec::new(),
        };
        if !cells.is_empty() {
            let name = request.twin.clone();
            // Only cells are compared here; the commit itself compares settings, too.
            let settings = Vec::new();
            return Err(StoreError::Overlap { name, base, latest, cells, settings }.into());
        }
    }
    Ok(latest)
}

/// The id of a push that names none: a hash of its content and of the latest version, since the
/// same content on top of another version is another push.
pub fn default_id(request: &PushRequest, latest: Option<u64>) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(request.request_hash.as_bytes());
    // Versions count from 1, so 0 stands for a twin that does not exist yet.
    hasher.update(&latest.unwrap_or(0).to_le_bytes());
    // 32 hex digits are 128 bits, which do not collide, and they stay within the 64 characters of a
    // name.
    hasher.finalize().to_hex()[..32].to_owned()
}

/// The axes and the unit of files for which the request gives none: those with which the base was
/// imported.
///
/// # Errors
/// The base was made from files in different axes; or as [`find_base`].
pub(crate) fn default_axes(
    catalog: &Catalog,
    request: &PushRequest,
) -> Result<SourceAxes, PushError> {
    let Some(index) = request.files.iter().position(|file| !file.axes.is_complete()) else {
        return Ok(SourceAxes::default());
    };
    let Some(base) = find_base(catalog, request)? else { return Ok(SourceAxes::default()) };
    SourceAxes::from_version(&base)
        .map_err(|reason| PushError::InvalidField { field: format!("files[{index}].axes"), reason })
}

/// The base version of a push; `None` if the push makes a new twin.
pub(crate) fn find_base(
    catalog: &Catalog,
    request: &PushRequest,
) -> Result<Option<Version>, PushError> {
    match catalog.version(&request.twin, request.base) {
        Ok(version) => Ok(Some(version)),
        Err(StoreError::NoTwin { .. }) if request.base.is_none() => Ok(None),
        Err(error) => Err(error.into()),
    }
}
