//! Compares rendered images with real images that training did not see (held-out images), and reports the errors as
//! one HTML page, as JSON and as CSV.
//!
//! ```text
//! pair            a real image, a rendered one, and the pixels that count
//! exposure        the best affine change of each channel
//! scores          PSNR, SSIM and FLIP of a pair, and the map of its errors
//! evaluation      the scores of all images, their means, CSV
//! thumbnails      small pictures of a pair
//! page            the HTML page
//! ```
//!
//! The measures themselves are in [`wildcity_render::compare`], where the report takes them from as well. Images are
//! compared in 8 bits, as agents get them and as files hold them. So other programs compute the same numbers from the
//! files.

mod evaluation;
mod exposure;
mod page;
mod pair;
mod scores;
mod thumbnails;

pub use evaluation::{AlignedMeans, CameraMeans, EvaluatedImage, Evaluation, Means, Subject};
pub use exposure::Exposure;
pub use page::render as page;
pub use pair::{Pair, PairError};
pub use scores::{AlignedScores, PairScores, Scores};
pub use thumbnails::{Thumbnails, error_png};
