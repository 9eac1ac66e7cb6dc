//! Real images with their cameras: lists of them, and their files.

mod list;
mod names;
pub mod own_vehicle;
pub mod picture;

pub use list::{ImageList, RealImage};
pub use names::camera_names;
