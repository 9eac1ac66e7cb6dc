//! The stress cases hold on every backend, and each of their checks can fail.

#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;

mod device;
mod mutations;
