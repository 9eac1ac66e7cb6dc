//! Stands for `mesh` in a build without the feature `mesh`.

use super::bad;
use super::instances::MeshInstance;
use super::uris::Uris;
use crate::ingest::IngestError;
use wildcity_scene::Gaussians;

/// In the place of the reader of meshes, in a build without `mesh`.
///
/// # Errors
/// Always: it says what to build.
pub(super) fn read(
    _: &[u8],
    _: &[MeshInstance<'_>],
    _: &[&[u8]],
    _: &mut Uris<'_>,
) -> Result<Gaussians, IngestError> {
    let left_out = "built without `mesh`: cargo build --release --features full";
    Err(bad("meshes", left_out.to_owned()))
}
