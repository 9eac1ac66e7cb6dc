//! Compares rendered images with real images that training did not see (held-out images), and
//! reports the errors as one HTML page, as JSON and as CSV.
//!
//! ```text
//! pair            a real image, a rendered one, and the pixels that count
//! exposure        the best affine change of each channel
//! scores          PSNR, SSIM and FLIP of a pair, and the map of its errors
//! boxes           boxes around moving objects, and the pixels that they hide
//! lidar           points of a LiDAR in the world, and rendered depth against them
//! reprojection    an off-trajectory view, warped back onto a real image
//! extrapolation   the views at one distance from the drive
//! kid             the distance of two sets of images by features of a network
//! evaluated_image the scores of one image
//! evaluation      the scores of all images
//! means, csv      their means; the images as CSV
//! thumbnails      small pictures of a pair
//! page            the HTML page
//! images          real images with their cameras, and their files
//! beside          views beside the drive of a twin with errors, against one without them
//! run             an evaluation: renders, repairs and measures every image of a list
//! ```
//!
//! The measures themselves are in [`wildcity_render::compare`], which the report uses as well.
//! Images are compared in 8 bits, as agents get them and files store them, so that other programs
//! compute the same numbers from the files.

mod beside;
mod boxes;
mod csv;
mod evaluated_image;
mod evaluation;
mod exposure;
mod extrapolation;
pub mod images;
mod kid;
mod lidar;
mod mean;
mod means;
mod page;
mod pair;
mod reprojection;
mod run;
mod scores;
mod thumbnails;

pub use beside::{Beside, BesideViews};
pub use boxes::{Boxes, BoxesError, GROWN_PX, MOVES_M_PER_S, MovingBox, hide};
pub use evaluated_image::EvaluatedImage;
pub use evaluation::{BoxesSubject, Evaluation, LidarSubject, RepairSubject, Subject};
pub use exposure::Exposure;
pub use extrapolation::{ExtrapolatedView, Extrapolation, ViewMeans, ViewScores};
pub use kid::{Kid, KidError, KidScores};
pub use lidar::{
    BINS_M, DepthMap, LidarBin, LidarDepth, LidarError, LidarMeans, LidarPoints, NO_LIDAR_POINT,
    WorldPoints,
};
pub use means::{AlignedMeans, CameraMeans, Gain, Means, ScoreMeans};
pub use page::render as page;
pub use pair::{Pair, PairError};
pub use reprojection::Reprojection;
pub use run::{Evaluator, ProfileChanges, Save, Scene, Settings, run};
pub use scores::{AlignedScores, PairScores, Scored, Scores};
pub use thumbnails::{Thumbnails, error_png, jpeg};
