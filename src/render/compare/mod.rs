//! Test scenes, images of them, and measures of the difference of images.
//!
//! | module | content |
//! |---|---|
//! | [`gaussians`] | small scenes, written as lists of [`GaussianSpec`](gaussians::GaussianSpec) |
//! | [`gradients`] | how far gradients differ |
//! | [`images`] | all images of a view by a backend, parts of images, and [`agree`](images::agree): whether two backends drew the same |
//! | [`psnr`], [`ssim`], [`flip`] | measures of one pair of images, as other packages compute them |
//! | [`errors`] | PSNR, SSIM, largest errors and depth errors over many images |
//! | [`flicker`] | change from one image to the next |
//! | [`heat`] | colours of error maps |
//! | [`reprojection`] | how far known points are from their pixels |
//! | [`json_numbers`] | numbers that JSON lacks (infinity, NaN) |

pub mod errors;
pub mod flicker;
pub mod flip;
pub mod gaussians;
pub mod gradient_cases;
pub mod gradients;
pub mod heat;
pub mod images;
pub mod json_numbers;
pub mod psnr;
pub mod reprojection;
pub mod ssim;
