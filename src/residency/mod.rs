//! What is in memory now.

mod budget;
mod cache;
mod demand;
mod error;

pub use cache::{Cache, Resident};
pub use demand::{Eye, Needed, demand};
pub use error::ResidencyError;
