//! Real images with their cameras: lists of them, and their files.

mod list;
mod names;
pub(super) mod own_vehicle;
pub(super) mod picture;

pub(super) use list::{ImageList, RealImage};
pub(super) use names::camera_names;
