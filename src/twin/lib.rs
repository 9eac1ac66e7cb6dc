//! City twins on disk and in memory.
//!
//! ```text
//! ingest     reads scenes, skies, and camera lists from the formats of other programs
//! store      immutable, content-addressed versions in a directory or an object store
//! residency  which sections of a version are in memory, and which are loaded next
//! limits     limits and defaults, with the arithmetic behind each
//! ```

#[cfg_attr(
    not(feature = "mesh"),
    allow(dead_code, reason = "only meshes use some of what all scenes are given")
)]
pub mod ingest;
pub mod limits;
pub mod residency;
pub mod store;
