//! Twins on disk or in an object store: immutable versions, content-addressed.
//!
//! ```text
//! <twins>/<name>/log/0000000001         the hash of version 1's manifest, when it was committed, and from what
//! <twins>/<name>/objects/3f/3f9c...     manifests, their tables, chunks, skies, and recorded images, named by their BLAKE3
//! <twins>/<name>/leases/...             versions in use, and until when
//! <twins>/<name>/gc/candidates          objects that no kept version needs, and since when
//! <twins>/<name>/gc/collected           versions that were removed
//!
//! <twins>/.actors/objects/3f/3f9c...     assets of actors, which all twins share
//! <twins>/.staging/<name>@<commit>/     objects of a commit in preparation, invisible to readers
//! <twins>/.staging/<name>@<commit>/lock locked by the commit's process while the process lives
//! <twins>/.staging/<name>.lock          locked while a version is published
//! ```
//!
//! Paths that begin with `.staging` exist in directories only. In an object store, objects are
//! uploaded to their final keys.
//!
//! # Decisions
//!
//! **A commit writes objects first and its log record last.** A version is a manifest, which names
//! a table and chunks by their hashes; a twin is a numbered log of manifests. The record `log/<n +
//! 1>` is *put only if absent*: with a hard link in a directory, with a conditional put in an
//! object store. That is the only atomic operation, and the one that S3, GCS, Azure, and a disk
//! have in common. Whenever a commit is interrupted, readers see either the old version or the new
//! one.
//!
//! **On conflict, the commit reads the winning record.** Its own record means that the answer to an
//! earlier attempt was lost: the commit succeeded. Changes to other cells mean that the commit is
//! rebased on the winner. Changes to the same cells, or an alignment to other axes, are an error
//! that names them ([`StoreError::Overlap`]).
//!
//! **The log record, and not the manifest, stores when and how a version was made.** So a version's
//! hash is a hash of its content, and a rollback is a new record with an old hash.
//!
//! **In a directory, several commits of one twin may be in preparation**, each in a folder of its
//! own. Its lock is released by the kernel when the process ends, however it ends. A second lock
//! per twin is held while publishing, while removing the remains of killed commits, and during
//! garbage collection, so that no commit relies on an object that is being removed. An object store
//! has no such lock: there, the remains of a killed commit are ordinary garbage, which is removed
//! in two steps: one run records it, and another run removes it after a day.
//!
//! **Requests to object stores are timed and retried in one place** (`remote/retry.rs`);
//! `object_store`'s own retries are off.
//!
//! **The disk cache compares every part with its hash on every read**, which takes less time than
//! decoding it. So the cache needs neither fsync nor recovery, and a damaged part is fetched again.

mod actors;
mod backend;
mod catalog;
mod chunk_file;
pub mod clock;
mod commit;
mod cut;
mod density;
mod diff;
pub mod disk;
mod edit;
mod error;
mod fsck;
mod full_detail;
mod gc;
mod label;
mod layout;
mod lease;
mod local;
mod log;
mod new_version;
mod object_access;
mod pack;
mod recover;
#[cfg(feature = "object-store")]
mod remote;
#[cfg(not(feature = "object-store"))]
#[path = "no_remote.rs"]
mod remote;
mod settings;
mod sky;
mod views;
mod whole_twin;

pub use actors::{ActorList, AddedActor, DamagedActor, SameName, StoredActor, StoredLevel};
pub use catalog::{Catalog, DamagedTwin, TwinList, TwinListing, Version, check_name};
pub use commit::{Commit, StoredCells};
pub use cut::{CUT_ABOVE_M, Cut, CutPlace};
pub use density::check_density;
pub use diff::{CellDiff, CellSize, Diff};
pub use edit::Edit;
pub use error::StoreError;
pub use fsck::{DamagedObject, FsckReport, RecordSetAside, VerifyReport};
pub use gc::{CollectionReport, ObjectTotals, Retention};
pub use label::{Labelled, Labels};
pub use lease::Lease;
pub use local::{RealDisk, create_dirs};
pub use log::{CommitKind, LogEntry};
pub use new_version::NewVersion;
pub use object_access::{DiskCacheSettings, Traffic};
pub use pack::StorageOptions;
#[cfg(feature = "object-store")]
pub use remote::RetryPolicy;
pub use settings::{VersionChange, VersionSettings};
pub use sky::{NewSky, SkyBytes};
