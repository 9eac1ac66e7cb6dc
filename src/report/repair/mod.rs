//! Error against run time of repair: what models gain on and off the recorded drive, and what they
//! cost.
//!
//! ```text
//! stations   the poses, on the drive and at lateral offsets from it, each with the pose of the previous frame
//! measure    renders them, warps recorded images into them, and runs the models
//! flicker    the difference between an image and the previous one, warped into its view
//! row        the means of a distance and a kind of image
//! below      the trust at which repair should begin, and what it gains at other stations
//! page       the section of the HTML page
//! ```
//!
//! Only the reported times depend on the clock: with a deterministic model, a second run gives the
//! same other numbers.

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
pub use stations::RepairSampling;

use serde::Serialize;

/// The gain and the cost of repair on one twin and this machine.
#[derive(Clone, Debug, Serialize)]
pub struct RepairReport {
    /// The twin, models and images that were measured.
    pub subject: RepairSubject,
    /// By distance from the drive, then by kind: rendered, warped, each model.
    pub rows: Vec<RepairRow>,
    /// For each model, the trust below which it should repair. Empty without a twin that is the
    /// ground truth.
    pub below: Vec<RecommendedBelow>,
}
