//! What is in memory now.

mod cache;

pub use cache::{Cache, Resident};
