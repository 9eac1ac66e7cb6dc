//! Real images with their cameras: lists of them, and their files.

mod list;
pub(super) mod picture;

pub(super) use list::{ImageList, RealImage};
