//! What a backend draws of a view, and how two drawings differ.

pub mod blobs;
pub mod drawing;
pub mod errors;
pub mod numbers;
pub mod points;
pub mod psnr;
