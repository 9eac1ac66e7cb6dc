//! Twins on disk: immutable versions, content-addressed.
//!
//! ```text
//! <twins>/<name>/log/0000000001         which manifest version 1 is, and since when
//! <twins>/<name>/objects/3f/3f9c...     manifests, their tables and chunks, named by their BLAKE3
//! <twins>/.staging/<name>/              objects of a running import, invisible to everyone
//! <twins>/.staging/<name>.lock          held while one runs
//! ```
//!
//! Objects come first and the log's record last, put only if absent, so that whatever happens in
//! the middle leaves the old version or the new one.

mod catalog;
mod chunk_file;
mod error;
mod objects;
mod push;
mod recover;
mod verify;

pub use catalog::{Catalog, Listing, Version};
pub use error::StoreError;
pub use push::{NewVersion, Storage};
pub use verify::{Damage, Verified};
