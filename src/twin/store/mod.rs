//! Twins on disk or in an object store: immutable versions, content-addressed.
//!
//! ```text
//! <twins>/<name>/log/0000000001         which manifest version 1 is, since when, and how it came about
//! <twins>/<name>/objects/3f/3f9c...     manifests, their tables, chunks and skies, named by their BLAKE3
//! <twins>/<name>/leases/...             versions in use, and until when
//! <twins>/<name>/gc/candidates          objects that no version needs, and since when
//! <twins>/<name>/gc/collected           versions whose objects were removed
//!
//! <twins>/.staging/<name>@<commit>/     objects of a commit in the making, invisible to everyone
//! <twins>/.staging/<name>@<commit>/lock held by its process as long as it lives
//! <twins>/.staging/<name>.lock          held while a version is published
//! ```
//!
//! What begins with `.staging` is of directories alone; in an object store, objects are uploaded to
//! where they stay.
//!
//! ObjectBackend come first and the log's record last, put only if absent, so that whatever happens in
//! the middle leaves the old version or the new one.

mod catalog;
mod chunk_file;
mod commit;
mod diff;
mod error;
mod fsck;
mod gc;
mod lease;
mod local;
mod log;
mod new_version;
mod objects;
mod pack;
mod recover;
mod remote;
mod sky;

pub use catalog::{Catalog, DiskCacheSettings, TwinListing, Version};
pub use commit::{Commit, StorageOptions, StoredCells, VersionChange, VersionSettings};
pub use diff::{CellDiff, CellSize, Diff};
pub use error::StoreError;
pub use fsck::{DamagedObject, FsckReport, VerifyReport};
pub use gc::{CollectionReport, ObjectTotals, Retention};
pub use lease::Lease;
pub use log::{CommitKind, LogEntry};
pub use new_version::NewVersion;
pub use remote::{RetryPolicy, Traffic};
pub use sky::{NewSky, SkyBytes};
