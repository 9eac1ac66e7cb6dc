//! The stress table: it holds on a device, and each of its checks can fail.

#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/images.rs"]
mod images;

#[path = "gpu.rs"]
mod device;
mod mutations;
