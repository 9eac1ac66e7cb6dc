//! What a backend draws of a view, and how two drawings differ.

pub mod errors;
pub mod gaussians;
pub mod images;
pub mod json_numbers;
pub mod psnr;
pub mod reprojection;
