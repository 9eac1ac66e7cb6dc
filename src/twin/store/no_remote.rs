//! Stands for `remote` in a build without the feature `object-store`.

use super::StoreError;
use super::object_access::DiskCacheSettings;

/// The twins in an object store: there are none in this build.
#[derive(Clone, Debug)]
pub(super) enum Remote {}

impl Remote {
    /// # Errors
    /// Always: it says what to build.
    pub(super) fn at(url: &str, _: Option<&DiskCacheSettings>) -> Result<Self, StoreError> {
        let reason = "built without `object-store`: cargo build --release --features full";
        Err(StoreError::Url { url: url.to_owned(), reason: reason.to_owned() })
    }
}
