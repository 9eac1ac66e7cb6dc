//! What is in memory now.

mod budget;
mod cache;
mod error;

pub use cache::{Cache, Resident};
pub use error::ResidencyError;
