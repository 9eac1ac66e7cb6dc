//! City twins on disk and in memory: files of outside formats in, sections of a versioned store
//! out.

pub mod ingest;
pub mod limits;
pub mod residency;
pub mod store;
