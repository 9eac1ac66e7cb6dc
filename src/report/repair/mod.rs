//! Error against run time of repair: what models gain beside the recorded drive, and what they cost.
//!
//! ```text
//! stations   the poses, on the drive and beside it, each with the pose of a frame before
//! measure    renders them, brings recorded images into them, and runs the models
//! flicker    the difference between an image and the one before it, brought into its view
//! row        the means of a distance and a kind of image
//! below      the trust at which repair should begin, and what it gains at other stations
//! page       the section of the HTML page
//! ```
//!
//! No clock decides anything but the times: with a model that repeats its bytes, a second run gives the same numbers.

mod below;
mod flicker;
mod measure;
mod page;
mod row;
mod stations;

pub use below::{Below, BelowError, Gains, RecommendedBelow, recommend_below};
pub use measure::{RepairBenchmark, RepairSubject, Truth, measure};
pub use page::section;
pub use row::{ImageKind, RepairMs, RepairRow, RepairedModel, Sample};
pub use stations::{FRAME_M, RepairSampling};

use serde::Serialize;

/// What repair gains and costs on one twin and this machine.
#[derive(Clone, Debug, Serialize)]
pub struct RepairReport {
    /// What was measured.
    pub subject: RepairSubject,
    /// By distance from the drive, then by kind: rendered, warped, each model.
    pub rows: Vec<RepairRow>,
    /// For each model the trust at which its repair should begin. Empty without a true twin.
    pub below: Vec<RecommendedBelow>,
}
